"""Models of adapted policies: functions, PyTorch modules, networks, and TorchScript or ONNX files.

A model is a small picklable value. `load` makes the function that is called in each decision.
"""

import inspect
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from handover_marl.learning.adapters.onnx_files import read_onnx
from handover_marl.learning.adapters.torch_script import import_torch, read_torch_script
from handover_marl.learning.policy_spec import PolicyFunction

#: Function from inputs (a vector, or the observation) to outputs.
ModelFunction = Callable[[Any], Any]


class Model(ABC):
    """Base class of the models of adapted policies.

    Attributes:
        takes_vectors: Whether inputs are feature vectors by default, rather than observations.
        is_network: Whether the model can be evaluated on zeros in order to check its sizes.
    """

    takes_vectors: ClassVar[bool] = True
    is_network: ClassVar[bool] = True

    @abstractmethod
    def load(self, agent: str, sizes: tuple[int, int] | None) -> ModelFunction:
        """Return the function from inputs to outputs.

        Args:
            agent: Agent that the policy controls, for errors.
            sizes: Numbers of inputs and outputs; None if inputs are observations.

        Raises:
            DataFormatError: A file does not fit.
            OptionError: A package is missing.
        """


@dataclass(frozen=True, eq=False)
class CallableModel(Model):
    """Plain function or callable object; a method `reset(seed)` is called at the start of an episode.

    Attributes:
        function: Function from an observation, or from features, to outputs.
    """

    function: Callable[[Any], Any]
    takes_vectors: ClassVar[bool] = False
    is_network: ClassVar[bool] = False

    def load(self, agent: str, sizes: tuple[int, int] | None) -> ModelFunction:
        """Return the function itself."""
        return self.function


@dataclass(frozen=True, eq=False)
class TorchModel(Model):
    """PyTorch module on the CPU in evaluation mode.

    Attributes:
        module: Module from (1, n) inputs, or from a dict of observations, to (1, m) outputs.
    """

    module: Any

    def load(self, agent: str, sizes: tuple[int, int] | None) -> ModelFunction:
        """Return a function that evaluates the module for one decision."""
        return TorchFunction(self.module)


@dataclass(frozen=True, eq=False)
class NetworkModel(Model):
    """Network of a policy file, or another function with declared sizes.

    Attributes:
        function: Function from features to outputs.
    """

    function: PolicyFunction

    def load(self, agent: str, sizes: tuple[int, int] | None) -> ModelFunction:
        """Return the function itself."""
        return self.function


@dataclass(frozen=True, eq=False)
class GraphModel(Model):
    """TorchScript or ONNX file.

    Attributes:
        path: File, for error messages; its suffix is .pt or .onnx.
        content: Content of the file. The code of a TorchScript file runs.
    """

    path: Path
    content: bytes

    def load(self, agent: str, sizes: tuple[int, int] | None) -> ModelFunction:
        """Return a function that evaluates the file's network for one decision."""
        if sizes is None:
            raise ValueError("graphs take vectors, not observations")
        if self.path.suffix == ".onnx":
            return read_onnx(self.path, self.content, sizes)
        return read_torch_script(self.path, self.content, agent, True, sizes)


class TorchFunction:
    """Function that evaluates a PyTorch module for one decision, with one thread and without gradients.

    Random numbers that the module draws come from the seed of the episode; PyTorch's global generator
    is not changed.

    Args:
        module: Module on the CPU in evaluation mode.
    """

    def __init__(self, module: Any) -> None:
        self._torch = import_torch()
        self._module = module
        parameter = next((value for value in module.parameters() if value.is_floating_point()), None)
        self._dtype = self._torch.float32 if parameter is None else parameter.dtype
        self._random_state = self._torch.Generator().manual_seed(0).get_state()

    def reset(self, seed: int | None = None) -> None:
        """Seed the module's random numbers, and call the module's own `reset(seed)` if it has one."""
        self._random_state = self._torch.Generator().manual_seed(seed or 0).get_state()
        reset_function(self._module, seed)

    def __call__(self, inputs: Any) -> Any:
        """Return the outputs for a vector (n,) or a dict of arrays: a float32 array, or what is no tensor."""
        # Imports PyTorch.
        from handover_marl.learning.networks.weights import single_threaded_inference

        torch = self._torch
        before = torch.get_rng_state()
        torch.set_rng_state(self._random_state)
        try:
            with single_threaded_inference():
                outputs = self._module(self._make_batch(inputs))
        finally:
            self._random_state = torch.get_rng_state()
            torch.set_rng_state(before)
        if not isinstance(outputs, torch.Tensor):
            return outputs
        outputs = outputs.detach().cpu()
        outputs = outputs.float() if outputs.is_floating_point() else outputs
        return outputs.numpy()[0] if outputs.ndim > 1 and len(outputs) == 1 else outputs.numpy()

    def _make_batch(self, inputs: Any) -> Any:
        if isinstance(inputs, Mapping):
            return {key: self._make_batch(value) for key, value in inputs.items()}
        # A copy, because modules may write into their inputs.
        tensor = self._torch.from_numpy(np.array(inputs))[None]
        return tensor.to(self._dtype) if tensor.is_floating_point() else tensor


def reset_function(function: object, seed: int | None) -> None:
    """Call a function's own `reset(seed)`, if it has a method of this name with the parameter `seed`."""
    reset = getattr(function, "reset", None)
    if callable(reset) and "seed" in inspect.signature(reset).parameters:
        reset(seed=seed)
