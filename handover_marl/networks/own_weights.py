"""Weights that this library trained, as one small file: numbers in half precision and how they were made, no code.

A NumPy archive: every array of the network by its name, those of one axis (biases, statistics) in single precision,
the others in half, or the large ones of some networks in eight bits with a scale for each row (`name:scale`), and
`about`, JSON: `format`, `kind`, `settings` (what the network is made from) and `made_by`.
"""

import hashlib
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from handover_marl.errors import DataFormatError, DataNotFoundError
from handover_marl.files import brief, check_archive, write_arrays

#: How these files end, by which they are told from other checkpoints.
SUFFIX = ".npz"
_FORMAT, _ABOUT = "handover_marl weights 1", "about"
_LARGEST = 100_000_000  # bytes
_COUNTERS = "num_batches_tracked"
_SCALE, _STEPS = ":scale", 127
_LARGE = 100_000  # numbers of an array that may be kept in eight bits

_Network = TypeVar("_Network", bound="KeptNetwork")


class KeptNetwork(nn.Module):
    """A network that such files hold.

    Attributes:
        kind: Name of the receiver that it is for.
        eight_bits: Whether its large arrays are kept in eight bits.
    """

    kind: ClassVar[str]
    eight_bits: ClassVar[bool] = False

    def settings(self) -> dict[str, Any]:
        """What it is made from: numbers and words."""
        return {}

    @classmethod
    def of(cls: type[_Network], settings: dict[str, Any]) -> _Network:
        """An untrained one."""
        return cls(**settings)


def write_own_weights(path: Path, network: KeptNetwork, made_by: Mapping[str, Any]) -> None:
    """Write a network.

    Args:
        path: The file.
        network: It.
        made_by: How it was trained, for a model card: numbers and words.

    Raises:
        ResultsError: It cannot be written.
    """
    arrays: dict[str, npt.NDArray[Any]] = {}
    for name, value in network.state_dict().items():
        if not name.endswith(_COUNTERS):
            arrays |= _kept(name, value.detach().cpu().numpy(), network.eight_bits)
    about = {"format": _FORMAT, "kind": network.kind, "settings": network.settings(), "made_by": dict(made_by)}
    write_arrays(path, {_ABOUT: np.array(json.dumps(about)), **arrays})


def read_own_weights(path: str | Path, kept: type[_Network]) -> tuple[_Network, str]:
    """The network of a file, on the CPU and ready to tell, and a short hash of the file.

    Args:
        path: The file.
        kept: Which network it holds.

    Raises:
        DataNotFoundError: There is no such file.
        DataFormatError: It is damaged, or holds another network.
    """
    file = Path(path).expanduser()
    try:
        check_archive(file, _LARGEST)
        content = file.read_bytes()
        about, arrays = _parts(content)
        if (about["format"], about["kind"]) != (_FORMAT, kept.kind):
            raise ValueError(f"format {about['format']!r} for {about['kind']!r}, expected {_FORMAT!r}")
        network = kept.of(about["settings"])
        counters = {name: value for name, value in network.state_dict().items() if name.endswith(_COUNTERS)}
        network.load_state_dict({name: torch.from_numpy(value) for name, value in arrays.items()} | counters)
    except OSError as error:
        raise DataNotFoundError(
            f"{file}: cannot read these weights ({error.strerror or error}); train some with "
            f"experiments/train_{kept.kind}.py"
        ) from error
    except Exception as error:  # what NumPy, zipfile and PyTorch raise on damaged bytes has no end
        raise DataFormatError(f"{file}: no weights of this library's for {kept.kind} ({brief(error)})") from error
    if not all(bool(torch.isfinite(value).all()) for value in network.state_dict().values()):
        raise DataFormatError(f"{file}: some of its numbers are not finite")
    return network.eval(), hashlib.sha256(content).hexdigest()[:8]


def _parts(content: bytes) -> tuple[dict[str, Any], dict[str, Any]]:
    """What a file says of itself, and its arrays."""
    with np.load(io.BytesIO(content), allow_pickle=False) as archive:
        about = json.loads(str(archive[_ABOUT]))
        arrays = {name: archive[name].astype(np.float32) for name in archive.files if name != _ABOUT}
    for name in [name for name in arrays if name.endswith(_SCALE)]:
        arrays[name.removesuffix(_SCALE)] *= arrays.pop(name)
    return about, arrays


def _kept(name: str, value: npt.NDArray[Any], eight_bits: bool) -> dict[str, npt.NDArray[Any]]:
    """An array as it is kept, with its scale if it has one."""
    if value.ndim == 1:
        return {name: value.astype(np.float32)}
    if not eight_bits or value.size < _LARGE:
        return {name: value.astype(np.float16)}
    largest = np.abs(value).max(axis=tuple(range(1, value.ndim)), keepdims=True)
    scale = (np.maximum(largest, np.finfo(np.float32).tiny) / _STEPS).astype(np.float32)
    return {name: np.rint(value / scale).astype(np.int8), name + _SCALE: scale}
