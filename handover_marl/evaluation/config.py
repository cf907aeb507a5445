"""Configuration of evaluations (scenes, policies, simulation) and of their execution.

Public functions and the command line take the fields of `EvaluationConfig` and `ExecutionConfig` as arguments.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from numbers import Integral
from pathlib import Path
from typing import Any, Final, Literal

from handover_marl.config import WorldConfig, check_config
from handover_marl.datasets import Dataset, open_dataset
from handover_marl.datasets.splits import SPLITS, choose_scenes
from handover_marl.episode.loop import MEASURED, InferenceTime
from handover_marl.episode.scene_config import SceneConfig
from handover_marl.episode.spaces import has_camera
from handover_marl.errors import OptionError, check_name
from handover_marl.execution.files import shorten_text
from handover_marl.execution.options import PoolConfig, check_boolean, check_path
from handover_marl.policies.reference import PolicyLike, PolicyReference, parse_policy
from handover_marl.simulation.camera.renderers import resolve_renderer
from handover_marl.simulation.engines import check_physics

#: Name of the giver of official results, which replays the recording.
REPLAY = "replay"
#: Choices of the episodes that get a replay page, beside "failed".
REPLAYS_NONE: Final = "none"
REPLAYS_ALL: Final = "all"

_MAX_INFERENCE_TIME = 10.0  # s
_SEED_LIMIT = 2**63  # Data sets store seeds as signed 64-bit integers.


@dataclass(frozen=True)
class EvaluationConfig(SceneConfig):
    """Configuration of an evaluation: scenes, policies and simulation.

    Attributes:
        giver: The person's policy, e.g. replay, cooperative, learned:FILE or my_package:MyGiver.
        receiver: The robot's policy, e.g. yang2021, omg:wait=1.5, learned:FILE or my_package:MyReceiver.
        seed: Seed of the random draws of policies, camera and initial joint positions.
        inference_time: Simulated time (s) that passes during each decision of the receiver, while its last action stays
            in effect, or "measured" for the wall-clock time; default: none, as in official results.

    Raises:
        OptionError: `seed`, `data_dir` or `inference_time` (0 to 10 s) is out of range or of the wrong type.
    """

    giver: PolicyLike = REPLAY
    receiver: PolicyLike = "yang2021"
    seed: int = 0
    inference_time: InferenceTime = None

    def __post_init__(self) -> None:
        super().__post_init__()
        # Plain values, so that configurations can be compared, hashed and pickled.
        seed: object = self.seed
        if isinstance(seed, bool) or not isinstance(seed, Integral) or not 0 <= int(seed) < _SEED_LIMIT:
            raise OptionError(f"seed must be an integer from 0 to 2^63 - 1, got {shorten_text(repr(seed))}")
        object.__setattr__(self, "seed", int(seed))
        if self.data_dir is not None:
            object.__setattr__(self, "data_dir", str(check_path("data_dir", self.data_dir)))
        passed: object = self.inference_time
        if isinstance(passed, (int, float)) and not isinstance(passed, bool) and 0.0 <= passed <= _MAX_INFERENCE_TIME:
            passed = float(passed)
        elif passed not in (None, MEASURED):
            raise OptionError(
                f"inference_time must be a time from 0 to {_MAX_INFERENCE_TIME:g} s, {MEASURED!r} or None, "
                f"got {shorten_text(passed)}; for 100 ms pass 0.1"
            )
        object.__setattr__(self, "inference_time", passed)

    def open_dataset(self) -> Dataset:
        """Open the dataset that the configuration names, with its data folder and robot model.

        Raises:
            UnknownNameError, OptionError, DataNotFoundError: The same errors as `handover_marl.datasets.open_dataset`.
        """
        return open_dataset(self.dataset, self.data_dir, self.robot)


@dataclass(frozen=True)
class ExecutionConfig(PoolConfig):
    """Configuration of the execution: workers and output; outcomes do not depend on it.

    Attributes:
        shard: Part of the scenes to evaluate, e.g. 3/16 for the third of 16; all shards may use one output folder.
        out: Folder for results and reports; an interrupted evaluation resumes there.
        progress: Show a progress bar on stderr.
        trust: Import modules that are named in policy files (learned:FILE) or in a population.
        overwrite: Delete the results in the output folder instead of resuming.
        replays: Episodes with a 3D replay page: none, failed or all. Finished episodes without a page are simulated
            again, and must end with the same outcome.
        traces: Write the time series of each episode (positions, speeds, distance, forces) as CSV files.

    Raises:
        OptionError: A switch is not a boolean, or the output folder not a path.
    """

    shard: str | None = None
    out: str | None = None
    progress: bool = True
    trust: bool = False
    overwrite: bool = False
    replays: Literal["none", "failed", "all"] = REPLAYS_NONE
    traces: bool = False

    def __post_init__(self) -> None:
        for name in ("progress", "trust", "overwrite", "traces"):
            check_boolean(name, getattr(self, name))
        if self.out is not None:
            object.__setattr__(self, "out", str(check_path("out", self.out)))

    @property
    def folder(self) -> Path | None:
        """Path of the output folder, or None if nothing is written."""
        return None if self.out is None else Path(self.out)


def build_configs(options: Mapping[str, Any], **arguments: Any) -> tuple[EvaluationConfig, ExecutionConfig]:
    """Build both configurations from values of their fields, by name; `arguments` override `options`."""
    names = {field.name for field in fields(ExecutionConfig)}
    given = {**options, **arguments}
    execution = ExecutionConfig(**{name: value for name, value in given.items() if name in names})
    return EvaluationConfig(**{name: value for name, value in given.items() if name not in names}), execution


def resolve_config(config: EvaluationConfig, trust: bool = False) -> tuple[EvaluationConfig, Dataset]:
    """Check a configuration; return a copy with all defaults filled in (a resolved configuration), and the dataset.

    A resolved configuration has the name of a setup, a tuple of scene numbers, the dataset's name, and policies as
    `PolicyReference`s with labels and hashes. With `trust`, modules that policy files name may be imported.
    """
    check_name("split", config.split, SPLITS)
    check_physics(config.physics)
    check_config("world_config", config.world_config, WorldConfig)
    agents = ("giver", "receiver")
    policies = {agent: parse_policy(agent, getattr(config, agent), trust) for agent in agents}
    dataset = config.open_dataset()
    setup = dataset.resolve_setup(config.setup)
    scenes = choose_scenes(dataset.list_scenes(setup, config.split), config.scenes, f"{setup} {config.split}")
    resolved = {agent: policies[agent].resolve(dataset, config.world_config, setup) for agent in agents}
    if has_camera(resolved["receiver"].obs_mode):
        resolve_renderer(config.sensors.renderer, config.physics)
    config = replace(config, setup=setup, scenes=scenes, giver=resolved["giver"], receiver=resolved["receiver"])
    return set_dataset(config, dataset), dataset


def format_inference_time(inference_time: InferenceTime | str) -> str:
    """Return an inference time (s) as text, such as "inference time 0.1 s a decision"; empty if it is None or empty."""
    if inference_time in (None, ""):
        return ""
    return (
        "inference time as measured" if inference_time == MEASURED else f"inference time {inference_time} s a decision"
    )


def set_dataset(config: EvaluationConfig, dataset: Dataset) -> EvaluationConfig:
    """Return a copy of a configuration with the name of `dataset`, and the dataset's folder if it has one."""
    folder = dataset.source_folder
    return replace(config, dataset=dataset.name, data_dir=config.data_dir if folder is None else str(folder))


def require_policy_reference(policy: PolicyLike) -> PolicyReference:
    """Return a policy of a resolved configuration (`resolve_config`); raise TypeError if it is no `PolicyReference`."""
    if not isinstance(policy, PolicyReference):
        raise TypeError("the configuration is not resolved; call resolve_config() first")
    return policy
