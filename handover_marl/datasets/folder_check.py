"""Check of a data folder in HandoverSim's layout, for the command `handover-marl doctor`."""

import textwrap
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from rich.console import Console
from rich.progress import track

from handover_marl.datasets.asset_check import (
    OBJECT_URDFS,
    find_hand_faults,
    find_urdf_faults,
    is_hand_complete,
    read_asset,
)
from handover_marl.datasets.dataset import SceneInfo
from handover_marl.datasets.dexycb.raw_files import SEQUENCES_PER_SUBJECT, read_sequence_names
from handover_marl.datasets.dexycb.urdf import build_object_urdf
from handover_marl.datasets.official import OfficialDataset
from handover_marl.datasets.official_files import (
    FileOrigin,
    classify_file_origin,
    find_hand_origin,
    list_required_files,
    read_third_party_checksums,
)
from handover_marl.datasets.scene_files import CACHE_FOLDER
from handover_marl.datasets.splits import N_SCENES, SETUPS, SPLIT_SIZES, SPLITS, list_split_scenes
from handover_marl.errors import DataNotFoundError, HandoverError
from handover_marl.execution.files import has_content
from handover_marl.geometry.ycb import SUBJECTS

_LINE_WIDTH, _NAME_WIDTH = 100, 24  # characters
_MAX_LISTED = 40  # faults of one kind of files
_SIDES = ("left", "right")
_ARCHIVE_ADVICE = "handover-marl import ... --third-party puts HandoverSim's own there"
_STAND_IN, _OTHER = "stand-ins", "other than the known ones"
_HAND_DESCRIPTIONS = {FileOrigin.ORIGINAL: "compiled from MANO", FileOrigin.STAND_IN: "stand-ins"}
_FILE_GROUPS: dict[str, Callable[[str], bool]] = {
    "objects, as they look": lambda path: path.endswith("textured_simple.obj"),
    "objects, convex parts": lambda path: path.endswith("model_normalized_convex.obj"),
    "Panda": lambda path: path.startswith("franka_panda/"),
    "grasps": lambda path: path.startswith("grasps/"),
}


class Severity(Enum):
    """Severity of a finding; the value is its label in the output of `handover-marl doctor`."""

    GOOD = "ok"
    NOTE = "note"
    FAULT = "fault"


@dataclass(frozen=True)
class Finding:
    """Result of one check of a data folder.

    Attributes:
        name: Name of the check.
        result: Result of the check as text.
        severity: GOOD, NOTE (works, but see the advice) or FAULT (something does not work).
        advice: Proposed action for the user, or "".
    """

    name: str
    result: str
    severity: Severity = Severity.GOOD
    advice: str = ""


def format_findings(findings: Iterable[Finding]) -> str:
    """Return findings as text in lines of at most 100 characters, each finding before its advice."""
    lines = []
    for finding in findings:
        lines += _wrap(finding.result, f"{finding.severity.value:6}{finding.name:{_NAME_WIDTH}}")
        lines += _wrap(finding.advice, " " * (6 + _NAME_WIDTH) + "-> ") if finding.advice else []
    return "\n".join(lines)


def _wrap(text: str, start: str) -> list[str]:
    indent = " " * len(start)
    # Names in damaged files may have control characters, which could change a terminal.
    text = "".join(character if character.isprintable() else " " for character in text)
    wrapper = textwrap.TextWrapper(_LINE_WIDTH, start, indent, break_long_words=False, break_on_hyphens=False)
    return wrapper.wrap(text)


def examine_data_folder(data_dir: Path, progress: bool = False) -> tuple[Finding, ...]:
    """Check a data folder in HandoverSim's layout, including the motion of every scene.

    Args:
        data_dir: Data folder.
        progress: Whether to show a progress bar on stderr.
    """
    try:
        dataset = OfficialDataset(data_dir)
    except DataNotFoundError as error:
        return (Finding("data folder", "not there", Severity.FAULT, str(error)),)
    assets = data_dir / "assets"
    scenes = _scan_scenes(dataset, progress)
    used = {(info.subject, info.side) for info in scenes.infos.values()}
    return (
        _check_scenes(scenes),
        _check_scene_numbers(scenes.infos),
        *_check_splits(scenes.infos),
        _count_scene_objects(scenes.infos),
        _check_hands(assets, used),
        *_check_third_party(assets),
        _check_urdfs(assets),
        *_find_leftovers(data_dir),
    )


