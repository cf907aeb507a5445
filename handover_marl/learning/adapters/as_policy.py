"""Conversion of functions, networks and policy files to policies: receivers and givers."""

import copy
import functools
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

from handover_marl.episode.spaces import STATE, has_state, parse_obs_mode
from handover_marl.errors import OptionError
from handover_marl.execution.files import shorten_text
from handover_marl.execution.options import check_boolean
from handover_marl.execution.tasks import pickle_by_value
from handover_marl.learning.adapters.export import is_sb3_model
from handover_marl.learning.adapters.function_policy import FunctionPolicy, TorchFunction
from handover_marl.learning.encodings.custom import FeaturesLike, SchemeLike, is_reference
from handover_marl.learning.encodings.registry import check_encodings, list_features
from handover_marl.learning.policy_files import (
    OBSERVATION,
    RAW_ENCODINGS,
    DenseNetwork,
    PolicySpec,
    complete_spec,
    read_policy,
)
from handover_marl.policies.hashing import find_package, hash_object
from handover_marl.policies.policy import Policy
from handover_marl.policies.reference import PolicyReference

#: Function, PyTorch module, model of Stable-Baselines3, or path of a policy file.
ModelLike: TypeAlias = Callable[..., Any] | str | os.PathLike[str]


def as_receiver(
    policy: ModelLike,
    *,
    control_period: float | None = None,
    obs_mode: str | None = None,
    features: FeaturesLike | None = None,
    action_scheme: SchemeLike | None = None,
    name: str | None = None,
    trust: bool = False,
) -> PolicyReference:
    """Return a receiver that runs a function, a network or a policy file; pass it wherever a receiver can be passed.

    | `policy` | inputs by default | notes |
    |---|---|---|
    | function or callable object | the observation, a dict of arrays | `reset(seed)` is called if it exists |
    | PyTorch module | (1, n) flat observation; with camera data a dict of (1, ...) tensors | copied to the CPU |
    | model of Stable-Baselines3 | as in training | PPO, A2C, SAC, TD3, DDPG |
    | policy file, .npz | as in training | see `handover_marl.export_policy` |

    By default a function or module returns nine target joint positions (rad, m), and other models act as in training.
    The policy is copied: later training of a module does not change the receiver.

    Args:
        policy: See the table.
        control_period: Time between two decisions (s); default: as in training if that is recorded, else 0.1 s.
        obs_mode: Observation mode, e.g. "pointcloud", see `handover_marl.parallel_env`; default: as in training, or
            "state" if that is not recorded.
        features: Features that are the inputs, as in `handover_marl.encode`; "observation" for the observation itself.
        action_scheme: Action scheme that decodes the outputs, as in `handover_marl.encode`.
        name: Name in tables and result folders; default: the name of the function, class or file and a hash.
        trust: Whether modules that a policy file names (features, action scheme) may be imported, which runs code.

    Raises:
        OptionError: The policy does not fit the features or the action scheme, cannot be sent to worker
            processes, is a policy already, or a package is missing.
        UnknownNameError: There are no such features, no such action scheme or observation mode.
        DataNotFoundError: A file does not exist.
        DataFormatError: A file is damaged, or its policy is for the other agent or other spaces.
        UnsafeFileError: A policy file names a module, and `trust` is False.
    """
    parse_obs_mode(obs_mode or STATE)
    overrides = {"features": features, "actions": action_scheme, "control_period": control_period}
    return _adapt("receiver", policy, overrides | {"obs_mode": obs_mode}, name, trust)


def as_giver(
    policy: ModelLike,
    *,
    control_period: float | None = None,
    features: FeaturesLike | None = None,
    action_scheme: SchemeLike | None = None,
    name: str | None = None,
    trust: bool = False,
) -> PolicyReference:
    """Return a giver that runs a function, a network or a policy file; pass it wherever a giver can be passed.

    By default a function or module returns a giver's action (8,), see `handover_marl.givers.make_giver_action`.
    Everything else is as for `as_receiver`, but a giver has no observation mode.
    """
    overrides = {"features": features, "actions": action_scheme, "control_period": control_period}
    return _adapt("giver", policy, overrides, name, trust)


