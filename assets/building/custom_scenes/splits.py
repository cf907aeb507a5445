"""Splits of custom scenes."""

from collections.abc import Iterable

import numpy as np

from handover_marl.datasets.custom.scene_file import ALL_SCENES, SceneFile, check_file_name
from handover_marl.datasets.splits import SETUPS, SPLITS
from handover_marl.errors import OptionError, check_name

#: Ways to divide scenes: by the object that is handed over, by the person, or at random.
DIVISIONS = ("object", "person", "random")


def split_scenes(
    content: SceneFile, name: str, by: str, val: Iterable[str] | float, test: Iterable[str] | float, seed: int
) -> dict[str, tuple[int, ...]]:
    """Return the scene numbers of each split; see `CustomSceneFolder.add_split` for arguments and errors."""
    try:
        check_file_name(name)
    except ValueError as error:
        raise OptionError(f"name {error}") from None
    if name in (*SETUPS, ALL_SCENES):
        raise OptionError(f"name must not be {', '.join(SETUPS)} or {ALL_SCENES}, got {name!r}; choose another one")
    check_name("by", by, DIVISIONS)
    keys = [
        {"object": scene.objects[0], "person": scene.subject, "random": str(number)}[by]
        for number, scene in enumerate(content.scenes)
    ]
    if not keys:
        raise OptionError("a split needs scenes, got none; add a motion first")
    groups = list(dict.fromkeys(keys))
    order = list(np.random.default_rng(seed).permutation(len(groups)))
    parts: dict[str, list[str]] = {"val": [], "test": []}
    for split, chosen in (("val", val), ("test", test)):
        if isinstance(chosen, (int, float)) and not isinstance(chosen, bool):
            if not 0.0 <= chosen < 1.0:
                raise OptionError(f"{split} must be a share from 0 to 1 or names, got {chosen!r}")
            count = round(chosen * len(groups)) or int(chosen > 0.0)
            free = [groups[index] for index in order if groups[index] not in parts["val"]]
            parts[split] = free[:count]
        else:
            parts[split] = [str(key) for key in chosen]  # type: ignore[union-attr]
            for key in parts[split]:
                check_name(by, key, groups)
    both = sorted(set(parts["val"]) & set(parts["test"]))
    if both:
        raise OptionError(f"val and test must not share a name, got {both[0]!r} in both; remove it from one")
    home = {key: split for split, members in parts.items() for key in members}
    setup = {
        split: tuple(number for number, key in enumerate(keys) if home.get(key, "train") == split) for split in SPLITS
    }
    if not setup["train"]:
        raise OptionError(
            f"the train split must not be empty, got all {len(keys)} scenes in val and test; lower the shares"
        )
    return setup