@dataclass(frozen=True)
class _SceneScan:
    """Descriptions of the readable scenes by number, and the errors of the other scenes."""

    infos: dict[int, SceneInfo]
    faults: list[str]


def _scan_scenes(dataset: OfficialDataset, progress: bool) -> _SceneScan:
    scan = _SceneScan({}, [])
    bar = track(range(N_SCENES), "scenes", console=Console(stderr=True), disable=not progress, transient=True)
    for scene in bar:
        try:
            dataset.load_motion(scene)
            scan.infos[scene] = dataset.load_info(scene)
        except HandoverError as error:
            scan.faults.append(str(error))
    return scan


def _check_scenes(scenes: _SceneScan) -> Finding:
    result = f"{len(scenes.infos)} of {N_SCENES}"
    if not scenes.faults:
        return Finding("scenes", result)
    return Finding("scenes", result, Severity.FAULT, _join_faults(scenes.faults))


def _check_scene_numbers(infos: dict[int, SceneInfo]) -> Finding:
    """Check that DexYCB's recordings have the scene numbers of published results."""
    name, sequence_names = "numbers of scenes", read_sequence_names()
    numbers = {
        f"{subject}/{sequence}": SEQUENCES_PER_SUBJECT * number + rank
        for number, subject in enumerate(SUBJECTS)
        for rank, sequence in enumerate(sequence_names[subject])
    }
    known = [scene for scene, info in infos.items() if info.name in numbers]
    wrong = [scene for scene in known if numbers[infos[scene].name] != scene]
    if wrong:
        first = f"{infos[wrong[0]].name} is scene {numbers[infos[wrong[0]].name]}, here {wrong[0]}"
        advice = f"{first}{_format_remaining(wrong)}; import anew into another folder"
        return Finding(name, f"{len(wrong)} wrong", Severity.FAULT, advice)
    if len(known) < len(infos):
        advice = "other data than DexYCB's, or made up"
        return Finding(name, f"{len(infos) - len(known)} of unknown names", Severity.NOTE, advice)
    return Finding(name, f"{len(known)} as in DexYCB")


def _check_splits(infos: dict[int, SceneInfo]) -> list[Finding]:
    findings = []
    for setup in SETUPS:
        counts, is_complete = [], True
        for split in SPLITS:
            scenes = list_split_scenes(setup, split, lambda scene: infos[scene].side if scene in infos else "right")
            present = sum(scene in infos for scene in scenes)
            # The hands of missing scenes, and so their splits, are unknown; split sizes are not.
            required = len(scenes) if len(infos) == N_SCENES else SPLIT_SIZES[setup, split]
            is_complete &= present == required
            counts.append(f"{split} {present}" if present == required else f"{split} {present} of {required}")
        severity, advice = (Severity.GOOD, "") if is_complete else (Severity.FAULT, "complete the scenes")
        findings.append(Finding(f"setup {setup}", ", ".join(counts), severity, advice))
    return findings


def _count_scene_objects(infos: dict[int, SceneInfo]) -> Finding:
    name, counts = "objects in a scene", Counter(len(info.object_ids) for info in infos.values())
    result = ", ".join(f"{number} in {counts[number]} scene{'s'[: counts[number] > 1]}" for number in sorted(counts))
    if set(counts) == {1}:
        advice = "only the grasped objects; official results use all, which `handover-marl import` reads"
        return Finding(name, result, Severity.NOTE, advice)
    return Finding(name, result or "none")


