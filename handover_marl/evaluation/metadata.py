"""Identity of the evaluation in a result folder, stored in its `config.yaml`."""

import hashlib
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import yaml

from handover_marl.config import OFFICIAL_CONFIG, TIME_STEP, WorldConfig
from handover_marl.datasets.splits import SETUPS, SPLIT_SIZES, SPLITS
from handover_marl.episode.spaces import OBS_PARTS, STATE
from handover_marl.errors import ResultsError
from handover_marl.evaluation.config import EvaluationConfig, require_policy_reference
from handover_marl.execution.files import shorten_text
from handover_marl.execution.options import is_pybullet_installed
from handover_marl.execution.reading import read_yaml
from handover_marl.geometry.panda import PANDA, PANDA_CAMERA, ROBOTS
from handover_marl.simulation.engines import PHYSICS
from handover_marl.version import __version__

CONFIG_FILE = "config.yaml"
#: Label of the official world and rules.
OFFICIAL_WORLD = "official"
_NOISE_PREFIX = "initial_joint_noise="
_LIBRARY_SECTION = "HANDOVER_MARL"
_SPLIT_SIZE = re.compile(r"[1-9][0-9]{0,6}")
_CHOICES = {"split": SPLITS, "physics": PHYSICS, "robot": ROBOTS, "obs_mode": OBS_PARTS}
_ADVICE = "evaluate again into another folder"
_MAX_BYTES = 64_000  # HandoverSim's own configuration files have a few thousand bytes.


@dataclass(frozen=True)
class ResultMetadata:
    """Identity of an evaluation, all values as text; different evaluations never share a result folder.

    Attributes:
        setup: Official setup, or a setup of other data.
        split: Split of the setup.
        receiver: Label of the receiver.
        giver: Label of the giver.
        physics: Physics, "exact", "fast" or "mujoco".
        dataset: Name of the dataset.
        version: Version of this library, or "HandoverSim" for folders that HandoverSim wrote.
        receiver_hash: Hash of the receiver's code, options and file; empty if unknown.
        giver_hash: Hash of the giver's code, options and file; empty if unknown.
        seed: Seed of policies, camera and initial joint positions.
        world: "official", or differences from the official world and rules; see `format_world_label`.
        wait_s: Time that the receiver waits before it approaches (s); empty if unknown.
        robot: Robot model, "panda" or, with the housing of a wrist camera, "panda_camera".
        obs_mode: Observation mode of the receiver.
        camera: Renderer, camera model and noise of the cameras; empty if the receiver uses none.
        recorded: Recordings kept beside the results; empty if there are none.
        missing_package: "PyBullet" if it is not installed, so that inverse kinematics, grasp
            validation and distances were computed by the library and MuJoCo; else empty.
        n_split_scenes: Number of scenes in the split; empty for an official setup, whose sizes are known.
        inference_time: Simulated time that passes during a decision of the receiver (s), or "measured"; empty if
            the person waits, as in official results.
    """

    setup: str
    split: str
    receiver: str
    giver: str
    physics: str
    dataset: str
    version: str
    receiver_hash: str = ""
    giver_hash: str = ""
    seed: str = "0"
    world: str = OFFICIAL_WORLD
    wait_s: str = ""
    robot: str = PANDA
    obs_mode: str = STATE
    camera: str = ""
    recorded: str = ""
    missing_package: str = ""
    n_split_scenes: str = ""
    inference_time: str = ""

    @classmethod
    def from_config(cls, config: EvaluationConfig, recorded: str = "", n_split_scenes: int = 0) -> "ResultMetadata":
        """Create the identity of an evaluation from its resolved configuration.

        The text `recorded` describes recordings beside the results, such as demonstrations. The number of scenes in the
        split, `n_split_scenes`, may be left out for an official setup.
        """
        giver, receiver = require_policy_reference(config.giver), require_policy_reference(config.receiver)
        same = ("setup", "split", "physics", "dataset", "robot")
        return cls(
            **{name: getattr(config, name) for name in same},
            receiver=receiver.label,
            giver=giver.label,
            version=__version__,
            receiver_hash=receiver.code_hash,
            giver_hash=giver.code_hash,
            seed=str(config.seed),
            world=format_world_label(config.world_config),
            wait_s="" if receiver.wait is None else f"{receiver.wait:g}",
            obs_mode=receiver.obs_mode,
            camera=config.sensors.describe(receiver.obs_mode, config.physics),
            recorded=recorded,
            missing_package="" if is_pybullet_installed() else "PyBullet",
            n_split_scenes="" if config.setup in SETUPS else str(n_split_scenes),
            inference_time="" if config.inference_time is None else str(config.inference_time),
        )

    @property
    def split_size(self) -> int:
        """Number of scenes in the split."""
        return SPLIT_SIZES[self.setup, self.split] if self.setup in SETUPS else int(self.n_split_scenes)

    @property
    def simulation_label(self) -> str:
        """Physics with unusual conditions as text, e.g. "exact physics without PyBullet, rules 1b2c3d4e, seed 1"."""
        without = f" without {self.missing_package}" if self.missing_package else ""
        rules = "" if self.world == OFFICIAL_WORLD else f", rules {self.world}"
        return f"{self.physics} physics{without}{rules}" + ("" if self.seed == "0" else f", seed {self.seed}")

    def to_dict(self) -> dict[str, str]:
        """Return the fields by name; `n_split_scenes` and `inference_time` are left out if they are empty."""
        optional = ("n_split_scenes", "inference_time")
        return {key: value for key, value in asdict(self).items() if value or key not in optional}

    def describe_differences(self, other: "ResultMetadata", location: str, other_location: str) -> list[str]:
        """Return a text for each different field, e.g. "seed '0' in A, '1' in B" for the locations "in A", "in B"."""
        return [
            f"{key.replace('_', ' ')} {value!r} {location}, {vars(other)[key]!r} {other_location}"
            for key, value in vars(self).items()
            if value != vars(other)[key]
        ]


