"""What a replay says beside what it shows: how things stand at each moment, and what happened when."""

from handover_marl.config import TIME_STEP
from handover_marl.pictures.replay_recorder import EpisodeLog, Moment
from handover_marl.protocol.release import Release

_LET_GO = {
    Release.ACTIVE: "the person lets go of what the fingers hold",
    Release.PASSIVE: "the person lets go of what the robot pushes",
    Release.GIVEN: "the person lets go of its own accord",
}


def words_of(log: EpisodeLog, moment: Moment) -> str:
    """How things stand, in a few words, with the time (s)."""
    told = [f"{moment.step * TIME_STEP:.2f} s"]
    if moment.step == log.moments[-1].step and log.status:
        told.append(log.status.label)
    elif moment.released:
        told.append("let go")
    else:
        told.append("held out" if moment.held_out else "lies")
    if moment.on_hand:
        told.append("robot on hand")
    if all(len(points) for points in moment.finger_points):
        told.append("both fingers on object")
    elif moment.on_object:
        told.append("robot on object")
    return " - ".join(told)


def events_of(log: EpisodeLog) -> list[tuple[float, str]]:
    """What happened when (s), in order; to a moment, but for the release and the end, which are told to the step."""
    found: list[tuple[int, str]] = []
    firsts = {
        "the person has picked the object up": [moment.held_out for moment in log.moments],
        "the robot touches the object": [moment.on_object for moment in log.moments],
        "both fingers are on the object": [all(map(len, moment.finger_points)) for moment in log.moments],
    }
    for words, flags in firsts.items():
        if any(flags):
            found.append((log.moments[flags.index(True)].step, words))
    if log.release is not None and log.release_step is not None:
        found.append((log.release_step, _LET_GO[log.release]))
    found.append((log.moments[-1].step, log.status.label if log.status else "the recording ends"))
    return [(step * TIME_STEP, words) for step, words in sorted(found, key=lambda event: event[0])]
