"""Training environments, with encoded observations and actions, on the training scenes.

Infos contain the sums of the reward terms over the episode, see `EpisodeReturns`.
"""

import functools
from collections.abc import Callable

from handover_marl.envs.config import EnvConfig
from handover_marl.envs.constructors import parallel_env
from handover_marl.envs.vector.parallel_vector_env import ParallelVectorEnv
from handover_marl.envs.vector.vector_env import HandoverVectorEnv, vector_env
from handover_marl.envs.wrappers.encode import EncodedEnv, encode
from handover_marl.envs.wrappers.episode_returns import EpisodeReturns
from handover_marl.envs.wrappers.freeze import freeze
from handover_marl.learning.training.arguments import PairArgs, PpoArgs


def make_pair_env(args: PairArgs) -> EncodedEnv:
    """Make the training environment in which giver and receiver learn together."""
    encodings = args.encodings.items()
    features, schemes = ({agent: names[part] for agent, names in encodings} for part in (0, 1))
    return encode(EpisodeReturns(parallel_env(args.make_env_config())), features, schemes)


def make_pair_vector_env(args: PairArgs) -> ParallelVectorEnv:
    """Make `args.envs` environments in which giver and receiver learn together.

    They reset in the step that ends an episode.
    """
    encodings = args.encodings.items()
    features, schemes = ({agent: names[part] for agent, names in encodings} for part in (0, 1))
    config = args.make_env_config()
    return vector_env(
        args.envs,
        None,
        features=features,
        schemes=schemes,
        wrappers=[EpisodeReturns],
        autoreset="same_step",
        config=config,
    )


def make_frozen_env_factory(args: PpoArgs, agent: str, partner: str) -> Callable[[], EncodedEnv]:
    """Return a picklable function that makes the environment of one learning agent.

    Args:
        args: Arguments of the training.
        agent: Agent that learns, "giver" or "receiver".
        partner: Name of the other agent's policy.
    """
    return functools.partial(_make_frozen_env, args, agent, partner, args.make_env_config())


def make_frozen_vector_env_factory(args: PpoArgs, agent: str, partner: str) -> Callable[[int], HandoverVectorEnv]:
    """Return a picklable function that makes a given number of environments of one learning agent.

    They reset in the step that ends an episode.

    Args:
        args: Arguments of the training.
        agent: Agent that learns, "giver" or "receiver".
        partner: Name of the other agent's policy.
    """
    return functools.partial(
        vector_env,
        agent=agent,
        partner=partner,
        features=args.features,
        schemes=args.actions,
        wrappers=[EpisodeReturns],
        autoreset="same_step",
        threads=1,
        config=args.make_env_config(),
    )


def _make_frozen_env(args: PpoArgs, agent: str, partner: str, config: EnvConfig) -> EncodedEnv:
    return encode(freeze(EpisodeReturns(parallel_env(config)), agent, partner), args.features, args.actions)
