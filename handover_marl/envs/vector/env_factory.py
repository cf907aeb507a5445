"""Factory of the environments of one configuration, single or simulated together."""

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from handover_marl.datasets.dataset import Scene
from handover_marl.envs.config import EnvConfig
from handover_marl.envs.handover_env import HandoverEnv
from handover_marl.envs.vector.array_envs import ArrayEnvs, can_use_arrays, check_device_camera
from handover_marl.envs.vector.batch import Envs
from handover_marl.envs.vector.single_envs import SingleEnvs, WrapperFunction, apply_wrapper
from handover_marl.envs.wrappers.encode import encode
from handover_marl.envs.wrappers.freeze import freeze
from handover_marl.envs.wrappers.wrapper import WrappableEnv
from handover_marl.errors import OptionError
from handover_marl.learning.encodings.custom_features import FeaturesLike
from handover_marl.learning.encodings.custom_schemes import SchemeLike
from handover_marl.policies.reference import PolicyLike
from handover_marl.simulation.engines import BatchBackend

# A scene takes 0.7 MB, and 5 ms to read.
_CACHED_SCENES = 512


@dataclass(frozen=True, eq=False)
class EnvFactory:
    """Factory of environments; see `vector_env` for the meaning of the attributes.

    Attributes:
        config: Configuration of each environment.
        agent: Agent that is controlled from outside; None for both agents.
        partner: Policy of the other agent.
        features: Features that replace observations.
        schemes: Action schemes whose outputs replace actions.
        wrappers: Functions or classes that wrap each environment, the innermost first.
        trust: Whether a policy file may run code.
        prepares_episodes: Whether the next episodes may be simulated in advance, because `reset` gets no
            options after the end of an episode.
        backend: Engine and device of environments that are simulated together.
    """

    config: EnvConfig
    agent: str | None
    partner: PolicyLike | None
    features: FeaturesLike | Mapping[str, FeaturesLike] | None
    schemes: SchemeLike | Mapping[str, SchemeLike] | None
    wrappers: Sequence[WrapperFunction]
    trust: bool
    prepares_episodes: bool
    backend: BatchBackend

    @functools.cached_property
    def template(self) -> WrappableEnv:
        """Single environment of the configuration, with its wrappers."""
        return self._make_single()

    @property
    def has_arrays(self) -> bool:
        """Whether the environments are simulated together as arrays."""
        return can_use_arrays(self.template, self.backend)

    def check_device(self) -> None:
        """Check that the environments can be simulated on a device, with the backend "warp".

        Raises:
            OptionError: They must be simulated with "threads".
        """
        check_device_camera(self.template)
        if not self.has_arrays:
            raise OptionError(
                "with backend='warp', environments must have physics='mujoco', render_mode=None and no wrappers but "
                "EpisodeReturns; use backend='threads'"
            )

    def make(self, count: int) -> Envs:
        """Make a number of environments, which are simulated by one thread."""
        if not self.has_arrays:
            return SingleEnvs(self._make_single, count)
        return ArrayEnvs(
            self.template, count, self.partner, self.trust, self.prepares_episodes, self._load_scene, self.backend
        )

    @functools.cached_property
    def _load_scene(self) -> Callable[[int], Scene]:
        return functools.lru_cache(maxsize=_CACHED_SCENES)(self.template.unwrapped.dataset.load_scene)

    def _make_single(self) -> WrappableEnv:
        env: WrappableEnv = HandoverEnv(self.config)
        for wrapper in self.wrappers:
            env = apply_wrapper(wrapper, env)
        if self.agent is not None:
            env = freeze(env, self.agent, self.partner, trust=self.trust)
        return env if self.features is None and self.schemes is None else encode(env, self.features, self.schemes)
