"""Factory of the environments of one configuration, single or simulated together."""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from handover_marl.datasets.dataset import Scene
from handover_marl.envs.arguments import RECEIVER
from handover_marl.envs.custom_rewards import resolve_rewards
from handover_marl.envs.rewards import RewardWeights
from handover_marl.envs.vector.array_envs import ArrayEnvs
from handover_marl.envs.vector.batch import Envs
from handover_marl.envs.vector.single_envs import SingleEnvs
from handover_marl.envs.wrappers.control_agent import FixedPartnerEnv
from handover_marl.envs.wrappers.encode import EncodedEnv
from handover_marl.envs.wrappers.wrapper import EpisodeReturns, WrappableEnv, list_wrappers
from handover_marl.episode.spaces import FULL_POINTCLOUD, STATE, parse_obs_mode
from handover_marl.errors import OptionError
from handover_marl.learning.custom_encodings import is_reference
from handover_marl.simulation.camera.renderers import RAYS, resolve_renderer
from handover_marl.simulation.engines import MUJOCO, WARP, BatchBackend

# A scene takes 0.7 MB, and 5 ms to read.
_CACHED_SCENES = 512


@dataclass(frozen=True, eq=False)
class EnvFactory:
    """Factory of the environments that `vector_env` makes.

    Attributes:
        make_single: Function that makes a single environment, with its wrappers.
        prefetch_episodes: Whether the next episodes may be simulated in advance, because `reset` gets no
            options after the end of an episode.
        backend: Engine and device of environments that are simulated together.
    """

    make_single: Callable[[], WrappableEnv]
    prefetch_episodes: bool
    backend: BatchBackend

    @functools.cached_property
    def template(self) -> WrappableEnv:
        """Single environment of the configuration, with its wrappers."""
        return self.make_single()

    @property
    def uses_arrays(self) -> bool:
        """Whether `ArrayEnvs` simulates the environments together.

        Arrays need MuJoCo's physics, no wrappers but `EpisodeReturns`, `control_agent` and `encode` in this order, and
        either no camera, or "warp" with a camera that passes `check_device`.
        """
        config = self.template.unwrapped.config
        if config.physics != MUJOCO or config.render_mode is not None:
            return False
        if config.obs_mode != STATE and self.backend.name != WARP:
            return False
        wrappers = list_wrappers(self.template)
        if any(isinstance(env, FixedPartnerEnv) and env.policy.obs_mode != STATE for env in wrappers):
            return False
        kinds = [type(env) for env in wrappers]
        return kinds == [kind for kind in (EncodedEnv, FixedPartnerEnv, EpisodeReturns) if kind in kinds]

    def check_device(self) -> None:
        """Check that the environments can be simulated on a device, with the backend "warp".

        Raises:
            OptionError: The environments must be simulated with "threads": for their physics or wrappers, or because
                a camera has data or noise that only "threads" can simulate, or the partner, a user-defined
                reward or a user-defined action scheme observes a camera.
        """
        for is_wrong, need in self._list_camera_faults():
            if is_wrong:
                raise OptionError(f"cameras with backend='warp' need {need}; use backend='threads'")
        if not self.uses_arrays:
            raise OptionError(
                "with backend='warp', environments must have physics='mujoco', render_mode=None and no wrappers but "
                "EpisodeReturns; use backend='threads'"
            )

    def make(self, count: int) -> Envs:
        """Make `count` environments, which one thread simulates."""
        if not self.uses_arrays:
            return SingleEnvs(self.make_single, count)
        return ArrayEnvs(self.template, count, self.prefetch_episodes, self._load_scene, self.backend)

    @functools.cached_property
    def _load_scene(self) -> Callable[[int], Scene]:
        return functools.lru_cache(maxsize=_CACHED_SCENES)(self.template.unwrapped.dataset.load_scene)

    def _list_camera_faults(self) -> list[tuple[bool, str]]:
        """Return pairs: whether a requirement of cameras on a device is violated, and the requirement as text."""
        config = self.template.unwrapped.config
        faults = [
            (env.policy.obs_mode != STATE, f"a partner without a camera, got {env.policy.name!r}")
            for env in list_wrappers(self.template)
            if isinstance(env, FixedPartnerEnv)
        ]
        if config.obs_mode == STATE:
            return faults
        choices = self.template.choices if isinstance(self.template, EncodedEnv) else {}
        scheme: Any = choices[RECEIVER][1] if RECEIVER in choices else ""
        renderer = resolve_renderer(config.renderer, config.physics)
        has_full_clouds = FULL_POINTCLOUD in parse_obs_mode(config.obs_mode)
        has_terms = isinstance(resolve_rewards(config.rewards), RewardWeights)
        is_own_scheme = not isinstance(scheme, str) or is_reference(scheme)
        return [
            *faults,
            (has_full_clouds, f"an obs_mode without {FULL_POINTCLOUD}, got {config.obs_mode!r}"),
            (config.camera_noise is not None, f"camera_noise=None, got {config.camera_noise!r}"),
            (config.camera_randomization is not None, "camera_randomization=None"),
            (any(camera.period for camera in config.sensors.cameras), "cameras with period=0"),
            (renderer != RAYS, f"the renderer 'rays', got {config.renderer!r}"),
            (not has_terms, f"rewards that are weights of the library's terms, got {config.rewards!r}"),
            (is_own_scheme, f"a built-in action scheme for the receiver, got {scheme!r}"),
        ]
