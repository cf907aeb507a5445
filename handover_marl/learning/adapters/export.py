"""Export of trained networks to policy files."""

import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from handover_marl.errors import DataFormatError, OptionError
from handover_marl.learning.adapters.modules import dense_network_from_module
from handover_marl.learning.encodings.custom import is_reference
from handover_marl.learning.encodings.registry import count_features, count_outputs
from handover_marl.learning.policy_files import complete_spec, write_policy


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

    A file contains the weights and the encoding of inputs and outputs, but no code. Before it is written, the network
    in the file is compared with the model on pseudo-random inputs. A model of Stable-Baselines3 that was trained in
    this library's environments has recorded agent, features, action scheme and control period. For a PyTorch module,
    the first three must be passed.

    Args:
        model: Model of Stable-Baselines3 (PPO, A2C, SAC, TD3, DDPG) with dense layers; or PyTorch module of
            linear layers with the same activation between all of them.
        path: File to write; its suffix is .npz.
        agent: Agent that the policy controls, "giver" or "receiver"; default: as in training.
        features: Name of the features that are the inputs, or `module:name`; default: as in training.
        action_scheme: Name of the action scheme that decodes the outputs, or `module:name`; default: as in training.
        control_period: Time between two decisions (s); default: as in training if that is recorded, else 0.1 s.
        normalization: Normalization of the inputs: an `InputNormalization` or, for a model of Stable-Baselines3, a
            `VecNormalize`; default: the normalization in the model's environment, or none.
        origin: Description of the training, for human readers.

    Returns:
        Path of the file.

    Raises:
        OptionError: An argument is missing or contradicts the training.
        UnknownNameError: There is no such agent, or it has no such features or action scheme.
        DataFormatError: The model contains other layers, or its sizes do not fit the encoding.
        ResultsError: The file cannot be written.
    """
    file, recorded = Path(path).expanduser(), {}
    if is_sb3_model(model):
        # Imports Stable-Baselines3, which made the model.
        from handover_marl.learning.adapters.sb3_models import dense_network_from_sb3, get_recorded_encoding

        recorded, network = get_recorded_encoding(model), dense_network_from_sb3(model, normalization)
    else:
        torch = sys.modules.get("torch")  # a module can exist only if PyTorch was imported
        if torch is None or not isinstance(model, torch.nn.Module):
            raise OptionError(
                f"model must be a model of Stable-Baselines3 or a PyTorch module, got {type(model).__name__}"
            )
        network = replace(dense_network_from_module(model), normalization=normalization)
    overrides = {"features": features, "actions": action_scheme, "control_period": control_period, "origin": origin}
    spec = complete_spec("model", agent, recorded, overrides)
    for value in (spec.features, spec.actions):
        if not isinstance(value, str):
            raise OptionError(f"features and action_scheme must be names or text module:name, got {value!r}")
    n_inputs = network.n_inputs if is_reference(spec.features) else count_features(spec.agent, spec.features)
    n_outputs = network.n_outputs if is_reference(spec.actions) else count_outputs(spec.agent, spec.actions)
    if (network.n_inputs, network.n_outputs) != (n_inputs, n_outputs):
        raise DataFormatError(
            f"the model must have {n_inputs} inputs for features {spec.features!r} and {n_outputs} outputs for action "
            f"scheme {spec.actions!r}, got {network.n_inputs} and {network.n_outputs}"
        )
    write_policy(file, spec, network)
    return file


def is_sb3_model(model: object) -> bool:
    """Return whether an object is a model of Stable-Baselines3."""
    # A model can exist only if the package was imported.
    module = sys.modules.get("stable_baselines3.common.base_class")
    return module is not None and isinstance(model, module.BaseAlgorithm)
