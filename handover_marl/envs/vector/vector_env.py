"""Vector environment of one agent (Gymnasium's VectorEnv), and the constructor of vector environments."""

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv

from handover_marl.datasets.dataset import Scene
from handover_marl.envs.agents import RECEIVER
from handover_marl.envs.config import EnvConfig
from handover_marl.envs.custom_rewards import resolve_rewards
from handover_marl.envs.handover_env import HandoverEnv
from handover_marl.envs.rewards import RewardWeights
from handover_marl.envs.vector.batched_envs import BatchedEnvGroup
from handover_marl.envs.vector.env_groups import ProcessEnvGroup, SequentialEnvGroup, ThreadedEnvGroup
from handover_marl.envs.vector.env_result import EnvGroup
from handover_marl.envs.vector.parallel_vector_env import ParallelVectorEnv
from handover_marl.envs.wrappers.control_agent import FixedPartnerEnv, control_agent
from handover_marl.envs.wrappers.encode import EncodedEnv, encode
from handover_marl.envs.wrappers.wrapper import WrappableEnv, check_env, list_wrappers
from handover_marl.episode.spaces import FULL_POINTCLOUD, has_camera, parse_obs_mode
from handover_marl.errors import OptionError, check_name, report_failure
from handover_marl.execution.options import check_positive_integer, count_available_cores, forward_signature
from handover_marl.learning.encodings.custom import FeaturesLike, SchemeLike, is_reference
from handover_marl.policies.reference import PolicyLike
from handover_marl.simulation.camera.optics import CameraInfo
from handover_marl.simulation.camera.renderers import RAYS, resolve_renderer
from handover_marl.simulation.engines import CPU, MUJOCO, THREADS, WARP, BatchBackend, check_backend

#: Function or class that wraps the environment by a `pettingzoo.utils.BaseParallelWrapper`.
WrapperFunction: TypeAlias = Callable[[WrappableEnv], WrappableEnv]
AUTORESETS = tuple(mode.name.lower() for mode in AutoresetMode)
#: Largest number of environments of `vector_env`; each takes megabytes of memory.
MAX_ENVS = 65_536
# Number of scenes in memory: a scene takes 0.7 MB, and 5 ms to read.
_CACHED_SCENES = 512


class HandoverVectorEnv(VectorEnv[Any, Any, Any]):
    """Gymnasium vector environment of one agent, made by `handover_marl.vector_env`.

    Environment k is seeded with `seed + k` and behaves as a single environment with that seed.
    Results have the form of Gymnasium's `SyncVectorEnv`.

    With the backend "threads", all values are NumPy arrays. With "warp", observations, rewards, terminations,
    truncations and infos are PyTorch tensors on the device of the simulation, also the infos in "final_info".
    "final_obs" is a NumPy array (n,) of objects: the tensor, or the dictionary of tensors, of each environment whose
    episode has ended, else None. Its mask "_final_obs" is a NumPy array, too.

    Args:
        envs: The environments of this agent.
        render_mode: Render mode of each environment.

    Attributes:
        autoreset_mode: Gymnasium's mode of the reset after an episode's end.
        scene_ids: Numbers of the scenes that the environments draw from.
    """

    single_action_space: spaces.Box

    def __init__(self, envs: ParallelVectorEnv, render_mode: str | None) -> None:
        (self._agent,) = envs.possible_agents
        self._envs, self.render_mode = envs, render_mode
        self.num_envs, self.autoreset_mode, self.scene_ids = envs.num_envs, envs.autoreset_mode, envs.scene_ids
        self.metadata = envs.metadata
        self.single_observation_space = envs.single_observation_space(self._agent)
        self.single_action_space = envs.single_action_space(self._agent)
        self.observation_space = envs.observation_space(self._agent)
        self.action_space = envs.action_space(self._agent)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode in every environment, or in some with `options={"reset_mask": (n,) bool}`.

        Arguments and errors are as in `ParallelVectorEnv.reset`.

        Returns:
            Observations (n, ...), and infos in Gymnasium's form.
        """
        observations, infos = self._envs.reset(seed, options)
        return observations[self._agent], infos[self._agent]

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step every environment for one control period, or until its action scheme needs outputs.

        Some action schemes skip decisions; a step then lasts several control periods, whose rewards are summed. Errors
        are those of `ParallelVectorEnv.step`.

        Args:
            actions: (n, ...) action of each environment. With the backend "warp", tensors on the device are not copied
                through the memory of the processor; arrays and tensors of the processor are moved to the device.

        Returns:
            Observations (n, ...), rewards (n,), terminations (n,), truncations (n,), and infos in Gymnasium's form.
        """
        observations, rewards, terminated, truncated, infos = (
            part[self._agent] for part in self._envs.step({self._agent: actions})
        )
        return observations, rewards, terminated, truncated, infos

    def camera_info(self) -> dict[str, CameraInfo]:
        """Return size, intrinsics and pose of each camera by name, the same in all environments and episodes."""
        return self._envs.camera_info()

    def render(self) -> tuple[Any, ...] | None:
        """Return the RGB image (height, width, 3) of each environment; None unless `render_mode` is "rgb_array"."""
        return self._envs.render()

    def close_extras(self, **kwargs: Any) -> None:
        """Free the simulations of all environments."""
        self._envs.close()


