"""Policies that run a function or a network on encoded observations."""

import copy
import inspect
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.episode.observations import Observation
from handover_marl.episode.spaces import check_vector
from handover_marl.errors import OptionError
from handover_marl.learning.features import AgentFeatures, make_features
from handover_marl.learning.offers import OFFER_FEATURES
from handover_marl.learning.policy_files import read_policy
from handover_marl.learning.policy_spec import OBSERVATION, DenseNetwork, PolicySpec
from handover_marl.learning.schemes import make_scheme
from handover_marl.policies.policy import Action, Policy, PolicyContext, milliseconds_from_wait


class FunctionPolicy(Policy):
    """Policy that encodes observations, evaluates a function or a network, and decodes its outputs.

    Args:
        context: Robot, task and known grasps of the objects.
        function: Function from inputs to outputs: a plain function, a `TorchFunction` or a `DenseNetwork`.
        spec: Agent, and encoding of inputs and outputs.
        name: Name of the policy in tables and errors.
        label: Unique label of the policy in result files.
        digest: Hash of function and encoding, which becomes `weights_hash`.
        wait: Time for which the robot stays at its waiting pose at the start of an episode (s);
            default: that of the action scheme. Only action schemes that wait have this option.

    Attributes:
        function: Function from inputs to outputs.
        scheme: Action scheme that decodes the outputs.

    Raises:
        OptionError: The function does not fit features or action scheme, or the action scheme has no wait.
    """

    def __init__(
        self,
        context: PolicyContext,
        function: Callable[[Any], Any],
        spec: PolicySpec,
        name: str = "function",
        label: str = "function",
        digest: str = "",
        wait: float | None = None,
    ) -> None:
        self.name = name  # type: ignore[misc]
        self.obs_mode, self._label, self._digest = spec.obs_mode, label, digest
        self.function, self.spec, self.scheme = function, spec, make_scheme(spec.agent, spec.actions, context)
        self._features: AgentFeatures | None = None
        if not (isinstance(spec.features, str) and spec.features == OBSERVATION):
            self._features = make_features(spec.agent, spec.features, context)
        if wait is not None:
            if not self.scheme.wait:
                raise OptionError(f"{name}: action scheme {self.scheme.name!r} has no wait; remove wait={wait}")
            self.scheme.wait = milliseconds_from_wait(wait) / 1000.0
        if isinstance(function, DenseNetwork):
            n_inputs = function.n_inputs if self._features is None else self._features.size
            if (function.n_inputs, function.n_outputs) != (n_inputs, self.scheme.size):
                raise OptionError(
                    f"{name!r} must have {n_inputs} inputs and {self.scheme.size} outputs, got {function.n_inputs} and "
                    f"{function.n_outputs}; pass features and action scheme of its training"
                )
        if isinstance(function, TorchFunction) and self._features is not None:
            self._check_module(function, self._features.size)

    @property
    def label(self) -> str:
        """Unique label of the policy in result files: its name, and a hash unless a name was given."""
        return self._label

    @property
    def weights_hash(self) -> str:
        """Hash of the function's code and values, of weights, and of the encoding."""
        return self._digest

    @property
    def wait(self) -> float:
        """Time for which the robot stays at its waiting pose at the start of an episode (s)."""
        return self.scheme.wait

    @property
    def hold_time(self) -> float:
        """Time between two decisions (s), as in training."""
        return self.spec.control_period

    def reset(self, seed: int | None = None) -> None:
        """Start an episode: forget the last one, and call the method `reset(seed)` of the function if it has one."""
        self.scheme.reset()
        if self._features is not None:
            self._features.reset()
        reset_function(self.function, seed)

    def act(self, observation: Observation) -> Action:
        """Return the action, (8,) of a giver or (9,) of a receiver; evaluate the function if the scheme needs it."""
        if self.scheme.needs_outputs(observation):
            inputs = observation if self._features is None else self._features(observation)
            self.scheme.set_outputs(self.evaluate(inputs))
        return self.scheme.compute_action(observation)

    def evaluate(self, inputs: Any) -> npt.NDArray[np.float32]:
        """Return the outputs (n_outputs,) of the function for encoded inputs: features, or the observation itself.

        Raises:
            ActionError: The outputs are not `n_outputs` finite numbers.
        """
        what = f"outputs of the {self.spec.agent} {self.name!r}"
        return check_vector(what, self.function(inputs), self.scheme.size, "as its action scheme decodes")

    def _check_module(self, function: "TorchFunction", n_inputs: int) -> None:
        """Evaluate a copy of a module on `n_inputs` zeros, so that a wrong size shows before the first episode."""
        try:
            outputs = copy.deepcopy(function)(np.zeros(n_inputs, dtype=np.float32))
            found = f"{outputs.size} outputs" if isinstance(outputs, np.ndarray) else ""
        except Exception as error:  # code of the user
            found = f"{type(error).__name__}: {error}"
        if found not in ("", f"{self.scheme.size} outputs"):
            raise OptionError(
                f"{self.name!r} must have {n_inputs} inputs (features {self.spec.features!r}) and {self.scheme.size} "
                f"outputs, got {found}; pass features and action_scheme of its training"
            )


