"""What a result folder is about, and its `config.yaml`."""

import hashlib
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import yaml

from handover_marl._version import __version__
from handover_marl.config import OFFICIAL, TIME_STEP, WorldConfig
from handover_marl.datasets.splits import SETUPS, SPLITS
from handover_marl.errors import ResultsError
from handover_marl.files import brief, read_yaml
from handover_marl.models.panda import PANDA, PANDA_CAMERA
from handover_marl.options import pybullet_installed
from handover_marl.run import Run, reference_of

CONFIG_FILE = "config.yaml"
_OWN_SECTION = "HANDOVER_MARL"
#: The original's environment with the other Panda, whose camera receivers may look through.
_CAMERA_ENV = "HandoverHandCameraPointStateEnv-v1"
_LARGEST = 64_000  # bytes of a configuration; the original's have a few thousand
#: How the official world and rules are called.
OFFICIAL_WORLD = "official"


@dataclass(frozen=True)
class RunSettings:
    """What a result folder is about; scenes run under different settings never share a folder.

    Attributes:
        setup: Official setup.
        split: Its split.
        receiver: Name of the receiver.
        giver: Name of the giver.
        physics: Kind of physics.
        dataset: Name of the dataset.
        version: Version of this library, or "HandoverSim" for folders of the original code.
        receiver_code: Hash of the receiver's code, options and file; empty if unknown.
        giver_code: Likewise.
        seed: Of what policies draw.
        world: "official", or a hash of other rules or another world.
        wait: How long the receiver waits before it comes (s); empty if unknown.
        robot: Which Panda.
        sight: What the receiver sees of the wrist camera, and how that is drawn; empty if it does not look.
        kept: What is kept of the episodes beside their results; empty if nothing is.
        shard: Which part of a run it is; empty if it is no part.
        without: "PyBullet" where that is not installed, so that inverse kinematics, trials of grasps and distances are
            the library's own and MuJoCo's; else empty.
    """

    setup: str
    split: str
    receiver: str
    giver: str
    physics: str
    dataset: str
    version: str
    receiver_code: str = ""
    giver_code: str = ""
    seed: str = "0"
    world: str = OFFICIAL_WORLD
    wait: str = ""
    robot: str = PANDA
    sight: str = ""
    kept: str = ""
    shard: str = ""
    without: str = ""

    @classmethod
    def of(cls, run: Run, kept: str = "", shard: str = "") -> "RunSettings":
        """Of a run that was resolved, what is kept of its episodes, and which part of it this is."""
        giver, receiver = reference_of(run.giver), reference_of(run.receiver)
        return cls(
            setup=run.setup,
            split=run.split,
            receiver=receiver.label,
            giver=giver.label,
            physics=run.physics,
            dataset=run.dataset,
            version=__version__,
            receiver_code=receiver.source,
            giver_code=giver.source,
            seed=str(run.seed),
            world=world_name(run.config),
            wait="" if receiver.wait is None else f"{receiver.wait:g}",
            robot=run.robot,
            sight=run.camera.described(receiver.sight, receiver.observes, run.physics),
            kept=kept,
            shard=shard,
            without="" if pybullet_installed() else "PyBullet",
        )


def world_name(config: WorldConfig) -> str:
    """What a world is called: official, or a hash of what else it is."""
    if config == OFFICIAL:
        return OFFICIAL_WORLD
    return hashlib.sha256(repr(config).encode()).hexdigest()[:8]


def config_text(settings: RunSettings, config: WorldConfig) -> str:
    """A folder's `config.yaml`."""
    own: dict[str, Any] = asdict(settings)
    benchmark = {"SETUP": own.pop("setup"), "SPLIT": own.pop("split"), **_rules(config)}
    content = {"SIM": {"TIME_STEP": TIME_STEP}, "BENCHMARK": benchmark, _OWN_SECTION: own}
    return yaml.safe_dump(content, sort_keys=False)


def whole_config_text(path: Path) -> str:
    """The `config.yaml` that the whole run has of which a folder holds a shard.

    Raises:
        ResultsError: The folder's own cannot be read.
    """
    read_settings(path)
    content = _read_yaml(path / CONFIG_FILE, path)
    return yaml.safe_dump({**content, _OWN_SECTION: {**content[_OWN_SECTION], "shard": ""}}, sort_keys=False)


