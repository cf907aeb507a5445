"""Conversion of models of Stable-Baselines3 to networks of policy files. Needs the extra `train`."""

import contextlib
from dataclasses import replace
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import NormalizeObservation
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import VecNormalize
from stable_baselines3.sac.policies import SACPolicy
from stable_baselines3.td3.policies import TD3Policy
from torch import nn

from handover_marl.episode.spaces import giver_action_space, receiver_action_space
from handover_marl.errors import DataFormatError, OptionError
from handover_marl.geometry.arrays import use_default_torch_settings
from handover_marl.learning.adapters.modules import dense_network_from_module, draw_inputs, is_close
from handover_marl.learning.policy_files import RAW_ENCODINGS, DenseNetwork, InputNormalization, OutputBounds

_SPACES = {"giver": giver_action_space, "receiver": receiver_action_space}


def dense_network_from_sb3(
    model: BaseAlgorithm, normalization: VecNormalize | InputNormalization | None = None
) -> DenseNetwork:
    """Convert the deterministic policy of a model to a `DenseNetwork`, with normalization and bounds.

    Args:
        model: Model of PPO, A2C, SAC, TD3 or DDPG with dense layers only.
        normalization: Normalization of the observations; default: as in the model's environment.

    Raises:
        DataFormatError: The model has other layers, or its outputs differ from the network's on pseudo-random inputs.
        OptionError: Actions are no vector, or the environment normalizes by Gymnasium's `NormalizeObservation`.
    """
    where, space, env, is_normalized = type(model).__name__, model.action_space, model.get_env(), False
    with contextlib.suppress(OSError, EOFError):  # closed environments in processes
        is_normalized = env is not None and any(env.env_is_wrapped(NormalizeObservation))
    if is_normalized:
        raise OptionError(
            f"observations of the {where} model must be normalized by VecNormalize, got NormalizeObservation of "
            "Gymnasium, whose statistics a policy cannot use; train with VecNormalize"
        )
    if not isinstance(space, spaces.Box) or len(space.shape) != 1:
        raise OptionError(f"actions of the {where} model must be a vector (Box), got {space}")
    layers, is_squashed = _get_actor(model)
    # The policy gets normalized inputs; the network normalizes them itself.
    plain = replace(
        dense_network_from_module(layers),
        bounds=OutputBounds(space.low.astype(np.float32), space.high.astype(np.float32), is_scaled=is_squashed),
    )
    inputs = draw_inputs(plain.n_inputs)
    try:
        with use_default_torch_settings():
            observations = [spaces.unflatten(model.observation_space, row) for row in inputs]
            expected = np.stack([model.policy.predict(one, deterministic=True)[0] for one in observations])
    except Exception as error:  # code of another library, for spaces of any kind
        raise DataFormatError(
            f"the {where} model does not take {plain.n_inputs} numbers ({type(error).__name__}: {error})"
        ) from error
    if not is_close(plain, inputs, expected):
        raise DataFormatError(f"the {where} model computes something else than its dense layers do")
    found = model.get_vec_normalize_env() if normalization is None else normalization
    return replace(plain, normalization=find_input_normalization(found) if isinstance(found, VecNormalize) else found)


def _get_actor(model: BaseAlgorithm) -> tuple[nn.Module, bool]:
    """Return the module with the layers of the deterministic policy, and whether tanh squashes its outputs."""
    policy: Any = model.policy
    if isinstance(policy, ActorCriticPolicy):
        return nn.Sequential(policy.mlp_extractor.policy_net, policy.action_net), False
    if isinstance(policy, SACPolicy):
        return nn.Sequential(policy.actor.latent_pi, policy.actor.mu, nn.Tanh()), True
    if isinstance(policy, TD3Policy):
        return policy.actor.mu, True
    raise DataFormatError(f"the model must be of PPO, A2C, SAC, TD3 or DDPG, got {type(model).__name__}")


def get_recorded_encoding(model: BaseAlgorithm) -> dict[str, Any]:
    """Return the fields of `PolicySpec` that a model has recorded, by name.

    Environments of this library store their encoding and control period in their action space, which a model keeps. A
    space without an encoding, but with the bounds of a giver's or receiver's actions, gives the agent and its
    `RAW_ENCODINGS`. Other spaces give no encoding.
    """
    space: Any = model.action_space
    recorded = dict(getattr(space, "encoding", {}))
    if not recorded:
        for agent, make_space in _SPACES.items():
            if space == make_space():
                features, actions = RAW_ENCODINGS[agent]
                recorded = {"agent": agent, "features": features, "actions": actions}
    period = getattr(space, "control_period", None)
    return recorded if period is None else recorded | {"control_period": period}


def find_input_normalization(env: VecNormalize) -> InputNormalization | None:
    """Return the normalization of flattened observations by a `VecNormalize`; None if it normalizes rewards only."""
    if not env.norm_obs:
        return None
    space = env.observation_space
    parts: dict[str, spaces.Space[Any]] = dict(space.spaces) if isinstance(space, spaces.Dict) else {"": space}
    normalized = set(parts) if env.norm_obs_keys is None else set(env.norm_obs_keys)
    rows = []
    for key, part in parts.items():
        size = spaces.flatdim(part)
        if key in normalized:
            statistics = env.obs_rms[key] if isinstance(env.obs_rms, dict) else env.obs_rms
            scale = np.sqrt(statistics.var + env.epsilon).ravel()
            rows.append((statistics.mean.ravel(), scale, np.full(size, env.clip_obs)))
        else:
            rows.append((np.zeros(size), np.ones(size), np.full(size, np.inf)))
    return InputNormalization(*(np.concatenate(values).astype(np.float64) for values in zip(*rows, strict=True)))
