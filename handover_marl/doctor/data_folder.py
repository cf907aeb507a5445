"""What of a data folder is there, where it comes from, and what to do about what is not."""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.progress import track

from handover_marl.datasets.importing.object_assets import object_urdf
from handover_marl.datasets.importing.raw_layout import SEQUENCES_PER_SUBJECT
from handover_marl.datasets.importing.sequence_names import SEQUENCE_NAMES
from handover_marl.datasets.official import OfficialDataset
from handover_marl.datasets.official_files import (
    N_HAND_MESHES,
    PANDA_FILES,
    Origin,
    file_origin,
    hand_origin,
    needed_files,
    third_party_sums,
)
from handover_marl.datasets.scene import SceneInfo
from handover_marl.datasets.splits import N_SCENES, SETUPS, SPLIT_SIZES, SPLITS, split_scenes
from handover_marl.doctor.findings import Finding, State
from handover_marl.errors import DataNotFoundError, HandoverError
from handover_marl.models.urdf_shapes import named_meshes
from handover_marl.models.ycb import CLASS_NAMES, SUBJECTS

_SIDES = ("left", "right")
_ARCHIVE_ADVICE = "handover-marl import ... --third-party puts HandoverSim's own there"


def examine(data_dir: Path, progress: bool = False) -> tuple[Finding, ...]:
    """Look through a data folder in HandoverSim's layout; every scene's files are read.

    Args:
        data_dir: The folder.
        progress: Whether to show a progress bar on stderr.
    """
    try:
        dataset = OfficialDataset(data_dir)
    except DataNotFoundError as error:
        return (Finding("data folder", "not there", State.FAULT, str(error)),)
    assets = data_dir / "assets"
    scenes = _read_scenes(dataset, progress)
    used = {(info.subject, info.side) for info in scenes.infos.values()}
    return (
        _scenes(scenes),
        _numbers(scenes.infos),
        *_splits(scenes.infos),
        _objects_in_a_scene(scenes.infos),
        *_hands(assets, used),
        *_third_party(assets),
        *_models(assets),
        *_leftovers(data_dir),
    )


@dataclass(frozen=True)
class _Scenes:
    """What is known of the scenes that can be read, by number, and what is wrong with the others."""

    infos: dict[int, SceneInfo]
    faults: list[str]


def _read_scenes(dataset: OfficialDataset, progress: bool) -> _Scenes:
    found = _Scenes({}, [])
    bar = track(range(N_SCENES), "scenes", console=Console(stderr=True), disable=not progress, transient=True)
    for scene in bar:
        try:
            dataset.motion(scene)
            found.infos[scene] = dataset.info(scene)
        except HandoverError as error:
            found.faults.append(str(error))
    return found


def _scenes(scenes: _Scenes) -> Finding:
    found = f"{len(scenes.infos)} of {N_SCENES}"
    if not scenes.faults:
        return Finding("scenes", found)
    return Finding("scenes", found, State.FAULT, f"{scenes.faults[0]}{_more(scenes.faults)}")


def _numbers(infos: dict[int, SceneInfo]) -> Finding:
    """Whether DexYCB's recordings have the numbers that all published results go by."""
    numbers = {
        f"{subject}/{name}": SEQUENCES_PER_SUBJECT * number + rank
        for number, subject in enumerate(SUBJECTS)
        for rank, name in enumerate(SEQUENCE_NAMES[subject])
    }
    known = [scene for scene, info in infos.items() if info.name in numbers]
    wrong = [scene for scene in known if numbers[infos[scene].name] != scene]
    if wrong:
        first = f"{infos[wrong[0]].name} is scene {numbers[infos[wrong[0]].name]}, here {wrong[0]}"
        advice = f"{first}{_more(wrong)}; import anew into another folder"
        return Finding("numbers of scenes", f"{len(wrong)} wrong", State.FAULT, advice)
    if len(known) < len(infos):
        advice = "other data than DexYCB's, or made up"
        return Finding("numbers of scenes", f"{len(infos) - len(known)} of unknown names", State.NOTE, advice)
    return Finding("numbers of scenes", f"{len(known)} as in DexYCB")


def _splits(infos: dict[int, SceneInfo]) -> list[Finding]:
    """Which splits can be run."""
    findings = []
    for setup in SETUPS:
        told, whole = [], True
        for split in SPLITS:
            scenes = split_scenes(setup, split, lambda scene: infos[scene].side if scene in infos else "right")
            there = sum(scene in infos for scene in scenes)
            # While scenes are missing, their hands are unknown and with them the splits; the official sizes are not.
            needed = len(scenes) if len(infos) == N_SCENES else SPLIT_SIZES[setup, split]
            whole &= there == needed
            told.append(f"{split} {there}" if there == needed else f"{split} {there} of {needed}")
        state, advice = (State.GOOD, "") if whole else (State.FAULT, "complete the scenes")
        findings.append(Finding(f"setup {setup}", ", ".join(told), state, advice))
    return findings


