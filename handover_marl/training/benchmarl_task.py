"""Handovers as a task of BenchMARL, for all its algorithms. Needs the extra `benchmarl`.

experiment = Experiment(HandoverTask.TAKE.get_task(task_config(args)), MappoConfig.get_from_yaml(), ...)
"""

from collections.abc import Callable
from typing import Any

from benchmarl.environments.common import Task
from benchmarl.environments.pettingzoo.common import PettingZooClass
from tensordict import TensorDictBase
from torchrl.envs import EnvBase, PettingZooWrapper

from handover_marl.protocol.status import EpisodeStatus
from handover_marl.training.pair_run import RECEIVER, PairArgs, pair_env


def task_config(args: PairArgs) -> dict[str, Any]:
    """The task's configuration.

    Args:
        args: What is trained on.

    Returns:
        `args`, and `max_cycles`: decisions after which episodes are cut off.
    """
    return {"args": args, "max_cycles": args.max_cycles}


class HandoverClass(PettingZooClass):  # type: ignore[misc]
    """Two groups of one agent, giver and receiver, who see vectors; critics may see the state.

    Configuration: that of `task_config`.
    """

    def get_env_fun(
        self, num_envs: int, continuous_actions: bool, seed: int | None, device: Any
    ) -> Callable[[], EnvBase]:
        """What makes an environment; BenchMARL puts several side by side."""
        args, state = self.config["args"], self.has_state()
        return lambda: PettingZooWrapper(pair_env(args), return_state=state, seed=seed, device=device)

    def supports_continuous_actions(self) -> bool:
        """They are continuous."""
        return True

    def supports_discrete_actions(self) -> bool:
        """And only that."""
        return False

    def has_state(self) -> bool:
        """Everything observed as one vector, see `HandoverEnv.state`."""
        return True

    def has_render(self, env: EnvBase) -> bool:
        """Training draws nothing."""
        return False

    @staticmethod
    def log_info(batch: TensorDictBase) -> dict[str, float]:
        """Shares of outcomes among the episodes that ended in a batch."""
        ended = batch["next", "done"].flatten()
        status = batch["next", RECEIVER, "info", "status"].flatten()[ended].int()
        return {
            f"collection/{flag.label}": float((status & int(flag)).bool().float().mean())
            for flag in EpisodeStatus
            if flag and len(status)
        }

    @staticmethod
    def env_name() -> str:
        """The environment's name."""
        return "handover"


class HandoverTask(Task):  # type: ignore[misc]
    """The tasks; there is one."""

    TAKE = None

    @staticmethod
    def associated_class() -> type[HandoverClass]:
        """What makes its environments."""
        return HandoverClass
