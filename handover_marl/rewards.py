"""What the agents are rewarded for."""

from handover_marl.protocol.status import EpisodeStatus


def sparse_reward(status: EpisodeStatus) -> float:
    """1 in the step that completes the handover, else 0; the same for both agents."""
    return 1.0 if status & EpisodeStatus.SUCCESS else 0.0