def _check_hands(assets: Path, used: set[tuple[str, str]]) -> Finding:
    origins: Counter[FileOrigin] = Counter()
    faults = []
    for subject in SUBJECTS:
        for side in _SIDES:
            folder = assets / f"{subject}_{side}"
            if is_hand_complete(folder):
                damages = find_hand_faults(folder)
                faults += damages
                origins[find_hand_origin(folder)] += not damages
            elif not used or (subject, side) in used:
                faults.append(f"{folder.name} lacks files")
    result = ", ".join(f"{origins[origin]} {words}" for origin, words in _HAND_DESCRIPTIONS.items() if origins[origin])
    if faults:
        advice = f"{_join_faults(faults)}; handover-marl import writes hands from MANO's files"
        return Finding("hands", result or "none", Severity.FAULT, advice)
    if origins[FileOrigin.STAND_IN]:
        advice = "results say so; for official numbers `handover-marl import` makes MANO's"
        return Finding("hands", result, Severity.NOTE, advice)
    return Finding("hands", result)


def _check_third_party(assets: Path) -> list[Finding]:
    required = list_required_files()
    return [
        _check_group(name, [path for path in required if belongs(path)], assets)
        for name, belongs in _FILE_GROUPS.items()
    ]


def _check_group(name: str, paths: list[str], assets: Path) -> Finding:
    kinds: Counter[str] = Counter()
    missing, faults = [], []
    for path in paths:
        try:
            content, damages = read_asset(assets, path)
        except OSError:
            missing.append(path)
            continue
        faults += damages
        kinds[_describe_origin(path, content)] += not damages
    result = ", ".join(f"{kinds[kind]} {kind}" for kind in sorted(kinds) if kinds[kind]) or "none"
    # PyBullet's Panda, the stand-in, has other mesh files.
    if missing and not (name == "Panda" and kinds[_STAND_IN]):
        faults.append(f"{missing[0]}{_format_remaining(missing)} missing")
    if faults:
        return Finding(name, result, Severity.FAULT, f"{_join_faults(faults)}; {_ARCHIVE_ADVICE}")
    if kinds[_STAND_IN] or kinds[_OTHER]:
        return Finding(name, result, Severity.NOTE, f"results say so; {_ARCHIVE_ADVICE}")
    return Finding(name, result)


def _describe_origin(path: str, content: bytes) -> str:
    origin = classify_file_origin(path, content)
    if origin is FileOrigin.UNKNOWN:
        return _OTHER if read_third_party_checksums()[path] else "of no known checksum"
    return "equal to the known ones" if origin is FileOrigin.ORIGINAL else _STAND_IN


def _check_urdfs(assets: Path) -> Finding:
    """Check that all URDFs and their meshes can be read, and the text of the objects' URDFs."""
    faults = find_urdf_faults(assets)
    if faults:
        return Finding("URDFs", f"{len(faults)} faults", Severity.FAULT, f"{_join_faults(faults)}; {_ARCHIVE_ADVICE}")
    expected = build_object_urdf().encode()
    foreign = [path for path in sorted(OBJECT_URDFS) if not has_content(assets / path, expected)]
    if foreign:
        advice = f"{foreign[0]}{_format_remaining(foreign)} is not HandoverSim's text"
        return Finding("URDFs", "all", Severity.NOTE, advice)
    return Finding("URDFs", "all")


def _find_leftovers(data_dir: Path) -> Iterable[Finding]:
    """Find the temporary files of an interrupted import."""
    paths = sorted(path for folder in (CACHE_FOLDER, "assets") for path in (data_dir / folder).rglob(".*.part"))
    if paths:
        advice = f"{paths[0]}{_format_remaining(paths)} may be removed"
        yield Finding("leftovers", f"{len(paths)} files", Severity.NOTE, advice)


def _join_faults(faults: Sequence[str]) -> str:
    return "; ".join(faults[:_MAX_LISTED]) + _format_remaining(faults[_MAX_LISTED - 1 :])


def _format_remaining(items: Sequence[object]) -> str:
    return f" (and {len(items) - 1} more)" if len(items) > 1 else ""
