"""Creation of batches of episodes for an engine and a device."""

from typing import TypeAlias

from handover_marl.config import WorldConfig
from handover_marl.episode.batch.episodes import EpisodeBatch
from handover_marl.episode.batch.tensor_episodes import TensorEpisodeBatch
from handover_marl.simulation.engines import WARP, BatchBackend, check_backend

#: Batch of episodes on arrays or on tensors.
AnyEpisodeBatch: TypeAlias = EpisodeBatch | TensorEpisodeBatch


def make_episode_batch(config: WorldConfig, count: int, backend: BatchBackend) -> AnyEpisodeBatch:
    """Make a batch of episodes, whose arrays are those of its attribute `arrays`.

    Args:
        config: Simulated world, protocol and limits of the givers.
        count: Number of episodes.
        backend: Engine and device of the simulation.

    Raises:
        OptionError: A package or the device is missing.
    """
    check_backend(backend)
    if backend.name == WARP:
        return TensorEpisodeBatch(config, count, backend.device)
    return EpisodeBatch(config, count)
