"""Opening of data sets by name, `KIND` or `KIND:ARGUMENT`."""

import os
from collections.abc import Mapping
from types import MappingProxyType
from typing import Final, NamedTuple

from handover_marl.datasets.dataset import Dataset
from handover_marl.datasets.official import OfficialDataset
from handover_marl.errors import DataNotFoundError, OptionError, UnknownNameError
from handover_marl.execution.options import check_path
from handover_marl.geometry.panda import PANDA

#: Environment variable with the data folder, for calls without the argument `data_dir`.
DATA_DIR_VARIABLE: Final = "HANDOVER_MARL_DATA"
#: Name that stands for DexYCB if a data folder is given or set, else for the synthetic scenes.
AUTO: Final = "auto"


class DatasetKind(NamedTuple):
    """Kind of data sets, such as DexYCB or generated scenes, and its texts in reports and errors.

    Attributes:
        title: Name in reports; reports show `TITLE: ARGUMENT` if the data set's name has an argument.
        usage: Example of the name, for help and errors; with a ":", names of this kind need an argument.
        note: Sentence below the tables of reports; "" for none.
    """

    title: str
    usage: str
    note: str = ""


_NOTE = "not comparable with published results, which are on DexYCB."
#: Kinds of data sets by name, in the order of help texts.
KINDS: Mapping[str, DatasetKind] = MappingProxyType(
    {
        "synthetic": DatasetKind("synthetic scenes", "synthetic", f"Synthetic scenes are generated: {_NOTE}"),
        "generated": DatasetKind("generated scenes", "generated:n=1000,seed=0", f"Generated scenes are {_NOTE}"),
        "dexycb": DatasetKind("DexYCB", "dexycb"),
        "own": DatasetKind("own data", "own:FOLDER", f"Own data: {_NOTE}"),
    }
)


def open_dataset(dataset: str = AUTO, data_dir: str | os.PathLike[str] | None = None, robot: str = PANDA) -> Dataset:
    """Return a data set by name.

    Args:
        dataset: "synthetic", "generated:n=1000,seed=0", "dexycb", "own:FOLDER", or "auto": DexYCB if a data folder is
            given or set in `HANDOVER_MARL_DATA`, else the synthetic scenes.
        data_dir: Folder of the data set. Default: for DexYCB the folder in `HANDOVER_MARL_DATA`, for own scenes FOLDER;
            with `data_dir`, own scenes are "own:NAME", with the name in `scenes.json`.
        robot: Variant of the Panda, "panda" or "panda_camera".

    Raises:
        UnknownNameError: The data set, the robot or a parameter of generated scenes does not exist.
        OptionError: `data_dir` is no path, has own scenes of another name, or is passed for synthetic or generated
            scenes; or a parameter of generated scenes has an invalid value.
        DataNotFoundError, DataFormatError: The folder is not given or missing, or its `scenes.json` is damaged.
    """
    given = None if data_dir is None else str(check_path("data_dir", data_dir))
    if dataset == AUTO:
        dataset = "dexycb" if given or os.environ.get(DATA_DIR_VARIABLE) else "synthetic"
    kind, argument = _split_name(dataset)
    # DexYCB needs none of the imports of the others, which take long.
    if kind == "dexycb":
        folder = given or os.environ.get(DATA_DIR_VARIABLE)
        if not folder:
            raise DataNotFoundError(
                "no data folder given. Set data_dir=, --data-dir or HANDOVER_MARL_DATA to a folder in HandoverSim's "
                "layout (dex-ycb-cache/ and assets/), or take the synthetic scenes (dataset='synthetic')."
            )
        return OfficialDataset(check_path("data_dir", folder).resolve(), robot)
    if kind == "own":
        from handover_marl.datasets.custom.dataset import CustomDataset

        own = CustomDataset(check_path("dataset" if given is None else "data_dir", given or argument).resolve(), robot)
        if given is not None and argument != own.content.name:
            raise OptionError(
                f"data_dir must hold the scenes {argument!r}, got {given} with {own.content.name!r}; pass their folder"
            )
        return own
    if given is not None:
        raise OptionError(f"{kind} scenes need no data folder, but data_dir is {given}; leave one of them out")
    if kind == "generated":
        from handover_marl.datasets.generated.dataset import GeneratedDataset

        return GeneratedDataset(argument, robot)
    from handover_marl.datasets.synthetic import SyntheticDataset

    return SyntheticDataset(robot)


def _split_name(name: str) -> tuple[str, str]:
    """Return kind and argument ("" for none) of a data set's name; raise `UnknownNameError` if the name is invalid."""
    text = name if isinstance(name, str) else ""
    kind, separator, argument = text.partition(":")
    if kind not in KINDS or bool(separator) != (":" in KINDS[kind].usage) or (separator and not argument):
        raise UnknownNameError("dataset", name, ("auto", *(each.usage for each in KINDS.values())))
    return kind, argument


def format_dataset_title(name: str) -> str:
    """Return a data set's title in reports, such as "DexYCB" for "dexycb"; return an unknown name unchanged."""
    try:
        kind, argument = _split_name(name)
    except UnknownNameError:
        return name
    return f"{KINDS[kind].title}: {argument}" if argument else KINDS[kind].title


def find_dataset_note(name: str) -> str:
    """Return the sentence that belongs below tables of a data set's results; "" for none."""
    kind = name.partition(":")[0]
    return KINDS[kind].note if kind in KINDS else ""