def _objects_in_a_scene(infos: dict[int, SceneInfo]) -> Finding:
    counts = Counter(len(info.object_ids) for info in infos.values())
    told = ", ".join(f"{number} in {counts[number]} scene{'s'[: counts[number] > 1]}" for number in sorted(counts))
    if set(counts) == {1}:
        advice = "only the grasped objects; official numbers are with all, which `handover-marl import` reads"
        return Finding("objects in a scene", told, State.NOTE, advice)
    return Finding("objects in a scene", told or "none")


def _hands(assets: Path, used: set[tuple[str, str]]) -> list[Finding]:
    kinds: Counter[Origin] = Counter()
    lacking = []
    for subject in SUBJECTS:
        for side in _SIDES:
            folder = assets / f"{subject}_{side}"
            if not _hand_is_whole(folder):
                if not used or (subject, side) in used:
                    lacking.append(folder.name)
                continue
            kinds[hand_origin(folder)] += 1
    found = ", ".join(
        f"{kinds[kind]} {_HAND_WORDS[kind]}" for kind in (Origin.ORIGINAL, Origin.STAND_IN) if kinds[kind]
    )
    if lacking:
        advice = f"{lacking[0]}{_more(lacking)} lacks files; handover-marl import writes hands from MANO's files"
        return [Finding("hands", found or "none", State.FAULT, advice)]
    if kinds[Origin.STAND_IN]:
        advice = "results say so; for official numbers `handover-marl import` makes MANO's"
        return [Finding("hands", found, State.NOTE, advice)]
    return [Finding("hands", found)]


_HAND_WORDS = {Origin.ORIGINAL: "compiled from MANO", Origin.STAND_IN: "stand-ins"}


def _hand_is_whole(folder: Path) -> bool:
    meshes = [
        folder / "meshes" / kind / f"mesh{n + 1}.obj" for kind in ("visual", "collision") for n in range(N_HAND_MESHES)
    ]
    return all(path.is_file() for path in (folder / "mano.urdf", *meshes))


_GROUPS: dict[str, Callable[[str], bool]] = {
    "objects, as they look": lambda path: path.endswith("textured_simple.obj"),
    "objects, convex parts": lambda path: path.endswith("model_normalized_convex.obj"),
    "Panda": lambda path: path.startswith("franka_panda/"),
    "grasps": lambda path: path.startswith("grasps/"),
}


def _third_party(assets: Path) -> list[Finding]:
    return [
        _group(what, [path for path in needed_files() if belongs(path)], assets) for what, belongs in _GROUPS.items()
    ]


def _group(what: str, paths: list[str], assets: Path) -> Finding:
    kinds: Counter[str] = Counter()
    lacking = []
    for path in paths:
        try:
            kinds[_kind(path, (assets / path).read_bytes())] += 1
        except OSError:
            lacking.append(path)
    found = ", ".join(f"{kinds[kind]} {kind}" for kind in sorted(kinds)) or "none"
    # PyBullet's Panda has meshes of its own.
    if lacking and not (what == "Panda" and kinds[_STAND_IN]):
        return Finding(what, found, State.FAULT, f"{lacking[0]}{_more(lacking)} missing; {_ARCHIVE_ADVICE}")
    if kinds[_STAND_IN] or kinds[_OTHER]:
        return Finding(what, found, State.NOTE, f"results say so; {_ARCHIVE_ADVICE}")
    return Finding(what, found)


_STAND_IN, _OTHER = "stand-ins", "other than the known ones"


def _kind(path: str, content: bytes) -> str:
    origin = file_origin(path, content)
    if origin is Origin.UNKNOWN:
        return _OTHER if third_party_sums()[path] else "of no known checksum"
    return "equal to the known ones" if origin is Origin.ORIGINAL else _STAND_IN


def _models(assets: Path) -> list[Finding]:
    """URDFs: whether they are there, the objects' are the official text, and their meshes exist."""
    expected = object_urdf().encode()
    faults, foreign = [], []
    objects = {f"{name}/model_normalized.urdf" for name in CLASS_NAMES.values()}
    for path in sorted({*objects, "table/table.urdf", *PANDA_FILES.values()}):
        try:
            content = (assets / path).read_bytes()
            named = [(name, mesh) for name, mesh in named_meshes(assets / path) if "camera" not in name]
        except OSError:
            faults.append(f"{path} is missing")
            continue
        faults += [f"{path} names {name}, which is missing" for name, mesh in named if not mesh.is_file()]
        foreign += [path] if path in objects and content != expected else []
    if faults:
        return [
            Finding("URDFs", f"{len(faults)} faults", State.FAULT, f"{faults[0]}{_more(faults)}; {_ARCHIVE_ADVICE}")
        ]
    if foreign:
        return [Finding("URDFs", "all", State.NOTE, f"{foreign[0]}{_more(foreign)} is not HandoverSim's text")]
    return [Finding("URDFs", "all")]


def _leftovers(data_dir: Path) -> Iterable[Finding]:
    """What an import that was killed left under a temporary name."""
    found = sorted(path for folder in ("dex-ycb-cache", "assets") for path in (data_dir / folder).rglob(".*.part"))
    if found:
        yield Finding("leftovers", f"{len(found)} files", State.NOTE, f"{found[0]}{_more(found)} may be removed")


def _more(items: Sequence[object]) -> str:
    return f" (and {len(items) - 1} more)" if len(items) > 1 else ""
