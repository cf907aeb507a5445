"""Official evaluation setups S0 to S3 and their splits, as functions of the scene number.

A scene number is 100 * subject + 5 * object + trial, for ten subjects, twenty objects and five
trials. Source: Chao et al., HandoverSim, ICRA 2022, Table I.
"""

import operator
from collections.abc import Callable, Collection, Iterable, Sequence
from typing import Literal

import numpy as np

from handover_marl.errors import SceneError, check_name
from handover_marl.execution.options import check_positive_integer

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

# Subjects, objects, trials and hands whose scenes are in each split; a missing key allows all.
_FILTERS: dict[tuple[str, str], dict[str, Collection[object]]] = {
    ("s0", "train"): {"trial": range(4)},
    ("s0", "val"): {"subject": range(2), "trial": [4]},
    ("s0", "test"): {"subject": range(2, 10), "trial": [4]},
    ("s1", "train"): {"subject": [0, 1, 2, 3, 4, 5, 9]},
    ("s1", "val"): {"subject": [6]},
    ("s1", "test"): {"subject": [7, 8]},
    ("s2", "train"): {"side": ["right"]},
    ("s2", "val"): {"subject": range(2), "side": ["left"]},
    ("s2", "test"): {"subject": range(2, 10), "side": ["left"]},
    ("s3", "train"): {"object": set(range(20)) - {3, 7, 11, 15, 19}},
    ("s3", "val"): {"object": [3, 19]},
    ("s3", "test"): {"object": [7, 11, 15]},
}


def list_split_scenes(setup: str, split: str, find_side: Callable[[int], str]) -> tuple[int, ...]:
    """Return the scene numbers of a split in ascending order, the order of the scenes in official result files.

    The setups are "s0" (no held-out factor), "s1" (unseen subjects), "s2" (unseen handedness), "s3" (unseen objects).
    `find_side` returns the hand of a scene, "right" or "left"; it is only called for trial 4 of s2.
    """
    check_name("setup", setup, SETUPS)
    check_name("split", split, SPLITS)
    selected = _FILTERS[setup, split]

    def is_in_split(scene: int) -> bool:
        facts: dict[str, object] = {"subject": scene // 100, "object": scene // 5 % 20, "trial": scene % 5}
        is_chosen = all(facts[name] in selected[name] for name in facts.keys() & selected.keys())
        if not is_chosen or facts["object"] in SKIPPED_OBJECTS:
            return False
        return "side" not in selected or (get_prescribed_side(scene) or find_side(scene)) in selected["side"]

    return tuple(filter(is_in_split, range(N_SCENES)))


def get_prescribed_side(scene: int) -> Literal["left", "right"] | None:
    """Return the hand that DexYCB prescribes in a scene: right in trials 0 and 1, left in 2 and 3, None in trial 4."""
    return None if scene % 5 == 4 else "right" if scene % 5 < 2 else "left"


def choose_scenes(split_ids: tuple[int, ...], scenes: Iterable[int] | None, split_label: str) -> tuple[int, ...]:
    """Return the numbers `scenes`, sorted and without repetitions; None gives all scenes of a split, `split_ids`.

    Raises `SceneError` if a scene is not in the split, or if `scenes` or `split_ids` is empty. `split_label` names the
    split in the message.
    """
    if not split_ids:
        raise SceneError(f"{split_label} has no scenes; choose another split, or a data set with more scenes")
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
            f"scene {foreign[0]} is not in {split_label}, which has {len(split_ids)} scenes, beginning with "
            f"{', '.join(map(str, split_ids[:5]))}; choose scenes of this split or another setup or split"
        )
    if not wanted:
        raise SceneError(f"scenes must not be empty; leave it out to run all {len(split_ids)} of {split_label}")
    return tuple(wanted)


def select_scenes_evenly(scene_ids: Sequence[int], n: int) -> tuple[int, ...]:
    """Return at most n of `scene_ids`, at evenly spaced positions; raise `OptionError` if n < 1."""
    count = min(check_positive_integer("number of scenes", n), len(scene_ids))
    chosen = np.unique(np.linspace(0, len(scene_ids) - 1, count).round().astype(int))
    return tuple(scene_ids[number] for number in chosen.tolist())
