"""Reader and writer of network weights as small files without code.

A file is a NumPy archive with one array per parameter: vectors in single precision, others in half
precision, or, for large arrays of some networks, 8-bit integers with a scale per row (`name:scale`).
The entry `about` is JSON: `format`, `kind`, `settings` (arguments of the network) and `made_by` (the training).
"""

import contextlib
import hashlib
import io
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from handover_marl.errors import DataFormatError
from handover_marl.execution.files import write_arrays
from handover_marl.execution.reading import MAX_FILE_BYTES, check_archive, read_arrays, read_plain_file, report_damage
from handover_marl.geometry.arrays import use_default_torch_settings

_FORMAT, _ABOUT = "handover_marl weights 1", "about"
_MAX_BYTES = 100_000_000
_COUNTERS = "num_batches_tracked"
_ZIP_HEADER = b"PK"
_SCALE_SUFFIX, _INT8_MAX = ":scale", 127
_MIN_INT8_SIZE = 100_000

_Network = TypeVar("_Network", bound="SavedNetwork")


@contextlib.contextmanager
def single_threaded_inference() -> Iterator[None]:
    """Compute without gradients, in one thread and with PyTorch's initial settings in a `with` block.

    Results then do not depend on the number of cores, not even by rounding, nor on what the program has set.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with use_default_torch_settings(), torch.inference_mode():
            yield
    finally:
        torch.set_num_threads(before)


@contextlib.contextmanager
def untrained_networks() -> Iterator[None]:
    """Create networks with PyTorch's initial settings in a `with` block; then restore PyTorch's random state."""
    with use_default_torch_settings(), torch.random.fork_rng(devices=[]):
        yield


class SavedNetwork(nn.Module):
    """Base class of networks whose weights can be written to a file and read from it.

    Attributes:
        kind: Name of the kind of network in files; `experiments/training/train_KIND.py` trains it.
        uses_int8: Whether arrays of 100,000 numbers or more are stored as 8-bit integers.
    """

    kind: ClassVar[str]
    uses_int8: ClassVar[bool] = False

    def get_settings(self) -> dict[str, Any]:
        """Return the arguments of the network's constructor by name, in JSON types; none by default."""
        return {}

    @classmethod
    def from_settings(cls: type[_Network], settings: dict[str, Any]) -> _Network:
        """Create an untrained network from the arguments of its constructor, as returned by `get_settings`."""
        return cls(**settings)


def write_network_weights(path: Path, network: SavedNetwork, provenance: Mapping[str, Any]) -> None:
    """Write the weights of a network, with the arguments of its constructor, to a file (.npz).

    The argument `provenance` describes the training in JSON types, for a model card.
    """
    arrays: dict[str, npt.NDArray[Any]] = {}
    for name, value in network.state_dict().items():
        if not name.endswith(_COUNTERS):
            arrays |= _encode_array(name, value.detach().cpu().numpy(), network.uses_int8)
    about = {"format": _FORMAT, "kind": network.kind, "settings": network.get_settings(), "made_by": dict(provenance)}
    write_arrays(path, {_ABOUT: np.array(json.dumps(about)), **arrays})


def read_network_weights(path: str | Path, network_class: type[_Network]) -> tuple[_Network, str]:
    """Read a network of the class `network_class` from a file of weights.

    Returns:
        The network in evaluation mode on the CPU, and a hash of the file (8 hexadecimal digits).

    Raises:
        DataNotFoundError, DataFormatError: The file is missing or damaged, or has another kind of network.
    """
    file = Path(path).expanduser()
    kind = network_class.kind
    advice = f"copy it again, or make one with experiments/training/train_{kind}.py"
    with report_damage(file, f"weight file of {kind}", advice):
        content = read_plain_file(file, _MAX_BYTES)
        about, arrays = _decode_archive(content)
        if (about["format"], about["kind"]) != (_FORMAT, kind):
            raise DataFormatError(f"format {about['format']!r} for {about['kind']!r}, expected {_FORMAT!r}")
        with untrained_networks():
            network = network_class.from_settings(about["settings"])
        counters = {name: value for name, value in network.state_dict().items() if name.endswith(_COUNTERS)}
        network.load_state_dict({name: torch.from_numpy(value) for name, value in arrays.items()} | counters)
        check_finite_weights(network)
    return network.eval(), hashlib.sha256(content).hexdigest()[:8]


def load_tensors(content: bytes) -> Any:
    """Load tensors, and lists or dicts of them, from the content of a file of `torch.save`; run no code from it."""
    if content.startswith(_ZIP_HEADER):  # files of PyTorch before 1.6 are no archives
        check_archive(content, MAX_FILE_BYTES)
    return torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)


def check_finite_weights(module: nn.Module) -> None:
    """Raise DataFormatError unless all parameters and buffers of a module are finite."""
    if not all(bool(torch.isfinite(value).all()) for value in module.state_dict().values()):
        raise DataFormatError("weights must be finite numbers")


def _decode_archive(content: bytes) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the description `about` and the arrays by name, in single precision, of the content of a weight file."""
    stored = read_arrays(content, largest=_MAX_BYTES)
    about = json.loads(str(stored.pop(_ABOUT)))
    arrays = {name: array.astype(np.float32) for name, array in stored.items()}
    for name in [name for name in arrays if name.endswith(_SCALE_SUFFIX)]:
        arrays[name.removesuffix(_SCALE_SUFFIX)] *= arrays.pop(name)
    return about, arrays


def _encode_array(name: str, value: npt.NDArray[Any], uses_int8: bool) -> dict[str, npt.NDArray[Any]]:
    """Return the stored form of a parameter as arrays by name; 8-bit integers have a second array with their scale."""
    if value.ndim == 1:
        return {name: value.astype(np.float32)}
    if not uses_int8 or value.size < _MIN_INT8_SIZE:
        return {name: value.astype(np.float16)}
    largest = np.abs(value).max(axis=tuple(range(1, value.ndim)), keepdims=True)
    scale = (np.maximum(largest, np.finfo(np.float32).tiny) / _INT8_MAX).astype(np.float32)
    return {name: np.rint(value / scale).astype(np.int8), name + _SCALE_SUFFIX: scale}
