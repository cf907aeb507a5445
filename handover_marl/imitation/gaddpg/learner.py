"""Fitting GA-DDPG's network to what the expert does and where it goes."""

import math
from dataclasses import dataclass
from typing import Any

import torch

from handover_marl.imitation.gaddpg.batches import Batch
from handover_marl.imitation.gaddpg.losses import action_losses, goal_losses
from handover_marl.imitation.gaddpg.ragged_network import decide
from handover_marl.networks.gaddpg_network import GaddpgNetwork
from handover_marl.planning.approach import ApproachConfig


@dataclass(frozen=True)
class LearnerConfig:
    """How it learns.

    Attributes:
        encoder_rate: Learning rate of the encoder at first, and
        head_rate: of the head; both fall as a cosine to
        last: this share.
        warm: Updates in which they rise.
        decay: Weight decay.
        action: Weight of the loss of actions, which by goals are an auxiliary, against that of goals.
        near: Goals farther away than this (m) count less for it; those so far away count half.
        clip: Largest norm of a gradient.
        average: Share of the averaged weights that an update leaves; these are what is used.
        half: Whether products are taken in bfloat16.
    """

    encoder_rate: float = 1e-3
    head_rate: float = 6e-4
    last: float = 0.01
    warm: int = 100
    decay: float = 1e-4
    action: float = 0.2
    near: float = 0.1
    clip: float = 1.0
    average: float = 0.998
    half: bool = True


class Learner:
    """A network, its optimizer and its averaged weights.

    Args:
        updates: Of the whole run, which the learning rates are made for.
        seed: Of the network's first weights.
        device: Where it learns.
        config: How.
        approach: How it goes to the grasps that it tells.
        max_steps: Decisions that it may take for it.

    Attributes:
        done: Updates so far.
        averaged: The network with the averaged weights.
    """

    def __init__(
        self,
        updates: int,
        seed: int,
        device: torch.device,
        config: LearnerConfig,
        approach: ApproachConfig,
        max_steps: int | None = None,
    ) -> None:
        torch.manual_seed(seed)
        self._config, self._updates, self._device = config, updates, device
        self._network = GaddpgNetwork(approach, max_steps).to(device)
        self.averaged = GaddpgNetwork(approach, max_steps).to(device).eval()
        self.averaged.load_state_dict(self._network.state_dict())
        groups = [
            {"params": list(self._network.features.parameters()), "rate": config.encoder_rate},
            {"params": list(self._network.policy.parameters()), "rate": config.head_rate},
        ]
        self._optimizer = torch.optim.AdamW(groups, lr=config.encoder_rate, weight_decay=config.decay, eps=1e-5)
        self.done = 0

    def update(self, batch: Batch) -> dict[str, float]:
        """Learn from a batch; tells losses (m)."""
        self._network.train()
        for group in self._optimizer.param_groups:
            group["lr"] = group["rate"] * self._share()
        action, goal, counted = self._losses(self._network, batch)
        loss = self._config.action * action + counted
        self._optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(self._network.parameters(), self._config.clip)
        self._optimizer.step()
        self.done += 1
        self._average()
        return {"action": float(action.detach()), "goal": float(goal.detach())}

    def assess(self, batch: Batch) -> dict[str, float]:
        """Losses of the averaged network on a batch (m)."""
        with torch.no_grad():
            action, goal, _ = self._losses(self.averaged, batch)
        return {"action": float(action.detach()), "goal": float(goal.detach())}

    def state(self) -> dict[str, Any]:
        """What to go on from."""
        return {
            "done": self.done,
            "network": self._network.state_dict(),
            "averaged": self.averaged.state_dict(),
            "optimizer": self._optimizer.state_dict(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a state."""
        self._network.load_state_dict(state["network"])
        self.averaged.load_state_dict(state["averaged"])
        self._optimizer.load_state_dict(state["optimizer"])
        self.done = int(state["done"])

    def _losses(self, network: GaddpgNetwork, batch: Batch) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Of actions, of goals, and of goals as they count."""
        moved = batch.to(self._device)
        with torch.autocast(self._device.type, torch.bfloat16, enabled=self._config.half):
            decision = decide(network, moved)
        action = action_losses(decision.action.float(), moved.steps).mean()
        goals = goal_losses(decision.goal.float(), moved.goals)
        # What is far away is told again, from nearer.
        shares = self._config.near / (self._config.near + moved.goals[:, :3].norm(dim=1))
        return action, goals.mean(), (shares * goals).mean()

    def _share(self) -> float:
        """Of the first learning rates."""
        config = self._config
        warm = min(1.0, (self.done + 1) / max(1, config.warm))
        fall = 0.5 * (1.0 + math.cos(math.pi * min(1.0, self.done / max(1, self._updates))))
        return warm * (config.last + (1.0 - config.last) * fall)

    def _average(self) -> None:
        """Averages start short, since the first weights mean nothing."""
        kept = min(self._config.average, (1.0 + self.done) / (10.0 + self.done))
        with torch.no_grad():
            own, averaged = self._network.state_dict(), self.averaged.state_dict()
            for name, value in averaged.items():
                if value.is_floating_point():
                    value.lerp_(own[name], 1.0 - kept)
                else:
                    value.copy_(own[name])
