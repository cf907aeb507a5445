"""Handover as a BenchMARL task, for all its algorithms. The module needs the extra `benchmarl`.

Example:
    Experiment(HandoverTask.TAKE.get_task(make_task_config(args)), MappoConfig.get_from_yaml(), ...)
"""

from collections.abc import Callable
from typing import Any

from benchmarl.environments.common import Task
from benchmarl.environments.pettingzoo.common import PettingZooClass
from tensordict import TensorDictBase
from torchrl.envs import EnvBase, PettingZooWrapper

from handover_marl.episode.referee import EpisodeStatus
from handover_marl.learning.training.arguments import PairArgs
from handover_marl.learning.training.environments import make_pair_env


def make_task_config(args: PairArgs) -> dict[str, Any]:
    """Return the configuration of the BenchMARL task for training arguments.

    Args:
        args: Arguments of the training.

    Returns:
        `args`, and `max_cycles`, the number of decisions after which episodes are truncated.
    """
    return {"args": args, "max_cycles": args.max_cycles}


class HandoverTaskClass(PettingZooClass):  # type: ignore[misc]
    """BenchMARL task with two groups of one agent, giver and receiver, with vector observations.

    `make_task_config` makes its configuration. Centralized critics observe the environment's state.
    """

    def get_env_fun(
        self, num_envs: int, continuous_actions: bool, seed: int | None, device: Any
    ) -> Callable[[], EnvBase]:
        """Return a function that makes one environment; BenchMARL calls it for each environment."""
        args, state = self.config["args"], self.has_state()
        return lambda: PettingZooWrapper(make_pair_env(args), return_state=state, seed=seed, device=device)

    def supports_continuous_actions(self) -> bool:
        """Return True: actions are continuous."""
        return True

    def supports_discrete_actions(self) -> bool:
        """Return False: actions are continuous."""
        return False

    def has_state(self) -> bool:
        """Return True: the state is all observations as one vector, see `HandoverEnv.state`."""
        return True

    def has_render(self, env: EnvBase) -> bool:
        """Return False: the environment is not rendered."""
        return False

    @staticmethod
    def log_info(batch: TensorDictBase) -> dict[str, float]:
        """Return the rate of each outcome among the episodes that ended in a batch, for logs."""
        ended = batch["next", "done"].flatten()
        status = batch["next", "receiver", "info", "status"].flatten()[ended].int()
        return {
            f"collection/{flag.label}": float((status & int(flag)).bool().float().mean())
            for flag in EpisodeStatus
            if flag and len(status)
        }

    @staticmethod
    def env_name() -> str:
        """Return the environment's name in BenchMARL's logs."""
        return "handover"


class HandoverTask(Task):  # type: ignore[misc]
    """Handover tasks that BenchMARL can train."""

    TAKE: Any = None

    @staticmethod
    def associated_class() -> type[HandoverTaskClass]:
        """Return the class that makes the environments."""
        return HandoverTaskClass
