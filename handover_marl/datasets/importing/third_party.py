"""What HandoverSim takes from others: meshes of objects and Panda, and grasps, in an archive of its authors."""

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Final

from handover_marl.datasets.importing.archives import read_members
from handover_marl.datasets.importing.asset_files import put_files
from handover_marl.datasets.official_files import Origin, file_origin, third_party_sums
from handover_marl.errors import DataFormatError

#: The archive, as its authors call it.
ARCHIVE: Final = "assets-3rd-party-20220511.tar.gz"


@dataclass(frozen=True)
class Placed:
    """What was taken from a folder or archive.

    Attributes:
        files: Paths in `assets/`.
        different: Those that are not the known ones.
    """

    files: tuple[str, ...]
    different: tuple[str, ...]


def place_third_party(source: Path, assets: Path) -> Placed:
    """Put the files of a folder or archive where they belong; all is looked at before anything is written.

    Args:
        source: The archive, or the folder that it was unpacked into; its files may lie at any depth.
        assets: HandoverSim's folder `assets`.

    Raises:
        DataNotFoundError, UnsafeFileError, DataFormatError: As `read_members`.
        DataFormatError: The source has none of the files, or one of them twice.
        ResultsError: A file is there with other content, or cannot be written.
    """
    places = _places(source, (member.path for member in read_members(source)))
    different = []
    for member in read_members(source):
        place = places.get(member.path)
        if place is None:
            continue
        content = member.read()
        put_files(assets, {place: content}, over_stand_ins=True)
        if third_party_sums()[place] and file_origin(place, content) is not Origin.ORIGINAL:
            different.append(place)
    return Placed(tuple(sorted(places.values())), tuple(sorted(different)))


def _places(source: Path, paths: Iterable[PurePosixPath]) -> dict[PurePosixPath, str]:
    """Path in the source -> path in `assets/`, for the files that belong there."""
    wanted = third_party_sums()
    roots: defaultdict[PurePosixPath, dict[PurePosixPath, str]] = defaultdict(dict)
    for path in paths:
        for depth in range(len(path.parts)):
            place = "/".join(path.parts[depth:])
            if place in wanted:
                if path in roots[PurePosixPath(*path.parts[:depth])]:
                    raise DataFormatError(f"{source} holds '{path}' twice; download it again")
                roots[PurePosixPath(*path.parts[:depth])][path] = place
    if not roots:
        raise DataFormatError(
            f"{source} holds none of the files that are wanted, such as {next(iter(wanted))}; give {ARCHIVE} of "
            "HandoverSim's authors, or the folder that it was unpacked into"
        )
    if len(roots) > 1:
        first, second, *_ = (str(root) for root in roots)
        raise DataFormatError(
            f"{source} holds such files in '{first}' and in '{second}', so that it is not clear which to take; give "
            "the folder with the right ones"
        )
    return next(iter(roots.values()))
