"""Texts on a replay page: state at each frame, and list of events."""

from handover_marl.config import TIME_STEP
from handover_marl.episode.referee import ReleaseReason
from handover_marl.visualization.replay_recorder import EpisodeLog, ReplayFrame

_RELEASE_PHRASES = {
    ReleaseReason.ACTIVE: "the person lets go because the fingers hold the object",
    ReleaseReason.PASSIVE: "the person lets go because the robot pushes the object",
    ReleaseReason.VOLUNTARY: "the person lets go voluntarily",
}


def describe_frame(log: EpisodeLog, frame: ReplayFrame) -> str:
    """Return a text of a few words on the time (s) and the state of an episode at a frame."""
    parts = [f"{frame.step * TIME_STEP:.2f} s"]
    if frame.step == log.frames[-1].step and log.status:
        parts.append(log.status.label)
    elif frame.released:
        parts.append("released")
    else:
        parts.append("held out" if frame.object_offered else "lies")
    if frame.touches_hand:
        parts.append("robot on hand")
    if all(len(points) for points in frame.finger_points):
        parts.append("both fingers on object")
    elif frame.touches_object:
        parts.append("robot on object")
    return " - ".join(parts)


def list_events(log: EpisodeLog) -> list[tuple[float, str]]:
    """Return the times (s) and descriptions of an episode's events, in order.

    The times of the release and of the end are exact. Other events get the time of the next frame.
    """
    flags = {
        "the person has picked the object up": [frame.object_offered for frame in log.frames],
        "the robot touches the object": [frame.touches_object for frame in log.frames],
        "both fingers are on the object": [all(map(len, frame.finger_points)) for frame in log.frames],
    }
    events = [
        (log.frames[occurred.index(True)].step, description) for description, occurred in flags.items() if any(occurred)
    ]
    if log.release is not None and log.release_step is not None:
        events.append((log.release_step, _RELEASE_PHRASES[log.release]))
    events.append((log.frames[-1].step, log.status.label if log.status else "the recording ends"))
    return [(step * TIME_STEP, description) for step, description in sorted(events, key=lambda event: event[0])]