def format_world_label(config: WorldConfig) -> str:
    """Return "official" for the official world and rules, else their differences.

    The differences are a hash of the configuration, the noise of the robot's initial joint positions, or both.
    """
    if config == OFFICIAL_CONFIG:
        return OFFICIAL_WORLD
    parts = []
    if replace(config, initial_joint_noise=0.0) != OFFICIAL_CONFIG:
        parts.append(hashlib.sha256(repr(config).encode()).hexdigest()[:8])
    if config.initial_joint_noise:
        parts.append(f"{_NOISE_PREFIX}{float(config.initial_joint_noise)!r}")
    return " ".join(parts)


def parse_world_label(label: str) -> WorldConfig:
    """Return the official world and rules, with the noise of the initial joint positions if a label states only that.

    A label with a hash gives the official configuration, because its differences cannot be read from the hash.
    """
    noise = label.removeprefix(_NOISE_PREFIX)
    return OFFICIAL_CONFIG if noise == label else replace(OFFICIAL_CONFIG, initial_joint_noise=float(noise))


def format_config(metadata: ResultMetadata, config: WorldConfig = OFFICIAL_CONFIG) -> str:
    """Return the content of a result folder's `config.yaml`: the identity of the evaluation, and rules of the world."""
    library: dict[str, Any] = metadata.to_dict()
    benchmark = {"SETUP": library.pop("setup"), "SPLIT": library.pop("split"), **_describe_rules(config)}
    content = {"SIM": {"TIME_STEP": TIME_STEP}, "BENCHMARK": benchmark, _LIBRARY_SECTION: library}
    return yaml.safe_dump(content, sort_keys=False)


def read_result_metadata(path: Path) -> ResultMetadata:
    """Read the identity of a result folder, of this library or of HandoverSim; raise ResultsError if it is invalid."""
    config_path, content = path / CONFIG_FILE, _read_yaml(path)
    try:
        benchmark, library = content["BENCHMARK"], content.get(_LIBRARY_SECTION)
        values = _infer_handoversim_metadata(path, content) if library is None else dict(library)
        values.pop("shard", None)  # older files have it
        metadata = ResultMetadata(setup=benchmark["SETUP"], split=benchmark["SPLIT"], **values)
        stored = {**benchmark, **content.get("SIM", {})}
    except Exception as error:  # the file may have any content
        reason = f"it has no {error}" if isinstance(error, KeyError) else shorten_text(error)
        raise ResultsError(f"{config_path}: not a configuration of results ({reason}); {_ADVICE}") from error
    check_metadata(metadata, config_path)
    if metadata.world == OFFICIAL_WORLD:
        for key, value in (_describe_rules(OFFICIAL_CONFIG) | {"TIME_STEP": TIME_STEP}).items():
            if stored.get(key, value) != value:
                raise ResultsError(
                    f"{config_path}: {key} is {shorten_text(stored[key])}, but the official rules say {value}; these "
                    "are no official results"
                )
    return metadata


