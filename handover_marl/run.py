"""One description of what is run, and one of how: taken by everything that plays scenes, and by the command line."""

import os
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from typing_extensions import TypedDict

from handover_marl.config import OFFICIAL, WorldConfig
from handover_marl.datasets import Dataset, open_dataset
from handover_marl.datasets.splits import check_setup_and_split, choose_scenes
from handover_marl.episode.sight import SightConfig
from handover_marl.errors import OptionError
from handover_marl.models.panda import PANDA
from handover_marl.policies.reference import PolicyLike, PolicyReference, policy_reference
from handover_marl.pools.pool_config import LOCAL, PoolConfig
from handover_marl.sim.camera.imperfections import CameraImperfections
from handover_marl.sim.camera.optics import REFERENCE
from handover_marl.sim.engines import check_physics
from handover_marl.sim.renderers import chosen_renderer

#: The giver of official results.
REPLAY = "replay"
#: Of which episodes there may be replays to look at.
NO_REPLAYS, FAILED, EVERY = "none", "failed", "all"
REPLAYS = (NO_REPLAYS, FAILED, EVERY)
#: Fields of `Execution` that one scene alone does not have.
OF_SEVERAL = ("workers", "backend", "ray_address", "shard", "out", "fresh", "replays")


@dataclass(frozen=True)
class Run:
    """What is run.

    Attributes:
        setup: Official setup: s0 all seen, s1 unseen subjects, s2 unseen handedness, s3 unseen objects.
        split: train, val or test.
        scenes: Only these scenes of the split, e.g. 209,214; reports then say that they are partial.
        dataset: dexycb, synthetic, or auto: dexycb when there is a data folder, else synthetic.
        data_dir: Folder in HandoverSim's layout; default: the environment variable HANDOVER_MARL_DATA.
        physics: exact, as official results are, fast, or mujoco, which is another engine.
        giver: The person's policy, e.g. replay, cooperative, learned:FILE or my_package:MyGiver.
        receiver: The robot's policy, e.g. yang2021, omg:wait=1.5, learned:FILE or my_package:MyReceiver.
        robot: panda, or panda_camera with HandoverSim's depth camera on its hand, which is another robot to collide
            with.
        renderer: What draws for receivers that look through the wrist camera: bullet, rays, or auto: bullet in exact
            physics and rays in others.
        geometry: reference puts points where HandoverSim puts them, true where they are.
        imperfections: What is wrong with the camera: nothing, or as with a realsense.
        seed: Of what policies and camera draw.
        config: The world and the rules; official figures exist for the default only.
    """

    setup: str = "s0"
    split: str = "test"
    scenes: tuple[int, ...] | None = None
    dataset: str = "auto"
    data_dir: str | None = None
    physics: str = "exact"
    giver: PolicyLike = REPLAY
    receiver: PolicyLike = "yang2021"
    robot: str = PANDA
    renderer: str = "auto"
    geometry: str = REFERENCE
    imperfections: str | CameraImperfections | None = None
    seed: int = 0
    config: WorldConfig = OFFICIAL

    def open_dataset(self) -> Dataset:
        """The dataset.

        Raises:
            UnknownNameError, OptionError, DataNotFoundError: As `handover_marl.datasets.open_dataset`.
        """
        return open_dataset(self.dataset, self.data_dir, self.robot)

    @property
    def camera(self) -> SightConfig:
        """How the wrist camera's pictures are made.

        Raises:
            UnknownNameError, OptionError: There is no such geometry, or no such imperfections.
        """
        return SightConfig(self.renderer, self.geometry, self.imperfections)


@dataclass(frozen=True)
class Execution:
    """How it is run; outcomes do not depend on it.

    Attributes:
        workers: Processes to play scenes in; default: one a core. Planning times are wall clock and may depend on
            it, so that the number is told with them.
        backend: Where they are: local, on this machine, or ray, on the nodes of a Ray cluster.
        ray_address: Of the cluster; default: the environment variable RAY_ADDRESS, else a Ray that was started on this
            machine, else one that is started for this.
        shard: Only a part of the scenes, which of how many, e.g. 3/16; `merge` makes one folder of the folders of all.
        out: Folder for results and reports; an interrupted run goes on there.
        progress: Show a progress bar on stderr.
        trust: Let code in policy files (learned:FILE) run.
        fresh: Start anew in a folder that holds a run, instead of going on.
        replays: none, failed or all: of which episodes the folder gets pages that play them in three dimensions. In a
            folder that holds the run already, these episodes alone are played again, and must end as they did.
    """

    workers: int | None = None
    backend: str = LOCAL
    ray_address: str | None = None
    shard: str | None = None
    out: str | None = None
    progress: bool = True
    trust: bool = False
    fresh: bool = False
    replays: str = NO_REPLAYS

    @property
    def pool(self) -> PoolConfig:
        """Who plays."""
        return PoolConfig(self.workers, self.backend, self.ray_address)

    @property
    def folder(self) -> Path | None:
        """The folder for results, or None."""
        return None if self.out is None else Path(self.out)

    def inside(self, name: str) -> "Execution":
        """The same with a folder in the folder."""
        return self if self.out is None else replace(self, out=str(Path(self.out) / name))


