"""Official evaluation setups S0 to S3 and their splits, as functions of the scene number.

A scene number is 100 * subject + 5 * object + trial, for ten subjects, twenty objects and five
trials. Source: Chao et al., HandoverSim, ICRA 2022, Table I.
"""

import operator
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from handover_marl.errors import OptionError, SceneError, check_name
from handover_marl.execution.files import shorten_text

N_SCENES = 1000
SETUPS = ("s0", "s1", "s2", "s3")
SPLITS = ("train", "val", "test")

#: Official number of scenes in every split (HandoverSim, Table I).
SPLIT_SIZES = {
    (setup, split): size
    for setup, sizes in zip(SETUPS, ((720, 36, 144), (630, 90, 180), (449, 91, 360), (700, 100, 100)), strict=True)
    for split, size in zip(SPLITS, sizes, strict=True)
}

#: Objects 0 (master chef can) and 15 (wood block), too large for the gripper and in no split.
SKIPPED_OBJECTS = frozenset({0, 15})

#: Trials with a prescribed hand: right in the first two, left in the others. Subjects chose the
#: hand of the last trial themselves.
PRESCRIBED_SIDE_TRIALS = range(4)

_ALL_OBJECTS = frozenset(range(20))
_LATER_SUBJECTS = frozenset(range(2, 10))


@dataclass(frozen=True)
class _Filter:
    """Subjects, objects, trials and hand ("right" or "left", None for both) of the scenes of a split."""

    subjects: frozenset[int] = frozenset(range(10))
    objects: frozenset[int] = _ALL_OBJECTS
    trials: frozenset[int] = frozenset(range(5))
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


def list_split_scenes(setup: str, split: str, find_side: Callable[[int], str]) -> tuple[int, ...]:
    """Return the scene numbers of a split in ascending order.

    The position of a scene in this list is its index in the official result files.

    Args:
        setup: "s0" (no held-out factor), "s1" (unseen subjects), "s2" (unseen handedness) or "s3" (unseen objects).
        split: "train", "val" or "test".
        find_side: Function from a scene number to "right" or "left". The function is only called for trial 4 of setup
            s2; the hand of the other trials is prescribed.

    Raises:
        UnknownNameError: The setup or the split does not exist.
    """
    check_name("setup", setup, SETUPS)
    check_name("split", split, SPLITS)
    selected = _FILTERS[setup, split]
    return tuple(scene for scene in range(N_SCENES) if _is_in_split(scene, selected, find_side))


def _is_in_split(scene: int, selected: _Filter, find_side: Callable[[int], str]) -> bool:
    subject, obj, trial = scene // 100, scene // 5 % 20, scene % 5
    if obj in SKIPPED_OBJECTS or subject not in selected.subjects:
        return False
    if obj not in selected.objects or trial not in selected.trials:
        return False
    if selected.side is None:
        return True
    side = get_prescribed_side(scene) if trial in PRESCRIBED_SIDE_TRIALS else find_side(scene)
    return selected.side == side


def get_prescribed_side(scene: int) -> Literal["left", "right"]:
    """Return the hand, prescribed by DexYCB, that the giver of a scene uses.

    Only trials in `PRESCRIBED_SIDE_TRIALS` have a prescribed hand; for other trials, the recording states the hand.
    """
    return "right" if scene % 5 < 2 else "left"


def choose_scenes(split_ids: tuple[int, ...], scenes: Iterable[int] | None, where: str) -> tuple[int, ...]:
    """Return the chosen `scenes` (None for all) among the numbers of a split, in ascending order without repetitions.

    `where` is the name of the split, for errors.

    Raises:
        SceneError: The split or `scenes` is empty, or `scenes` has something other than the split's scene numbers.
    """
    if not split_ids:
        raise SceneError(f"{where} has no scenes; choose another split, or a data set with more scenes")
    if scenes is None:
        return split_ids
    try:
        wanted = sorted({operator.index(scene) for scene in scenes})
    except TypeError as error:
        raise SceneError(f"scenes must be scene numbers such as [209, 214], got {scenes!r}") from error
    known = set(split_ids)
    foreign = [scene for scene in wanted if scene not in known]
    if foreign:
        raise SceneError(
            f"scene {foreign[0]} is not in {where}, which has {len(split_ids)} scenes, beginning with "
            f"{', '.join(map(str, split_ids[:5]))}; choose scenes of this split or another setup or split"
        )
    if not wanted:
        raise SceneError(f"scenes must not be empty; leave it out to run all {len(split_ids)} of {where}")
    return tuple(wanted)


def select_scenes_evenly(scene_ids: Sequence[int], n: int) -> tuple[int, ...]:
    """Return at most n of the scene numbers of a split, evenly spaced over their order.

    Raises:
        OptionError: n is not a whole number of at least 1.
    """
    if isinstance(n, bool) or not isinstance(n, int) or n < 1:
        raise OptionError(f"number of scenes must be a whole number of at least 1, got {shorten_text(n)}")
    chosen = np.unique(np.linspace(0, len(scene_ids) - 1, min(n, len(scene_ids))).round().astype(int))
    return tuple(scene_ids[number] for number in chosen.tolist())
