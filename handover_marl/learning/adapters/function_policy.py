"""Policies that run a function or a network on encoded observations."""

import copy
import inspect
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from handover_marl.episode.observations import Observation
from handover_marl.episode.spaces import check_vector
from handover_marl.errors import OptionError
from handover_marl.geometry.arrays import NUMPY_ARRAYS, AnyArray, AnyIndices, ArrayFactory, to_numpy
from handover_marl.grasps.selector import LowestCostGraspSelector
from handover_marl.learning.adaptive_giver import OFFER_FEATURES
from handover_marl.learning.encodings.custom import FEATURES, SCHEME, CustomScheme, is_reference
from handover_marl.learning.encodings.features import ArrayFeatures
from handover_marl.learning.encodings.registry import list_features, make_array_features, make_array_scheme
from handover_marl.learning.policy_files import OBSERVATION, DenseNetwork, PolicySpec, read_policy
from handover_marl.policies.batch import ArrayPolicy
from handover_marl.policies.hashing import hash_object
from handover_marl.policies.policy import PolicyContext, milliseconds_from_wait
from handover_marl.policies.registry import import_reference

_MEANING = "inputs of its action scheme"


class FunctionPolicy(ArrayPolicy):
    """Policy that computes features of observations, evaluates a function or network, and decodes the outputs.

    Args:
        context: Robot, task and known grasps of the objects.
        function: Function from inputs to outputs: a plain function, a `TorchFunction` or a `DenseNetwork`.
        spec: Agent, and encoding of inputs and outputs.
        name: Name of the policy in tables and errors.
        label: Unique label of the policy in result files.
        digest: Hash of function, weights and encoding, the first part of `weights_hash`.
        wait: Time for which the robot stays at its waiting pose at the start of an episode (s);
            default: as in the action scheme. An action scheme without a wait raises OptionError.

    Attributes:
        function: Function from inputs to outputs.
        scheme: Action scheme that decodes the outputs.
        spec: Agent, and encoding of inputs and outputs.
        label: Unique label of the policy in result files.
        weights_hash: `digest`, then a hash of features and action scheme if `spec` names them as `module:name`.
    """

    label, weights_hash = "", ""

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
        super().__init__(context)
        self.name = name  # type: ignore[misc]
        self.obs_mode, self.label = spec.obs_mode, label
        choices = ((FEATURES, spec.features), (SCHEME, spec.actions))
        encodings = [import_reference(kind, one) for kind, one in choices if is_reference(one)]
        self.weights_hash = digest + (hash_object(encodings)[:16] if encodings else "")
        self.function, self.spec, self._wait = function, spec, wait
        self.allocate(1, NUMPY_ARRAYS)
        if isinstance(function, DenseNetwork):
            n_inputs = function.n_inputs if self._features is None else self._features.size
            if (function.n_inputs, function.n_outputs) != (n_inputs, self.scheme.size):
                raise OptionError(
                    f"{name!r} must have {n_inputs} inputs and {self.scheme.size} outputs, got {function.n_inputs} and "
                    f"{function.n_outputs}; pass features and action scheme of its training"
                )
        if isinstance(function, TorchFunction) and self._features is not None:
            self._check_module(function, self._features.size)

    def allocate(self, count: int, arrays: ArrayFactory) -> None:
        """Create features and action scheme for `count` episodes, in arrays that `arrays` creates."""
        agent, features, actions = self.spec.agent, self.spec.features, self.spec.actions
        self._arrays, selector = arrays, LowestCostGraspSelector(self.context, count, arrays)
        self.scheme = make_array_scheme(agent, actions, self.context, selector, count, arrays)
        self._features: ArrayFeatures | None = None
        if not (isinstance(features, str) and features == OBSERVATION):
            self._features = make_array_features(agent, features, self.context, selector, count, arrays)
        if self._wait is not None:
            if not self.scheme.wait:
                raise OptionError(
                    f"{self.name}: action scheme {self.scheme.name!r} has no wait; remove wait={self._wait}"
                )
            self.scheme.wait = milliseconds_from_wait(self._wait) / 1000.0

    @property
    def wait(self) -> float:
        """Time for which the robot stays at its waiting pose at the start of an episode (s)."""
        return self.scheme.wait

    @property
    def hold_time(self) -> float:
        """Time between two decisions (s): `spec.control_period`."""
        return self.spec.control_period

    @property
    def is_batchable(self) -> bool:
        """Whether `copy_for` works: only for a `DenseNetwork` with built-in features and a built-in action scheme."""
        is_own = self.spec.features not in list_features(self.spec.agent) or isinstance(self.scheme, CustomScheme)
        return isinstance(self.function, DenseNetwork) and not is_own and super().is_batchable

    def copy_for(self, count: int, arrays: ArrayFactory) -> "FunctionPolicy":
        """Return a policy with the same network that acts in `count` episodes at once, see `ArrayPolicy`.

        Actions in an episode do not depend on the others. They equal those of a policy of one episode: to the bit for
        NumPy arrays, and to 1e-5 for PyTorch tensors.
        """
        policy = copy.copy(self)
        assert isinstance(self.function, DenseNetwork)
        policy.function = self.function.copy_to(arrays)
        policy.allocate(count, arrays)
        return policy

    def start(self, row: int, seed: int | None) -> None:
        """Start the episode with index `row`: reset action scheme, features, and, by `reset_function`, the function."""
        self.scheme.reset(row)
        if self._features is not None:
            self._features.reset(row)
        reset_function(self.function, seed)

    def decide(self, rows: AnyIndices, observation: Observation) -> AnyArray:
        """Return actions (r, 8) or (r, 9) in the episodes `rows`; evaluate the function where the scheme needs it."""
        needs = self._arrays.xp.nonzero(self.scheme.needs_outputs(rows, observation))[0]
        if len(needs):
            some = {key: values[needs] for key, values in observation.items()}
            inputs = some if self._features is None else self._features(rows[needs], some)
            self.scheme.set_outputs(rows[needs], self._evaluate(inputs))
        return self.scheme.compute_actions(rows, observation)

    def _evaluate(self, inputs: Any) -> AnyArray:
        """Return the outputs (r, n_outputs) of the function for r encoded inputs: features, or observations.

        r must be 1 unless the function is a `DenseNetwork`.
        """
        what = f"outputs of the {self.spec.agent} {self.name!r}"
        if not isinstance(self.function, DenseNetwork):
            own = {key: values[0] for key, values in inputs.items()} if self._features is None else inputs[0]
            return check_vector(what, self.function(own), self.scheme.size, _MEANING)[None]
        outputs, xp = self.function(inputs), self._arrays.xp
        for number in xp.nonzero(~xp.all(xp.isfinite(outputs), axis=1))[0].tolist():
            check_vector(what, to_numpy(outputs[number]), self.scheme.size, _MEANING)
        return outputs

    def _check_module(self, function: "TorchFunction", n_inputs: int) -> None:
        """Evaluate a copy of a module on `n_inputs` zeros; raise OptionError for exceptions and wrong output sizes."""
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
    """Callable that evaluates a PyTorch module for one decision, with one thread and without gradients.

    Random numbers that the module draws come from the seed of the episode; PyTorch's global generator is not changed.

    Args:
        module: Module on the CPU in evaluation mode, from inputs (1, n), or from an observation, a dict of tensors
            (1, ...), to outputs (1, m).

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
        """Return the outputs (m,) in NumPy for a vector (n,) or a dict of arrays; keep a result that is no tensor."""
        import torch

        from handover_marl.learning.networks.weights import single_threaded_inference

        with torch.random.fork_rng(devices=[]), single_threaded_inference():
            torch.set_rng_state(self._random_state)
            outputs = self.module(self._make_batch(inputs))
            self._random_state = torch.get_rng_state()
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
    """Call the method `reset` of a callable object, if it has one, with the seed if the method has an argument for it.

    The argument is named `seed`, or is the only required one. A PyTorch module's method without the argument `seed` is
    not called, since it may reset the weights. Two or more required arguments raise OptionError.
    """
    reset = getattr(function, "reset", None)
    parameters = inspect.signature(reset).parameters if callable(reset) else {}
    if not callable(reset) or ("seed" not in parameters and hasattr(function, "state_dict")):
        return
    required = [part for part in parameters.values() if part.default is part.empty]
    if "seed" in parameters or any(part.kind is part.VAR_KEYWORD for part in required):
        reset(seed=seed)
    elif len(required) < 2:
        reset(*[seed][: len(required)])
    else:
        raise OptionError(f"reset of {function!r} must have at most the argument seed, got {', '.join(parameters)}")


class LearnedPolicy(FunctionPolicy):
    """Policy that runs the trained network of a policy file, `learned:FILE`.

    Args:
        agent: Agent that the policy controls, "giver" or "receiver".
        context: Robot, task and known grasps of the objects.
        path: Policy file, see `handover_marl.learning.policy_files`.
        trust: Whether modules that the file names may be imported.
        control_period: Time between two decisions (s); default, and only valid value: that in the file.
        wait: Time for which the robot stays at its waiting pose at the start of an episode (s);
            default: as in the action scheme. An action scheme without a wait raises OptionError.
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