def check_metadata(metadata: ResultMetadata, path: Path) -> None:
    """Check that an identity from the file `path` has known choices and printable texts, or raise ResultsError."""
    for key, value in asdict(metadata).items():
        # Control characters could change a terminal that prints the report.
        if not isinstance(value, str) or not value.isprintable():
            raise ResultsError(f"{path}: {key} must be text without control characters, got {shorten_text(value)!a}")
        parts = value.split("+") if key == "obs_mode" else [value]
        if not set(parts) <= set(_CHOICES.get(key, parts)):
            raise ResultsError(f"{path}: unknown {key} {shorten_text(value)!r}; valid: {', '.join(_CHOICES[key])}")
    if metadata.setup not in SETUPS and not _SPLIT_SIZE.fullmatch(metadata.n_split_scenes):
        raise ResultsError(
            f"{path}: unknown setup {shorten_text(metadata.setup)!r}; valid: {', '.join(SETUPS)}, or another one, "
            f"beside which n_split_scenes must be a number, got {metadata.n_split_scenes!r}"
        )


def _describe_rules(config: WorldConfig) -> dict[str, Any]:
    """Return rules by HandoverSim's keys: goal region (m), time to hold the object there (s) and time limit (s)."""
    protocol = config.protocol
    return {
        "GOAL_CENTER": list(protocol.goal_center),
        "GOAL_RADIUS": protocol.goal_radius,
        "SUCCESS_TIME_THRESH": protocol.success_steps * TIME_STEP,
        "MAX_EPISODE_TIME": protocol.horizon_steps * TIME_STEP,
    }


def _read_yaml(folder: Path) -> dict[str, Any]:
    """Return the sections of a result folder's `config.yaml`, by name; raise ResultsError if it cannot be read."""
    path = folder / CONFIG_FILE
    try:
        content = read_yaml(path, _MAX_BYTES)
        if not isinstance(content, dict):
            raise TypeError("it has no sections")
    except (FileNotFoundError, NotADirectoryError) as error:
        if not folder.exists():
            raise ResultsError(f"result folder {folder} does not exist") from error
        if folder.is_file():
            raise ResultsError(f"{folder} is a file; pass the result folder that has it") from error
        parts = sorted(path.parent.name for path in folder.glob(f"*/{CONFIG_FILE}"))
        advice = f"; pass one of its folders {shorten_text(', '.join(parts))}" if parts else ""
        raise ResultsError(f"{folder} is no result folder: it has no {CONFIG_FILE}{advice}") from error
    except (OSError, ValueError, TypeError) as error:
        raise ResultsError(f"{path}: not a configuration of results ({shorten_text(error)}); {_ADVICE}") from error
    return content


def _infer_handoversim_metadata(path: Path, content: Mapping[str, Any]) -> dict[str, str]:
    """Infer fields of `ResultMetadata` of a folder that HandoverSim wrote, from its name and its configuration."""
    has_camera = content.get("ENV", {}).get("ID", "") == "HandoverHandCameraPointStateEnv-v1"
    folder = path.resolve().name
    # <date>_<time>_<method>_<setup>_<split>
    match = re.fullmatch(r"[\d-]+_[\d-]+_(.+)_s[0-3]_(train|val|test)", folder)
    return {
        "robot": PANDA_CAMERA if has_camera else PANDA,
        "obs_mode": "state+pointcloud" if has_camera else STATE,
        "receiver": match.group(1) if match else folder,
        "giver": "replay",
        "physics": "exact",
        "dataset": "dexycb",
        "version": "HandoverSim",
    }