class SceneOptions(TypedDict, total=False):
    """Fields of `Run` and `Execution` as keywords, for one scene; they say what these mean."""

    dataset: str
    data_dir: str | os.PathLike[str] | None
    physics: str
    robot: str
    renderer: str
    geometry: str
    imperfections: str | CameraImperfections | None
    seed: int
    progress: bool
    trust: bool


class RunOptions(SceneOptions, total=False):
    """The fields of `Run` and `Execution` but setup, split and policies, as keywords; they say what these mean."""

    scenes: Iterable[int] | None
    config: WorldConfig
    workers: int | None
    backend: str
    ray_address: str | None
    shard: str | None
    out: str | os.PathLike[str] | None
    fresh: bool
    replays: str


def describe(
    setup: "str | Run", options: Any, execution: Execution | None = None, **named: Any
) -> tuple[Run, Execution]:
    """The two descriptions from what a public function was given.

    Args:
        setup: The official setup, or a whole description, beside which nothing else of `Run` counts.
        options: `RunOptions`.
        execution: How to run, or None to take that from the options.
        named: Further fields of `Run`.

    Raises:
        TypeError: There is no such option.
        OptionError: Something is given twice, or has no fitting type.
    """
    run_names, execution_names = ({part.name for part in fields(kind)} for kind in (Run, Execution))
    unknown = sorted(options.keys() - run_names - execution_names)
    if unknown:
        raise TypeError(f"unexpected keyword argument {unknown[0]!r}")
    told = {key: options[key] for key in options.keys() & run_names} | named
    how = {key: options[key] for key in options.keys() & execution_names}
    if isinstance(setup, Run):
        twice = sorted(options.keys() & run_names)
        if twice:
            raise OptionError(f"{twice[0]} is given beside a Run; put it into the Run")
        run = setup
    else:
        run = Run(setup=setup, **_tidy(told))
    if execution is not None and how:
        raise OptionError(f"{sorted(how)[0]} is given beside an Execution; put it into the Execution")
    return run, execution or Execution(**_tidy(how))


def resolve(run: Run, trust: bool = False) -> tuple[Run, Dataset]:
    """The same run with names checked, scenes and policies resolved; and its dataset.

    Raises:
        UnknownNameError: No such setup, split, dataset, robot, physics, renderer or policy.
        SceneError: A scene is not in the split.
        DataNotFoundError: A file of a scene is missing.
        OptionError: A policy cannot be what is asked for, or what draws for it is not installed.
    """
    check_setup_and_split(run.setup, run.split)
    check_physics(run.physics)
    references = {agent: policy_reference(agent, getattr(run, agent), trust) for agent in ("giver", "receiver")}
    data = run.open_dataset()
    scenes = choose_scenes(data.split(run.setup, run.split), run.scenes, f"{run.setup} {run.split}")
    giver, receiver = (references[agent].resolved(data, run.config, run.setup) for agent in ("giver", "receiver"))
    chosen_renderer(run.camera.renderer, run.physics, installed=receiver.sight is not None)
    data.check_scenes(scenes)
    return replace(run, dataset=data.name, scenes=scenes, giver=giver, receiver=receiver), data


def reference_of(policy: PolicyLike) -> PolicyReference:
    """The policy of a run that was resolved."""
    if not isinstance(policy, PolicyReference):
        raise TypeError("this run was not resolved")
    return policy


def _tidy(told: dict[str, Any]) -> dict[str, Any]:
    """Paths as text and scenes as a tuple, so that descriptions compare, hash and travel."""
    tidy = dict(told)
    for key in ("data_dir", "out"):
        if tidy.get(key) is not None:
            tidy[key] = _path_text(key, tidy[key])
    if tidy.get("scenes") is not None:
        try:
            tidy["scenes"] = tuple(tidy["scenes"])
        except TypeError:
            # Told when scenes are chosen, where the split is known.
            return tidy
    return tidy


def _path_text(name: str, path: Any) -> str:
    try:
        text = os.fspath(path)
        text = text.decode() if isinstance(text, bytes) else text
        if "\0" in text:
            raise ValueError("a zero byte in a path")
        return str(Path(text).expanduser())
    except (TypeError, ValueError, RuntimeError) as error:
        raise OptionError(f"{name}={path!r} must be a path ({error})") from error
