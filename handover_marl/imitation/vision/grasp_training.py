"""How grasp networks learn from views. Needs the extra `train`."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from handover_marl.imitation.vision.grasp_views import GraspViews
from handover_marl.networks.grasp_losses import GoodGrasps, Losses, distances, good_grasps, losses
from handover_marl.networks.grasp_network import GraspNetwork, Grasps, Views


@dataclass(frozen=True)
class GraspTrainingConfig:
    """How it learns.

    Attributes:
        batch: Views a step.
        centers: Points of each at which grasps are told.
        learning_rate: Of AdamW at first; it falls to nothing as half a cosine.
        decay: Of weights.
        grasp: Weight of the grasps' loss (1/m), of
        quality: how good they are, of
        middle: the object's middle (1/m), and of
        motion: its coming motion (1/m).
        roll: Views are turned about the line of sight by so much, by chance (rad).
        noise: Points are displaced by so much (m).
        clip: Longest gradient.
    """

    batch: int = 64
    centers: int = 48
    learning_rate: float = 1e-3
    decay: float = 1e-4
    grasp: float = 10.0
    quality: float = 2.0
    middle: float = 2.0
    motion: float = 1.0
    roll: float = 0.6
    noise: float = 0.001
    clip: float = 5.0


@dataclass(frozen=True)
class GraspScores:
    """How well grasps are told in views not learned from.

    Attributes:
        views: With at least one good grasp.
        near: Share of them in which the grasp told to be best is within 1 cm of a good one, and
        far: within 2 cm; turns counted, see `handover_marl.networks.grasp_losses.distances`.
        away: Median of that distance (m).
        grasp: Loss of the grasps (m), likewise
        quality: of how good they are.
    """

    views: int
    near: float
    far: float
    away: float
    grasp: float
    quality: float


class Batches:
    """Views as tensors.

    Args:
        views: They.
        device: Where to.
    """

    def __init__(self, views: GraspViews, device: torch.device) -> None:
        self._tensors = [torch.from_numpy(np.ascontiguousarray(array)).to(device) for array in views]

    def __len__(self) -> int:
        return len(self._tensors[0])

    def of(self, numbers: Tensor, centers: int, draw: torch.Generator) -> tuple[Views, GoodGrasps, Tensor, Tensor]:
        """Some views, their good grasps, and the middles (B, 3) and motions (B, 3) of their objects."""
        parts = [tensor[numbers.to(tensor.device)].float() for tensor in self._tensors]
        objects, hands, n_hands, grasps, quality, middle, velocity, motion = parts
        chosen = torch.rand(objects.shape[:2], generator=draw).argsort(dim=1)[:, :centers].to(objects.device)
        seen = torch.arange(hands.shape[1], device=hands.device) < n_hands[:, None]
        return Views(objects, hands, seen, chosen, velocity), good_grasps(grasps, quality), middle, motion


class GraspTrainer:
    """Learns step by step; repeatable from the seed on one device and number of threads.

    Args:
        network: What learns.
        config: How.
        steps: After so many steps it has learned.
        seed: Of everything drawn.
        device: Where.
    """

    def __init__(
        self, network: GraspNetwork, config: GraspTrainingConfig, steps: int, seed: int, device: torch.device
    ) -> None:
        self.network, self.config, self.device = network.to(device), config, device
        self.done, self._steps = 0, steps
        self._optimizer = torch.optim.AdamW(network.parameters(), config.learning_rate, weight_decay=config.decay)
        self._draw = torch.Generator().manual_seed(seed)

    def step(self, views: Batches) -> Losses:
        """Learn from one batch."""
        config = self.config
        for group in self._optimizer.param_groups:
            group["lr"] = 0.5 * config.learning_rate * (1.0 + math.cos(math.pi * min(1.0, self.done / self._steps)))
        numbers = torch.randint(len(views), (config.batch,), generator=self._draw)
        some, good, middle, motion = self._varied(*views.of(numbers, config.centers, self._draw))
        self.network.train()
        # Half of the digits are enough to learn from, and take a third of the time.
        with torch.autocast(self.device.type, torch.bfloat16):
            told = self.network(some)
        found = losses(told, centers_of(some), good, middle, motion)
        total = config.grasp * found.grasp + config.quality * found.quality
        total = total + config.middle * found.middle + config.motion * found.motion
        self._optimizer.zero_grad()
        torch.autograd.backward(total)
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), config.clip)
        self._optimizer.step()
        self.done += 1
        return Losses(*(value.detach() for value in found))

    def state(self) -> dict[str, Any]:
        """What learning goes on from."""
        return {
            "network": self.network.state_dict(),
            "optimizer": self._optimizer.state_dict(),
            "draw": self._draw.get_state(),
            "done": self.done,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a state."""
        self.network.load_state_dict(state["network"])
        self._optimizer.load_state_dict(state["optimizer"])
        self._draw.set_state(state["draw"])
        self.done = int(state["done"])

    def _varied(
        self, views: Views, good: GoodGrasps, middle: Tensor, motion: Tensor
    ) -> tuple[Views, GoodGrasps, Tensor, Tensor]:
        """The same turned about the line of sight, with noise."""
        config, count = self.config, len(views.objects)
        angle = config.roll * torch.randn(count, generator=self._draw).to(self.device)
        cos, sin, zero = angle.cos(), angle.sin(), torch.zeros_like(angle)
        rows = ([cos, -sin, zero], [sin, cos, zero], [zero, zero, zero + 1.0])
        turn = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
        objects, hands = (
            cloud @ turn.mT + config.noise * torch.randn(cloud.shape, generator=self._draw).to(self.device)
            for cloud in (views.objects, views.hands)
        )
        velocity, middle, motion = (torch.einsum("bij,bj->bi", turn, way) for way in (views.velocity, middle, motion))
        turned = GoodGrasps(good.places @ turn.mT, turn[:, None] @ good.turns, good.quality)
        return views._replace(objects=objects, hands=hands, velocity=velocity), turned, middle, motion


