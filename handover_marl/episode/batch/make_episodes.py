"""Creation of batches of episodes for an engine and a device."""

from handover_marl.config import WorldConfig
from handover_marl.episode.batch.episodes import EpisodeBatch
from handover_marl.simulation.engines import WARP, BatchBackend


def make_episode_batch(config: WorldConfig, count: int, backend: BatchBackend) -> EpisodeBatch:
    """Make a batch of episodes, whose arrays are those of its attribute `arrays`.

    Args:
        config: Simulated world, protocol and limits of the givers.
        count: Number of episodes.
        backend: Engine and device of the simulation.
    """
    if backend.name == WARP:
        raise NotImplementedError("episodes on the device")
    return EpisodeBatch(config, count, backend)