def read_settings(path: Path) -> RunSettings:
    """Settings of a result folder, ours or the original code's.

    Raises:
        ResultsError: There is no readable `config.yaml` with an official setup and split, our section of it is not
            as this library writes it, or its rules are not those that it claims.
    """
    config_path = path / CONFIG_FILE
    content = _read_yaml(config_path, path)
    try:
        own = content.get(_OWN_SECTION)
        benchmark = content["BENCHMARK"]
        named = {"setup": benchmark["SETUP"], "split": benchmark["SPLIT"]}
        settings = RunSettings(**named, **(_official_section(path, content) if own is None else own))
    except Exception as error:  # whatever shape the file has
        raise ResultsError(f"{config_path}: not a readable configuration ({brief(error)})") from error
    if settings.setup not in SETUPS or settings.split not in SPLITS:
        raise ResultsError(f"{config_path}: unknown setup {brief(settings.setup)!r} or split {brief(settings.split)!r}")
    for key, value in asdict(settings).items():
        if not isinstance(value, str):
            raise ResultsError(f"{config_path}: {key} in section {_OWN_SECTION} is {brief(value)}, expected text")
    _check_rules(config_path, settings, content)
    return settings


def _rules(config: WorldConfig) -> dict[str, Any]:
    """The rules under their official names."""
    protocol = config.protocol
    return {
        "GOAL_CENTER": list(protocol.goal_center),
        "GOAL_RADIUS": protocol.goal_radius,
        "SUCCESS_TIME_THRESH": protocol.success_steps * TIME_STEP,
        "MAX_EPISODE_TIME": protocol.horizon_steps * TIME_STEP,
    }


def _check_rules(path: Path, settings: RunSettings, content: Mapping[str, Any]) -> None:
    """Official figures stand beside published ones, so they must have been made under the official rules."""
    if settings.world != OFFICIAL_WORLD:
        return
    simulation = content.get("SIM", {})
    if not isinstance(simulation, dict):
        raise ResultsError(f"{path}: not a readable configuration (SIM is {brief(simulation)})")
    told = {**content["BENCHMARK"], "TIME_STEP": simulation.get("TIME_STEP", TIME_STEP)}
    for key, value in (_rules(OFFICIAL) | {"TIME_STEP": TIME_STEP}).items():
        found = told.get(key, value)
        same = list(found) == value if isinstance(value, list) and isinstance(found, (list, tuple)) else found == value
        if not same:
            raise ResultsError(
                f"{path}: {key} is {brief(found)}, but the official rules say {value}; these are no official results"
            )


def _read_yaml(config_path: Path, folder: Path) -> dict[str, Any]:
    try:
        content = read_yaml(config_path, _LARGEST)
    except (FileNotFoundError, NotADirectoryError) as error:
        raise ResultsError(f"{folder} is no result folder: it has no {CONFIG_FILE}") from error
    except OSError as error:
        raise ResultsError(f"cannot read {config_path}: {error.strerror or error}") from error
    except ValueError as error:
        raise ResultsError(f"{config_path}: not a readable configuration ({error})") from error
    if not isinstance(content, dict):
        raise ResultsError(f"{config_path}: not a readable configuration (no sections)")
    return content


def _official_section(path: Path, content: Mapping[str, Any]) -> dict[str, str]:
    """What a folder of the original code stands for; it does not tell the wait."""
    sees = content.get("ENV", {}).get("ID", "") == _CAMERA_ENV
    return {
        "robot": PANDA_CAMERA if sees else PANDA,
        "sight": "sees points" if sees else "",
        "receiver": _method_in_name(path.resolve().name),
        "giver": "replay",
        "physics": "exact",
        "dataset": "dexycb",
        "version": "HandoverSim",
    }


def _method_in_name(folder: str) -> str:
    """The original code names folders `<date>_<time>_<method>_<setup>_<split>`."""
    match = re.fullmatch(r"[\d-]+_[\d-]+_(.+)_s[0-3]_(train|val|test)", folder)
    return match.group(1) if match else folder