def _adapt(agent: str, policy: Any, overrides: dict[str, Any], name: str | None, trust: bool) -> PolicyReference:
    check_boolean("trust", trust)
    if name is not None and not (isinstance(name, str) and name.strip()):
        raise OptionError(f"name must be text that is not empty, got {name!r}")
    stem, function, spec = _read_model(agent, policy, overrides, trust)
    obs_mode = spec.obs_mode
    check_encodings(agent, spec.features, spec.actions)
    if spec.features in list_features(agent) and not has_state(obs_mode):
        raise OptionError(
            f"obs_mode must include the state that features {spec.features!r} are computed from, got {obs_mode!r}; "
            f"take 'state+{obs_mode}'"
        )
    hashed = function.module if isinstance(function, TorchFunction) else function
    digest = hash_object((hashed, spec.features, spec.actions, spec.control_period, obs_mode))[:16]
    keywords: dict[str, Any] = {"function": function, "spec": spec, "name": name or stem, "digest": digest}
    label = name or f"{stem}@{digest[:8]}"
    try:
        pickled = pickle_by_value(functools.partial(FunctionPolicy, **keywords, label=label))
    except Exception as error:  # pickling a user's object may raise anything
        raise OptionError(
            f"{agent} {stem!r} cannot be sent to worker processes ({type(error).__name__}: {shorten_text(error)}); "
            f"write a subclass of handover_marl.{agent}s.{agent.capitalize()}, which makes what it needs itself"
        ) from error
    # Modules of PyTorch's own layers do not depend on its build.
    packages = {"" if isinstance(function, DenseNetwork) else find_package(policy)} - {"", "torch"}
    packages |= {one.partition(":")[0].partition(".")[0] for one in (spec.features, spec.actions) if is_reference(one)}
    return PolicyReference(agent, name or stem, pickled, packages=tuple(packages))


def _read_model(
    agent: str, policy: Any, overrides: dict[str, Any], trust: bool
) -> tuple[str, Callable[[Any], Any], PolicySpec]:
    """Return the default name of a model, its function from inputs to outputs, and the encoding of these.

    `overrides` has the fields of `PolicySpec` that the caller chose. If observations have no camera data, a PyTorch
    module gets flat vectors by default, else dicts.
    """
    if isinstance(policy, (str, os.PathLike)):
        path = Path(policy).expanduser()
        spec, network, _ = read_policy(path, agent, trust, **overrides)
        return path.stem, network, spec
    if is_sb3_model(policy):
        # Imports Stable-Baselines3, which made the model.
        from handover_marl.learning.adapters.sb3_models import dense_network_from_sb3, get_recorded_encoding

        spec = complete_spec("policy", agent, get_recorded_encoding(policy), overrides)
        return type(policy).__name__, dense_network_from_sb3(policy), spec
    stem, function = _wrap_function(policy)
    features, actions = RAW_ENCODINGS[agent]
    takes_vectors = isinstance(function, TorchFunction) and overrides.get("obs_mode") in (None, STATE)
    recorded = {"features": features if takes_vectors else OBSERVATION, "actions": actions}
    return stem, function, complete_spec("policy", agent, recorded, overrides)


def _wrap_function(policy: Any) -> tuple[str, Callable[[Any], Any]]:
    """Return the name of a plain function, a callable object or a PyTorch module, and a function that evaluates it."""
    if isinstance(policy, (Policy, PolicyReference)) or (isinstance(policy, type) and issubclass(policy, Policy)):
        raise OptionError(
            f"policy must be a function, a network or a file, got the policy {policy!r}; pass it directly"
        )
    torch = sys.modules.get("torch")  # a module of PyTorch can exist only if PyTorch was imported
    if torch is not None and isinstance(policy, torch.nn.Module):
        module = copy.deepcopy(policy).to("cpu").eval().requires_grad_(False)
        return type(policy).__name__, TorchFunction(module)
    if not callable(policy) or isinstance(policy, type):
        raise OptionError(
            f"policy must be a function, a PyTorch module, a model of Stable-Baselines3 or the path of a file, got "
            f"{shorten_text(repr(policy))}"
        )
    function = policy.func if isinstance(policy, functools.partial) else policy
    return str(getattr(function, "__name__", type(function).__name__)).strip("<>"), policy