def centers_of(views: Views) -> Tensor:
    """(B, C, 3) where grasps are told (m)."""
    return views.objects.gather(1, views.centers[..., None].expand(-1, -1, 3))


def scores(network: GraspNetwork, views: Batches, config: GraspTrainingConfig, worth: float = 0.3) -> GraspScores:
    """How well a network tells grasps.

    Args:
        network: It.
        views: Not learned from.
        config: How many at once.
        worth: Grasps of at least this quality count as good.
    """
    network.eval()
    away, told = [], []
    draw = torch.Generator().manual_seed(0)
    with torch.inference_mode():
        for numbers in torch.split(torch.arange(len(views)), 4 * config.batch):
            some, good, middle, motion = views.of(numbers, 2 * config.centers, draw)
            found = network(some)
            told.append(torch.stack([*losses(found, centers_of(some), good, middle, motion)]) * len(numbers))
            away.append(_best_away(found, good, worth))
    best = torch.cat(away)
    best = best[torch.isfinite(best)]
    means = torch.stack(told).sum(dim=0) / max(1, len(views))
    if not len(best):
        return GraspScores(0, math.nan, math.nan, math.nan, float(means[0]), float(means[1]))
    shares = [float((best < limit).float().mean()) for limit in (0.01, 0.02)]
    return GraspScores(len(best), shares[0], shares[1], float(best.median()), float(means[0]), float(means[1]))


def _best_away(found: Grasps, good: GoodGrasps, worth: float) -> Tensor:
    """(B,) distances (m) of the grasps told to be best from good ones; infinite where there is none."""
    best = found.quality.argmax(dim=1)
    ways = distances(found, good)[torch.arange(len(best), device=best.device), best]
    nearest: Tensor = ways.masked_fill(good.quality < worth, torch.inf).amin(dim=1)
    return nearest
