"""Training environments, with encoded observations and actions, on the training scenes.

Infos contain the sums of the reward terms over the episode, see `EpisodeReturns`.
"""

import functools
import zlib
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from handover_marl import givers
from handover_marl.envs.arguments import GIVER
from handover_marl.envs.config import EnvConfig
from handover_marl.envs.constructors import parallel_env
from handover_marl.envs.vector.parallel_vector_env import ParallelVectorEnv
from handover_marl.envs.vector.vector_env import HandoverVectorEnv, vector_env
from handover_marl.envs.wrappers.encode import EncodedEnv, encode
from handover_marl.envs.wrappers.episode_returns import EpisodeReturns
from handover_marl.envs.wrappers.freeze import freeze
from handover_marl.episode.observations import Observation
from handover_marl.learning.encodings.custom_features import FeatureExtractor
from handover_marl.learning.features import make_features
from handover_marl.learning.schemes import make_scheme, outputs_from_action
from handover_marl.learning.training.arguments import PairArgs, PpoArgs
from handover_marl.policies.policy import PolicyContext

# Number of episodes whose first decisions are recorded together.
_RECORDED_TOGETHER = 64


def make_pair_env(args: PairArgs) -> EncodedEnv:
    """Make the training environment in which giver and receiver learn together."""
    encodings = args.encodings.items()
    features, schemes = ({agent: names[part] for agent, names in encodings} for part in (0, 1))
    return encode(EpisodeReturns(parallel_env(args.make_env_config())), features, schemes)


def make_pair_vector_env(args: PairArgs) -> ParallelVectorEnv:
    """Make `args.num_envs` environments in which giver and receiver learn together.

    They reset in the step that ends an episode.
    """
    encodings = args.encodings.items()
    features, schemes = ({agent: names[part] for agent, names in encodings} for part in (0, 1))
    config = args.make_env_config()
    return vector_env(
        args.num_envs,
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


def make_frozen_vector_env(args: PpoArgs, agent: str, partner: str, processes: int) -> HandoverVectorEnv:
    """Make `args.resolved_num_envs` environments of one learning agent.

    They reset in the step that ends an episode.

    Args:
        args: Arguments of the training.
        agent: Agent that learns, "giver" or "receiver".
        partner: Name of the other agent's policy.
        processes: Number of processes that simulate the environments.
    """
    return vector_env(
        args.resolved_num_envs,
        agent,
        partner,
        features=args.features,
        schemes=args.actions,
        wrappers=[EpisodeReturns],
        autoreset="same_step",
        processes=processes,
        config=args.make_env_config(),
    )


def record_first_decisions(
    args: PpoArgs, partner: str, teacher: str, count: int, seed: int, processes: int
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Record a giver's first decision in each of several episodes, as examples for a learning giver.

    Args:
        args: Arguments of the training.
        partner: Name of the receiver.
        teacher: Name of the giver whose decisions are recorded.
        count: Number of episodes.
        seed: Seed of the episodes.
        processes: Number of processes that simulate the episodes; results do not depend on it.

    Returns:
        Features (count, m), and outputs (count, k) whose action is the nearest to the teacher's.
    """
    envs = vector_env(
        min(count, _RECORDED_TOGETHER),
        GIVER,
        partner,
        features=_make_teacher_features(args, teacher),
        schemes=args.actions,
        autoreset="disabled",
        processes=processes,
        config=args.make_env_config(),
    )
    size = envs.single_action_space.shape[0]
    seeds = [seed, *[None] * ((count - 1) // envs.num_envs)]
    found = np.concatenate([envs.reset(seed=one)[0] for one in seeds])[:count]
    envs.close()
    return found[:, :-size], found[:, -size:]


def _make_teacher_features(args: PpoArgs, teacher: str) -> type[FeatureExtractor]:
    class TeacherFeatures(FeatureExtractor):
        """Features of the giver, followed by the outputs whose action is the nearest to the teacher's."""

        def __init__(self, context: PolicyContext) -> None:
            super().__init__(context)
            self._features = make_features(GIVER, args.features, context)
            self._scheme = make_scheme(GIVER, args.actions, context)
            self._teacher = givers.make(teacher, args.open_dataset())
            self.size = self._features.size + self._scheme.size

        def reset(self) -> None:
            self._features.reset()

        def __call__(self, observation: Observation) -> npt.NDArray[np.float32]:
            # Each observation gets a seed of its own, which does not depend on the other environments.
            self._teacher.reset(zlib.crc32(observation["object_poses"].tobytes()))
            action = self._teacher.act(observation)
            outputs = outputs_from_action(self._scheme, action, observation)
            return np.concatenate([self._features(observation), outputs]).astype(np.float32)

    return TeacherFeatures


def _make_frozen_env(args: PpoArgs, agent: str, partner: str, config: EnvConfig) -> EncodedEnv:
    return encode(freeze(EpisodeReturns(parallel_env(config)), agent, partner), args.features, args.actions)