@forward_signature(EnvConfig, defaults={"physics": MUJOCO})
def vector_env(
    num_envs: int,
    agent: str | None = "receiver",
    partner: PolicyLike | None = None,
    *,
    features: FeaturesLike | Mapping[str, FeaturesLike] | None = None,
    action_scheme: SchemeLike | Mapping[str, SchemeLike] | None = None,
    wrappers: Sequence[WrapperFunction] = (),
    autoreset: str = "next_step",
    threads: int | None = None,
    processes: int | None = None,
    backend: str = THREADS,
    device: str = CPU,
    trust: bool = False,
    **fields: Any,
) -> Any:
    """Make many environments, which MuJoCo simulates together on several threads or in several processes.

    The result is a `HandoverVectorEnv` of one agent, or with `agent=None` a `ParallelVectorEnv` of both.

    Each environment behaves as a single one with its seed, whatever the number of environments, threads and
    processes. In other physics, with a camera, a render mode or wrappers, the backend "threads" steps the environments
    of a process one after another.

    Args:
        num_envs: Number of environments.
        agent: Agent that is controlled from outside, "receiver" or "giver", for a Gymnasium VectorEnv;
            None for both agents.
        partner: Policy of the other agent; default: "replay" for a giver, "yang2021" for a receiver.
        features: Features that replace observations, a name, class or function as in `encode`; a mapping
            by agent for both agents.
        action_scheme: Action scheme whose outputs replace actions, a name, class or function as in `encode`; a
            mapping by agent for both agents.
        wrappers: Functions or classes that wrap each environment by a `pettingzoo.utils.BaseParallelWrapper`, the
            innermost first; the wrapped environment has both agents, and their observations and actions are as the
            environment defines them. The backend "warp" accepts no wrappers.
        autoreset: Gymnasium's mode of the reset after an episode's end: "next_step", "same_step" or "disabled".
        threads: Number of simulation threads, instead of `processes`; default: one per core.
        processes: Number of processes that simulate the environments, each with one thread; default: none,
            the simulation runs in this process. On several cores, processes are faster than threads, but each
            process needs memory for its own models.
        backend: Backend of the simulation: "threads" for MuJoCo on the processor, or "warp" for MuJoCo Warp, which
            steps all environments together and returns PyTorch tensors on `device`. The results of "warp" are not
            bit-identical to those of "threads". "warp" renders cameras on the device, without noise, for all
            observation modes but "full_pointcloud"; the random subsets of point clouds with more than 1024 points
            differ from those of "threads".
        device: Device of the simulation: "cpu", or "cuda" for a GPU with "warp". MuJoCo Warp on "cpu" is for tests.
        trust: Whether modules that a policy file or a population names may be imported.
        fields: Fields of `handover_marl.envs.config.EnvConfig`; `physics` defaults to "mujoco".

    Raises:
        UnknownNameError: There is no such agent, policy, features, scheme, autoreset mode, backend or device.
        OptionError: A number is out of range, MuJoCo or MuJoCo Warp is not installed, there is no GPU, or "warp"
            cannot simulate these environments.
    """
    check_name("autoreset", autoreset, AUTORESETS)
    chosen_backend = BatchBackend(backend, device)
    check_backend(chosen_backend)
    count = check_positive_integer("num_envs", num_envs)
    if count > MAX_ENVS:
        raise OptionError(f"num_envs must be at most {MAX_ENVS}, got {num_envs}; run several processes")
    threads = None if threads is None else check_positive_integer("threads", threads)
    processes = None if processes is None else check_positive_integer("processes", processes)
    if None not in (threads, processes):
        raise OptionError(f"pass either threads or processes, not both, got {threads} and {processes}")
    if backend == WARP and (threads or processes):
        raise OptionError(
            f"threads and processes must be left out with backend='warp', got {threads} and {processes}; the device "
            "simulates all environments together"
        )
    if agent is None and partner is not None:
        raise OptionError(
            f"partner must be None if both agents are controlled, got {partner!r}; leave it out, or name one agent"
        )
    given: object = wrappers
    if not isinstance(given, Sequence) or isinstance(given, str):
        raise OptionError(f"wrappers must be a list of functions or classes, got {given!r}")
    config = EnvConfig(**{"physics": MUJOCO, **fields})
    if config.render_mode == "human":
        raise OptionError('render_mode must be None or "rgb_array" for several environments, got "human"')

    def make_single() -> WrappableEnv:
        env: WrappableEnv = HandoverEnv(config)
        for wrapper in wrappers:
            env = _apply_wrapper(wrapper, env)
        if agent is not None:
            env = control_agent(env, agent, partner, trust=trust)
        return env if features is None and action_scheme is None else encode(env, features, action_scheme)

    template = make_single()
    obstacle = _find_unmet_condition(template, backend)
    if obstacle and backend == WARP:
        raise OptionError(f"environments with backend='warp' must have {obstacle}; use backend='threads'")
    # Groups share the template and the scenes; processes make their own.
    make: Callable[..., EnvGroup] = functools.partial(_make_envs, make_single, autoreset != "disabled", chosen_backend)
    if processes is not None:
        n_groups, make = processes, functools.partial(ProcessEnvGroup, make)
    else:
        n_groups = (threads or count_available_cores()) if backend == THREADS and not obstacle else 1
        make = functools.partial(make, template=template, load_scene=_cache_scenes(template))
    n_groups = min(n_groups, count)
    is_alone = n_groups == 1 and processes is None
    envs = make(count) if is_alone else ThreadedEnvGroup(make, count, n_groups)
    both = ParallelVectorEnv(envs, template, count, AutoresetMode[autoreset.upper()])
    return both if agent is None else HandoverVectorEnv(both, template.render_mode)


