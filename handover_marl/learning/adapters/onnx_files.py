"""Reader of ONNX files.

An ONNX file is a graph of arithmetic operations and cannot run other code. It may name other files with
weights; the runtime is given no folder to find them in.
"""

import os
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.errors import DataFormatError, OptionError
from handover_marl.execution.files import shorten_text

Array = npt.NDArray[np.float32]

_WEIGHTS_FOLDER = "session.model_external_initializers_file_folder_path"
_TYPES = {"tensor(float)": np.float32, "tensor(double)": np.float64}


class OnnxFunction:
    """ONNX graph that is evaluated for one input at a time, on the CPU with one thread.

    Args:
        content: Content of the ONNX file.
        where: Name of the file in error messages.
        n_inputs: Length of an input vector.
        n_outputs: Length of an output vector.

    Raises:
        DataFormatError: The content is not a graph with one input and finite shapes that fit.
        OptionError: The package onnxruntime is not installed.
    """

    def __init__(self, content: bytes, where: str, n_inputs: int, n_outputs: int) -> None:
        self._content, self._where, self.n_inputs, self.n_outputs = content, where, n_inputs, n_outputs
        self._session = _open_onnx(content, where)
        if len(self._session.get_inputs()) != 1:
            names = ", ".join(part.name for part in self._session.get_inputs())
            raise DataFormatError(f"{where}: an ONNX policy must have one input of shape (1, {n_inputs}), got {names}")
        self._input = self._session.get_inputs()[0]
        if self._input.type not in _TYPES:
            raise DataFormatError(f"{where}: input must be tensor(float) or tensor(double), got {self._input.type}")
        try:
            shape = self(np.zeros(n_inputs, dtype=np.float32)).shape
        except Exception as error:  # the runtime raises exceptions of its own kinds
            raise DataFormatError(
                f"{where}: not an ONNX policy with {n_inputs} inputs ({shorten_text(error)})"
            ) from error
        if shape != (n_outputs,):
            raise DataFormatError(f"{where}: outputs must have shape (1, {n_outputs}), got {(1, *shape)}")

    def __call__(self, inputs: Array) -> Array:
        """Return the outputs (n_outputs,) for inputs (n_inputs,)."""
        feed = {self._input.name: inputs.astype(_TYPES[self._input.type])[None]}
        return np.asarray(self._session.run(None, feed)[0][0], dtype=np.float32)

    def __reduce__(self) -> tuple[Any, ...]:
        return (OnnxFunction, (self._content, self._where, self.n_inputs, self.n_outputs))


def read_onnx(path: Path, content: bytes, sizes: tuple[int, int]) -> OnnxFunction:
    """Read an ONNX graph from (1, n) inputs to (1, m) outputs.

    Args:
        path: File, for error messages.
        content: Content of the file.
        sizes: Numbers of inputs and outputs.

    Raises:
        DataFormatError: The file cannot be loaded, or its shapes do not fit.
        OptionError: The package onnxruntime is not installed.
    """
    return OnnxFunction(content, str(path), *sizes)


def _open_onnx(content: bytes, where: str) -> Any:
    try:
        import onnxruntime
    except ImportError as error:
        raise OptionError(f"{where} needs the package onnxruntime: pip install 'handover-marl[onnx]'") from error
    options = onnxruntime.SessionOptions()
    # Results then do not depend on the number of cores, and warnings about the graph are not printed.
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    # Without this entry the runtime reads files with weights, which a graph may name, in the working folder.
    options.add_session_config_entry(_WEIGHTS_FOLDER, os.devnull)
    try:
        return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # the runtime raises exceptions of its own kinds
        raise DataFormatError(f"{where}: not an ONNX policy ({shorten_text(error)})") from error