class TorchFunction:
    """Function that evaluates a PyTorch module for one decision, with one thread and without gradients.

    Random numbers that the module draws come from the seed of the episode; PyTorch's global generator is not changed.

    Args:
        module: Module on the CPU in evaluation mode, from (1, n) inputs, or from a dict of observations, to
            (1, m) outputs.

    Attributes:
        module: The module, as passed.
    """

    def __init__(self, module: Any) -> None:
        import torch

        self.module = module
        parameter = next((value for value in module.parameters() if value.is_floating_point()), None)
        self._dtype = torch.float32 if parameter is None else parameter.dtype
        self._random_state = torch.Generator().manual_seed(0).get_state()

    def reset(self, seed: int | None = None) -> None:
        """Seed the module's random numbers, and call the module's own `reset(seed)` if it has one."""
        import torch

        self._random_state = torch.Generator().manual_seed(seed or 0).get_state()
        reset_function(self.module, seed)

    def __call__(self, inputs: Any) -> Any:
        """Return the module's outputs (m,) for a vector (n,) or a dict of arrays; a value that is no tensor as is."""
        import torch

        from handover_marl.learning.networks.weights import single_threaded_inference

        before = torch.get_rng_state()
        torch.set_rng_state(self._random_state)
        try:
            with single_threaded_inference():
                outputs = self.module(self._make_batch(inputs))
        finally:
            self._random_state = torch.get_rng_state()
            torch.set_rng_state(before)
        if not isinstance(outputs, torch.Tensor):
            return outputs
        outputs = outputs.detach().cpu()
        outputs = outputs.float() if outputs.is_floating_point() else outputs
        return outputs.numpy()[0] if outputs.ndim > 1 and len(outputs) == 1 else outputs.numpy()

    def _make_batch(self, inputs: Any) -> Any:
        import torch

        if isinstance(inputs, Mapping):
            return {key: self._make_batch(value) for key, value in inputs.items()}
        # A copy, because modules may write into their inputs.
        tensor = torch.from_numpy(np.array(inputs))[None]
        return tensor.to(self._dtype) if tensor.is_floating_point() else tensor


def reset_function(function: object, seed: int | None) -> None:
    """Call a function's own `reset(seed)`, if it has a method of this name with the parameter `seed`."""
    reset = getattr(function, "reset", None)
    if callable(reset) and "seed" in inspect.signature(reset).parameters:
        reset(seed=seed)


class LearnedPolicy(FunctionPolicy):
    """Policy that runs the trained network of a policy file, `learned:FILE`.

    Args:
        agent: Agent that the policy controls, "giver" or "receiver".
        context: Robot, task and known grasps of the objects.
        path: Policy file, see `handover_marl.learning.policy_files`.
        trust: Whether code in the file may run, and modules that it names may be imported.
        control_period: Time between two decisions in training (s), for files that do not record it.
        wait: Time for which the robot stays at its waiting pose at the start of an episode (s);
            default: as in training. Only action schemes that wait have this option.

    Raises:
        DataNotFoundError: The file does not exist.
        DataFormatError: The file is damaged or for another agent.
        UnsafeFileError: The file contains code, or names user-defined features or schemes (`module:name`),
            and is not trusted.
        OptionError: The path is missing, an option does not fit the file, or the file is one of giver `adaptive`.
    """

    name = "learned"

    def __init__(
        self,
        agent: str,
        context: PolicyContext,
        path: str | os.PathLike[str] | None = None,
        trust: bool = False,
        control_period: float | None = None,
        wait: float | None = None,
    ) -> None:
        if path is None:
            raise OptionError(f"{agent} 'learned' needs a policy file: learned:FILE, see experiments/")
        file = Path(path).expanduser()
        spec, network, file_label = read_policy(file, agent, trust, control_period=control_period)
        if spec.features == OFFER_FEATURES:
            raise OptionError(
                f"weights of giver 'learned' must map observations to actions, got {file} of train_giver_offers.py; "
                f"pass adaptive:weights={file}"
            )
        super().__init__(context, network, spec, self.name, f"{self.name}:{file_label}", wait=wait)