def _make_envs(
    make_single: Callable[[], WrappableEnv],
    prefetches: bool,
    backend: BatchBackend,
    count: int,
    template: WrappableEnv | None = None,
    load_scene: Callable[[int], Scene] | None = None,
) -> EnvGroup:
    """Make `count` environments, which one thread simulates; `make_single` makes one of them.

    `prefetches` is whether to simulate next episodes in advance; resets at the end of an episode then have no options.
    `template` and `load_scene` are arguments of `BatchedEnvGroup`; if None, a template and a cache of scenes are made.
    """
    template = template or make_single()
    if _find_unmet_condition(template, backend.name):
        return SequentialEnvGroup(make_single, count)
    return BatchedEnvGroup(template, count, prefetches, load_scene or _cache_scenes(template), backend)


def _cache_scenes(template: WrappableEnv) -> Callable[[int], Scene]:
    return functools.lru_cache(maxsize=_CACHED_SCENES)(template.unwrapped.dataset.load_scene)


def _find_unmet_condition(template: WrappableEnv, backend: str) -> str:
    """Return the first unmet condition for simulating environments together on arrays, as text; "" if all are met."""
    config, wrappers = template.unwrapped.config, list_wrappers(template)
    kinds = [type(env) for env in wrappers]
    choices = template.choices if isinstance(template, EncodedEnv) else {}
    scheme: Any = choices[RECEIVER][1] if RECEIVER in choices else ""
    conditions = [
        (config.physics == MUJOCO, f"physics='mujoco', got {config.physics!r}"),
        (config.render_mode is None, f"render_mode=None, got {config.render_mode!r}"),
        (
            kinds == [kind for kind in (EncodedEnv, FixedPartnerEnv) if kind in kinds],
            "no wrappers but control_agent, then encode",
        ),
    ]
    for env in wrappers:
        if isinstance(env, FixedPartnerEnv):
            is_blind = not has_camera(env.policy.obs_mode)
            conditions.append((is_blind, f"a partner without a camera, got {env.policy.name!r}"))
    if has_camera(config.obs_mode):
        conditions += [
            (backend == WARP, f"obs_mode='state', got {config.obs_mode!r}"),
            (
                FULL_POINTCLOUD not in parse_obs_mode(config.obs_mode),
                f"an obs_mode without {FULL_POINTCLOUD}, got {config.obs_mode!r}",
            ),
            (config.camera_noise is None, f"camera_noise=None, got {config.camera_noise!r}"),
            (config.camera_randomization is None, "camera_randomization=None"),
            (not any(camera.period for camera in config.sensors.cameras), "cameras with period=0"),
            (
                resolve_renderer(config.renderer, config.physics) == RAYS,
                f"the renderer 'rays', got {config.renderer!r}",
            ),
            (
                isinstance(resolve_rewards(config.rewards), RewardWeights),
                f"rewards that are weights of the library's terms, got {config.rewards!r}",
            ),
            (
                isinstance(scheme, str) and not is_reference(scheme),
                f"a built-in action scheme for the receiver, got {scheme!r}",
            ),
        ]
    return next((need for is_met, need in conditions if not is_met), "")


def _apply_wrapper(wrapper: WrapperFunction, env: WrappableEnv) -> WrappableEnv:
    """Return an environment wrapped by a user's function or class `wrapper`; raise OptionError if it fails."""
    if not callable(wrapper):
        raise OptionError(f"wrappers must be functions or classes that wrap an environment, got {wrapper!r}")
    with report_failure(OptionError, f"wrapper {wrapper!r}"):
        wrapped = wrapper(env)
    check_env(wrapped)
    return wrapped
