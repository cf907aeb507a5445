"""Kinds of data sets, by the first word of their name: `KIND` or `KIND:ARGUMENT`.

To add a kind, add an entry to `KINDS`.
"""

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

from handover_marl.datasets.dataset import Dataset
from handover_marl.datasets.official import OfficialDataset
from handover_marl.errors import DataNotFoundError, OptionError, UnknownNameError
from handover_marl.execution.options import check_path

#: Environment variable with the data folder, for calls without the argument `data_dir`.
DATA_DIR_VARIABLE: Final = "HANDOVER_MARL_DATA"
#: Separates the kind of a data set from the argument.
SEPARATOR: Final = ":"


@dataclass(frozen=True)
class DatasetKind:
    """Kind of data sets.

    Attributes:
        title: Name in reports; reports show `TITLE: ARGUMENT` if the data set's name has an argument.
        usage: Form of the name, for help and errors.
        open_dataset: Function from argument ("" without one), data folder (None without one) and robot to
            the data set.
        note: Sentence below the tables of reports; "" for none.
    """

    title: str
    usage: str
    open_dataset: Callable[[str, str | None, str], Dataset]
    note: str = ""

    @property
    def takes_argument(self) -> bool:
        """Whether the name has an argument."""
        return SEPARATOR in self.usage


def _open_synthetic(argument: str, data_dir: str | None, robot: str) -> Dataset:
    if data_dir is not None:
        raise OptionError(f"synthetic scenes need no data folder, but data_dir is {data_dir}; leave one of them out")
    # DexYCB needs none of the generator's imports, which take long.
    from handover_marl.datasets.synthetic import SyntheticDataset

    return SyntheticDataset(robot)


def _open_generated(argument: str, data_dir: str | None, robot: str) -> Dataset:
    if data_dir is not None:
        raise OptionError(f"generated scenes need no data folder, but data_dir is {data_dir}; leave one of them out")
    from handover_marl.datasets.generated.dataset import GeneratedDataset

    return GeneratedDataset(argument, robot)


def _open_dexycb(argument: str, data_dir: str | None, robot: str) -> Dataset:
    chosen = data_dir or os.environ.get(DATA_DIR_VARIABLE)
    if not chosen:
        raise DataNotFoundError(
            "no data folder given. Set data_dir=, --data-dir or HANDOVER_MARL_DATA to a folder in HandoverSim's "
            "layout (dex-ycb-cache/ and assets/), or take the synthetic scenes (dataset='synthetic')."
        )
    try:
        folder = check_path("data_dir", chosen).resolve()
    except (OSError, ValueError, RuntimeError) as error:
        raise DataNotFoundError(f"data folder {str(chosen)[:200]!r} cannot be used ({error})") from error
    return OfficialDataset(folder, robot)


def _open_custom(argument: str, data_dir: str | None, robot: str) -> Dataset:
    from handover_marl.datasets.custom import open_custom_dataset

    return open_custom_dataset(argument, data_dir, robot)


#: Kinds of data sets by name, in the order of help texts.
KINDS: Mapping[str, DatasetKind] = MappingProxyType(
    {
        "synthetic": DatasetKind(
            title="synthetic scenes",
            usage="synthetic",
            open_dataset=_open_synthetic,
            note="Synthetic scenes are generated: not comparable with published results, which are on DexYCB.",
        ),
        "generated": DatasetKind(
            title="generated scenes",
            usage="generated:n=1000,seed=0",
            open_dataset=_open_generated,
            note="Generated scenes are not comparable with published results, which are on DexYCB.",
        ),
        "dexycb": DatasetKind(title="DexYCB", usage="dexycb", open_dataset=_open_dexycb),
        "own": DatasetKind(
            title="own data",
            usage="own:FOLDER",
            open_dataset=_open_custom,
            note="Own data: not comparable with published results, which are on DexYCB.",
        ),
    }
)


def split_dataset_name(name: str) -> tuple[DatasetKind, str]:
    """Return the kind and the argument of a data set's name.

    Raises:
        UnknownNameError: There is no such kind, or the argument is missing or superfluous.
    """
    text = name if isinstance(name, str) else ""
    kind, separator, argument = text.partition(SEPARATOR)
    if kind not in KINDS or bool(separator) != KINDS[kind].takes_argument or (separator and not argument):
        raise UnknownNameError("dataset", name, ("auto", *(each.usage for each in KINDS.values())))
    return KINDS[kind], argument


def format_dataset_title(name: str) -> str:
    """Return a data set's name in reports, such as "DexYCB"; an unknown name is returned unchanged."""
    try:
        kind, argument = split_dataset_name(name)
    except UnknownNameError:
        return name
    return f"{kind.title}: {argument}" if argument else kind.title


def find_dataset_note(name: str) -> str:
    """Return the sentence that belongs below tables of a data set's results; empty if there is none."""
    try:
        return split_dataset_name(name)[0].note
    except UnknownNameError:
        return ""
