"""Reader of TorchScript files, which are code."""

import io
from contextlib import AbstractContextManager
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.errors import DataFormatError, OptionError, UnsafeFileError

Array = npt.NDArray[np.float32]


class TorchScriptFunction:
    """TorchScript module that is evaluated for one vector at a time.

    Args:
        content: Content of a TorchScript file; its code runs.
        n_inputs: Length of an input vector.
        n_outputs: Length of an output vector.

    Raises:
        OptionError: PyTorch is not installed.
        Exception: The content cannot be loaded; PyTorch raises exceptions of many kinds.
    """

    def __init__(self, content: bytes, n_inputs: int, n_outputs: int) -> None:
        self._content, self.n_inputs, self.n_outputs = content, n_inputs, n_outputs
        self._module = import_torch().jit.load(io.BytesIO(content), map_location="cpu").eval()

    def __call__(self, inputs: Array) -> Array:
        """Return the outputs (n_outputs,) for inputs (n_inputs,)."""
        torch = import_torch()
        with _single_threaded_inference():
            return np.asarray(self._module(torch.from_numpy(inputs)[None])[0].numpy(), dtype=np.float32)

    def __reduce__(self) -> tuple[Any, ...]:
        return (TorchScriptFunction, (self._content, self.n_inputs, self.n_outputs))

    def compute_output_shape(self) -> tuple[int, ...]:
        """Return the shape of the module's outputs for zeros (1, n_inputs)."""
        torch = import_torch()
        with _single_threaded_inference():
            return tuple(self._module(torch.zeros(1, self.n_inputs)).shape)


def read_torch_script(
    path: Path, content: bytes, agent: str, trust: bool, sizes: tuple[int, int]
) -> TorchScriptFunction:
    """Read a TorchScript module from (1, n) inputs to (1, m) outputs.

    Args:
        path: File, for error messages.
        content: Content of the file.
        agent: Agent that the policy must control.
        trust: Whether the file's code may run.
        sizes: Numbers of inputs and outputs.

    Raises:
        UnsafeFileError: The file is not trusted.
        DataFormatError: The file cannot be loaded, or its spaces do not fit.
        OptionError: PyTorch is not installed.
    """
    if not trust:
        raise UnsafeFileError(
            f"{path}: a TorchScript file is code; pass trust=True (--trust) if you know where it comes from, or "
            "export the policy as .npz"
        )
    import_torch()
    n_inputs, n_outputs = sizes
    try:
        function = TorchScriptFunction(content, n_inputs, n_outputs)
        shape = function.compute_output_shape()
    except Exception as error:  # the file's code may raise anything
        lines = str(error).strip().splitlines() or [""]
        raise DataFormatError(
            f"{path}: not a TorchScript policy with the {agent}'s {n_inputs} inputs "
            f"({type(error).__name__}: {lines[-1]})"
        ) from error
    if shape != (1, n_outputs):
        raise DataFormatError(f"{path}: a {agent}'s action must have shape (1, {n_outputs}), got {shape}")
    return function


def _single_threaded_inference() -> AbstractContextManager[None]:
    # Imports PyTorch.
    from handover_marl.learning.networks.weights import single_threaded_inference

    return single_threaded_inference()


def import_torch() -> ModuleType:
    """Import PyTorch.

    Raises:
        OptionError: PyTorch is not installed.
    """
    try:
        import torch
    except ImportError as error:
        raise OptionError("this policy file needs PyTorch: pip install 'handover-marl[train]'") from error
    return torch
