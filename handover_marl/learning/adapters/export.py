"""Export of trained networks to policy files."""

import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from handover_marl.errors import DataFormatError, OptionError, check_name
from handover_marl.learning.adapters.torch_modules import dense_network_from_module
from handover_marl.learning.encodings.choices import is_reference
from handover_marl.learning.features import count_features, list_features
from handover_marl.learning.policy_files import match_control_period, write_policy
from handover_marl.learning.policy_spec import DenseNetwork, InputNormalization, PolicySpec
from handover_marl.learning.schemes import count_outputs, list_schemes


def export_policy(
    model: Any,
    path: str | os.PathLike[str],
    *,
    agent: str | None = None,
    features: str | None = None,
    action_scheme: str | None = None,
    control_period: float | None = None,
    normalization: Any = None,
    origin: str = "",
) -> Path:
    """Write a trained network to a policy file (.npz), which `learned:FILE` loads without PyTorch.

    A file contains weights and the encoding, and no code. The written network is compared with the model on
    random inputs.

    Args:
        model: Model of Stable-Baselines3 (PPO, A2C, SAC, TD3, DDPG) with dense layers; or PyTorch module of
            linear layers with one activation between them.
        path: File to write; its suffix is .npz.
        agent: Agent that the policy controls, "giver" or "receiver"; default: as in training.
        features: Name of the features that are the inputs, or `module:name`; default: as in training.
        action_scheme: Name of the action scheme that decodes the outputs, or `module:name`; default: as
            in training.
        control_period: Time between two decisions (s); default: as in training if that is recorded,
            else 0.1 s.
        normalization: Normalization of the inputs: a `VecNormalize` of Stable-Baselines3 or an
            `InputNormalization`; default: that of the model's environment, or none.
        origin: Description of the training, for human readers.

    Models of Stable-Baselines3 record agent, features, action scheme and control period. For a PyTorch
    module they must be passed.

    Returns:
        Path of the file.

    Raises:
        OptionError: An argument is missing or contradicts the training.
        UnknownNameError: There is no such agent, and there are no such features or action scheme.
        DataFormatError: The model contains other layers, or its sizes do not fit the encoding.
        ResultsError: The file cannot be written.
    """
    file = Path(path).expanduser()
    if file.suffix != ".npz":
        raise OptionError(f"path must end in .npz, got {file}")
    recorded: tuple[str | None, str | None, str | None, float | None] = (None, None, None, None)
    if is_sb3_model(model):
        # Imports Stable-Baselines3, which made the model.
        from handover_marl.learning.adapters.sb3_models import dense_network_from_sb3, get_recorded_encoding

        recorded = get_recorded_encoding(model)
        network = dense_network_from_sb3(model, normalization)
    else:
        torch = sys.modules.get("torch")  # a module can exist only if PyTorch was imported
        if torch is None or not isinstance(model, torch.nn.Module):
            raise OptionError(
                f"model must be a model of Stable-Baselines3 or a PyTorch module, got {type(model).__name__}"
            )
        if normalization is not None and not isinstance(normalization, InputNormalization):
            raise OptionError(f"normalization must be an InputNormalization, got {type(normalization).__name__}")
        network = replace(dense_network_from_module(model), normalization=normalization)
    spec = _make_spec((agent, features, action_scheme, control_period), recorded, origin)
    _check_sizes(network, spec)
    write_policy(file, spec, network)
    return file


def is_sb3_model(model: object) -> bool:
    """Return whether an object is a model of Stable-Baselines3."""
    # A model can exist only if the package was imported.
    module = sys.modules.get("stable_baselines3.common.base_class")
    return module is not None and isinstance(model, module.BaseAlgorithm)


def _make_spec(
    given: tuple[str | None, str | None, str | None, float | None],
    recorded: tuple[str | None, str | None, str | None, float | None],
    origin: str,
) -> PolicySpec:
    """Combine given and recorded agent, features, action scheme and control period."""
    names = ("agent", "features", "action_scheme", "control_period")
    values: dict[str, Any] = {}
    for name, chosen, trained in zip(names, given, recorded, strict=True):
        if chosen is not None and trained is not None and chosen != trained:
            raise OptionError(f"{name} must be {trained!r} as in training, got {chosen!r}; leave it out")
        values[name] = trained if chosen is None else chosen
    period = values.pop("control_period")
    for name, value in values.items():
        if value is None:
            raise OptionError(f"{name} must be given, because the model does not record it")
        if not isinstance(value, str):
            raise OptionError(f"{name} must be a name or text module:name, got {value!r}; a file contains no code")
    agent, features, actions = values.values()
    check_name("agent", agent, ("giver", "receiver"))
    for kind, value, known in (
        (f"features of the {agent}", features, list_features(agent)),
        (f"action scheme of the {agent}", actions, list_schemes(agent)),
    ):
        if not is_reference(value):
            check_name(kind, value, known)
    return PolicySpec(agent, features, actions, match_control_period("policy", period, None), origin)


def _check_sizes(network: DenseNetwork, spec: PolicySpec) -> None:
    wanted = (
        network.n_inputs if is_reference(spec.features) else count_features(spec.agent, spec.features),
        network.n_outputs if is_reference(spec.actions) else count_outputs(spec.agent, spec.actions),
    )
    if (network.n_inputs, network.n_outputs) != wanted:
        raise DataFormatError(
            f"the model must have {wanted[0]} inputs for features {spec.features!r} and {wanted[1]} outputs for action "
            f"scheme {spec.actions!r}, got {network.n_inputs} and {network.n_outputs}"
        )
