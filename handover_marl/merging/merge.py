"""One folder of the folders of all shards, whatever was run: benchmark, pair, cross-play, agreement, demonstrations."""

import os
from collections.abc import Sequence
from pathlib import Path

from handover_marl.benchmarking.agreement import AGREEMENT_FILE, Agreement, write_agreement
from handover_marl.benchmarking.crossplay import CSV_FILE, CrossPlay, pair_folder, read_pairs, write_crossplay
from handover_marl.benchmarking.report import Report
from handover_marl.benchmarking.settings import CONFIG_FILE
from handover_marl.demonstrations.demonstrations import Demonstrations
from handover_marl.demonstrations.joining import join
from handover_marl.demonstrations.minari_layout import DATA_FOLDER
from handover_marl.errors import ResultsError
from handover_marl.merging.shard_folders import ShardSet
from handover_marl.sim.engines import EXACT, PHYSICS


def merge(
    folders: Sequence[str | os.PathLike[str]], out: str | os.PathLike[str]
) -> Report | CrossPlay | Agreement | Demonstrations:
    """Make the folder that one run would have written, of the folders of all its shards (`shard="3/16"`).

    Nothing is played, and nothing is written unless all is there.

    Args:
        folders: The folders of the shards, in any order.
        out: The folder to make.

    Returns:
        What the run would have returned.

    Raises:
        ResultsError: The folders are not all the shards of one run, or `out` holds another run or cannot be written.
        DataNotFoundError, DataFormatError: Demonstrations are not finished, or damaged.
    """
    paths, target = [Path(folder).expanduser() for folder in folders], Path(out).expanduser()
    if not paths:
        raise ResultsError("there is nothing to merge: name the folders of the shards")
    if target.resolve() in [path.resolve() for path in paths]:
        raise ResultsError(f"{target} is one of the shards; choose another folder")
    if any((path / CONFIG_FILE).exists() for path in paths):
        return _merge_results(paths, target)
    if any((path / CSV_FILE).exists() for path in paths):
        return _merge_crossplay(paths, target)
    if any((path / AGREEMENT_FILE).exists() for path in paths):
        return _merge_agreement(paths, target)
    raise ResultsError(
        f"{paths[0]} holds no finished shard: neither {CONFIG_FILE}, {CSV_FILE} nor {AGREEMENT_FILE} is in it"
    )


def _merge_agreement(paths: list[Path], target: Path) -> Agreement:
    others = [physics for physics in PHYSICS if physics != EXACT and (paths[0] / physics).is_dir()]
    if len(others) != 1:
        raise ResultsError(
            f"{paths[0]} holds results in {', '.join(others) or 'exact physics alone'}: one kind beside exact is merged"
        )
    exact, other = (ShardSet.read([path / physics for path in paths]) for physics in (EXACT, *others))
    agreement = Agreement(exact.write(target / EXACT), other.write(target / others[0]))
    write_agreement(target, agreement)
    return agreement


def _merge_results(paths: list[Path], target: Path) -> Report | Demonstrations:
    shards = ShardSet.read(paths)
    if not any((path / DATA_FOLDER).is_dir() for path in paths):
        return shards.write(target)
    # Looked at before anything is written.
    parts = [Demonstrations(path) for path in paths]
    shards.write(target)
    join(parts, target)
    return Demonstrations(target)


def _merge_crossplay(paths: list[Path], target: Path) -> CrossPlay:
    pairs = read_pairs(paths[0])
    for path in paths[1:]:
        if read_pairs(path) != pairs:
            raise ResultsError(f"{paths[0]} and {path} are of different runs: others play in them, or in another order")
    shards = {pair: ShardSet.read([path / pair_folder(pair) for path in paths]) for pair in pairs}
    reports = {pair: found.write(target / pair_folder(pair)) for pair, found in shards.items()}
    givers, receivers = (tuple(dict.fromkeys(pair[side] for pair in pairs)) for side in (0, 1))
    result = CrossPlay(givers, receivers, reports)
    write_crossplay(target, result)
    return result
