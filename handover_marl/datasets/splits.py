"""The official evaluation setups S0-S3 and their splits, as pure functions of the scene number.

A scene's number is 100 * subject + 5 * object + trial, with ten subjects, twenty objects and five trials.
Source: Chao et al., HandoverSim, ICRA 2022, Table I.
"""

import operator
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Literal

from handover_marl.errors import SceneError, UnknownNameError

N_SCENES = 1000
SETUPS = ("s0", "s1", "s2", "s3")
SPLITS = ("train", "val", "test")

#: Official number of scenes in every split (Table I).
SPLIT_SIZES = {
    ("s0", "train"): 720,
    ("s0", "val"): 36,
    ("s0", "test"): 144,
    ("s1", "train"): 630,
    ("s1", "val"): 90,
    ("s1", "test"): 180,
    ("s2", "train"): 449,
    ("s2", "val"): 91,
    ("s2", "test"): 360,
    ("s3", "train"): 700,
    ("s3", "val"): 100,
    ("s3", "test"): 100,
}

#: Objects (master chef can, wood block) too large for the gripper, in no split.
SKIPPED_OBJECTS = frozenset({0, 15})

#: Trials whose hand was prescribed, right for the first two and left for the others; the last was free.
TRIALS_BY_DESIGN = range(4)

_ALL_SUBJECTS = frozenset(range(10))
_ALL_OBJECTS = frozenset(range(20))
_ALL_TRIALS = frozenset(range(5))
_LATER_SUBJECTS = frozenset(range(2, 10))


@dataclass(frozen=True)
class _Filter:
    """Which scenes belong to a split; `side` None takes both hands."""

    subjects: frozenset[int] = _ALL_SUBJECTS
    objects: frozenset[int] = _ALL_OBJECTS
    trials: frozenset[int] = _ALL_TRIALS
    side: str | None = None


_FILTERS = {
    ("s0", "train"): _Filter(trials=frozenset({0, 1, 2, 3})),
    ("s0", "val"): _Filter(subjects=frozenset({0, 1}), trials=frozenset({4})),
    ("s0", "test"): _Filter(subjects=_LATER_SUBJECTS, trials=frozenset({4})),
    ("s1", "train"): _Filter(subjects=frozenset({0, 1, 2, 3, 4, 5, 9})),
    ("s1", "val"): _Filter(subjects=frozenset({6})),
    ("s1", "test"): _Filter(subjects=frozenset({7, 8})),
    ("s2", "train"): _Filter(side="right"),
    ("s2", "val"): _Filter(subjects=frozenset({0, 1}), side="left"),
    ("s2", "test"): _Filter(subjects=_LATER_SUBJECTS, side="left"),
    ("s3", "train"): _Filter(objects=_ALL_OBJECTS - {3, 7, 11, 15, 19}),
    ("s3", "val"): _Filter(objects=frozenset({3, 19})),
    ("s3", "test"): _Filter(objects=frozenset({7, 11, 15})),
}


def check_setup_and_split(setup: str, split: str) -> None:
    """Raise `UnknownNameError` unless both names exist."""
    if setup not in SETUPS:
        raise UnknownNameError("setup", setup, SETUPS)
    if split not in SPLITS:
        raise UnknownNameError("split", split, SPLITS)


def split_scenes(setup: str, split: str, side_of_scene: Callable[[int], str]) -> tuple[int, ...]:
    """Scene ids of a split, ascending; their positions are the official result files' numbers.

    Args:
        setup: "s0" seen everything, "s1" unseen subjects, "s2" unseen handedness, "s3" unseen objects.
        split: "train", "val" or "test".
        side_of_scene: Gives "right" or "left" for a scene id. Asked only for trial 4 of setup s2, where the
            hand was the subject's choice; trials 0-1 are right-handed and 2-3 left-handed by design.

    Raises:
        UnknownNameError: No such setup or split.
    """
    check_setup_and_split(setup, split)
    chosen = _FILTERS[setup, split]
    return tuple(scene for scene in range(N_SCENES) if _belongs(scene, chosen, side_of_scene))


def _belongs(scene: int, chosen: _Filter, side_of_scene: Callable[[int], str]) -> bool:
    subject, obj, trial = scene // 100, scene // 5 % 20, scene % 5
    if obj in SKIPPED_OBJECTS or subject not in chosen.subjects:
        return False
    if obj not in chosen.objects or trial not in chosen.trials:
        return False
    return chosen.side is None or chosen.side == _side(scene, side_of_scene)


def designed_side(scene: int) -> Literal["left", "right"]:
    """The hand of a scene whose trial is among `TRIALS_BY_DESIGN`."""
    return "right" if scene % 5 < 2 else "left"


def _side(scene: int, side_of_scene: Callable[[int], str]) -> str:
    return designed_side(scene) if scene % 5 in TRIALS_BY_DESIGN else side_of_scene(scene)


def choose_scenes(split_ids: tuple[int, ...], scenes: Iterable[int] | None, where: str) -> tuple[int, ...]:
    """Some scenes of a split, ascending and each once, or all of it.

    Args:
        split_ids: The split.
        scenes: Those wanted, or None for all.
        where: What to call the split in errors.

    Raises:
        SceneError: One is not in the split, or none is wanted, or these are no scene numbers.
    """
    if scenes is None:
        return split_ids
    try:
        wanted = sorted({operator.index(scene) for scene in scenes})
    except TypeError as error:
        raise SceneError(f"scenes={scenes!r}: expected scene numbers, such as [209, 214]") from error
    foreign = [scene for scene in wanted if scene not in split_ids]
    if foreign:
        raise SceneError(
            f"scene {foreign[0]} is not in {where}, which has {len(split_ids)} scenes from {split_ids[0]} to "
            f"{split_ids[-1]}; choose scenes of this split or another setup or split"
        )
    if not wanted:
        raise SceneError(f"no scene chosen; leave scenes out to run all {len(split_ids)} of {where}")
    return tuple(wanted)
