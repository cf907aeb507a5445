"""Tests of the library in processes that cannot import PyBullet, as with Python 3.14."""

import hashlib
import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from handover_marl.assets.shipped import PANDA_URDF
from handover_marl.cli import main
from handover_marl.datasets import DATA_DIR_VARIABLE
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.episode import Episode
from handover_marl.execution.options import is_pybullet_installed
from handover_marl.planning.ik_solvers import PandaIkSolver
from handover_marl.receivers import make, yang2021
from tests.helpers.playing import play

SCENE = 209
NEEDS = "needs PyBullet, which is not installed (it has wheels up to Python 3.13"
# Content of sitecustomize.py, which Python runs when it starts, also in worker processes.
BLOCKADE = 'import sys\nsys.modules["pybullet"] = sys.modules["pybullet_data"] = None\n'
#: Steps of episodes in which agents observe and act, but which end before the handover.
SHORT = 400
RESULTS = ["benchmark", "--receiver", "hold", "--dataset", "synthetic", "--physics", "mujoco"]
RESULTS += ["--split", "val", "--scenes", "9", "--workers", "1", "--out"]
#: Commands that need PyBullet, and what their errors recommend.
REFUSED: list[tuple[list[str], str]] = [
    (["benchmark", "--setup", "s3", "--receiver", "yang2021"], "take physics='mujoco' (--physics mujoco)"),
    (["benchmark", "--physics", "fast"], "take physics='mujoco' (--physics mujoco)"),
    (["render", "--scene", str(SCENE), "--physics", "mujoco", "--out", "video.gif"], "--out FILE.html"),
    (["import", "--dexycb", "here", "--mano", "here", "--out", "there"], "import with Python 3.11 to 3.13"),
]


def run_without_pybullet(folder: Path, code: str) -> list[str]:
    """Run a program without PyBullet and with another cache folder, and return the lines of its output."""
    (folder / "sitecustomize.py").write_text(BLOCKADE)
    path = os.pathsep.join([str(folder), str(Path(__file__).parents[1])])
    env = {name: value for name, value in os.environ.items() if name != DATA_DIR_VARIABLE}
    env |= {"PYTHONPATH": path, "XDG_CACHE_HOME": str(folder / "cache"), "COLUMNS": "200"}
    done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def rollout() -> str:
    """Play a handover in MuJoCo with the library's own inverse kinematics.

    Return the outcome, the number of steps and a hash of all actions and of the last observation.
    """
    data, episode = SyntheticDataset(), Episode("mujoco")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(yang2021, "ThreadIkSolver", PandaIkSolver)
        actions, _ = play(episode, data.load_scene(9), make("yang2021:wait=0", data))
    values = [actions, *map(np.asarray, episode.observe().values())]
    episode.close()
    return f"{episode.status.label} {episode.steps} {hashlib.sha256(b''.join(v.tobytes() for v in values)).hexdigest()}"


PROGRAM = """
import contextlib, io, json
import handover_marl
from handover_marl.cli import main
from handover_marl.errors import OptionError
from tests.helpers.short_episodes import shorten_episodes
from tests.test_without_pybullet import *

found = {{"rollout": rollout(), "commands": [], "environments": []}}
shorten_episodes(pytest.MonkeyPatch(), SHORT)
assert all(main([*RESULTS, {folder!r}]) == 0 for _ in range(2))
for arguments in (["doctor"], *(arguments for arguments, _ in REFUSED)):
    output = io.StringIO()
    with contextlib.redirect_stderr(output), contextlib.redirect_stdout(output):
        found["commands"].append((main(arguments), output.getvalue()))
for obs_mode in {obs_modes}:
    env = handover_marl.parallel_env(dataset="synthetic", physics="mujoco", obs_mode=obs_mode, scenes=[5])
    env.reset(seed=0)
    env.step({{agent: env.action_space(agent).sample() for agent in env.agents}})
    env.close()
camera = dict(physics="mujoco", obs_mode="state+pointcloud", renderer="bullet")
for options in (dict(physics="exact"), dict(), dict(physics="mujoco", render_mode="rgb_array"), camera):
    with pytest.raises(OptionError) as refusal:
        handover_marl.parallel_env(dataset="synthetic", **options)
    found["environments"].append(str(refusal.value))
print(json.dumps(found))
"""


@pytest.mark.slow
def test_the_library_runs_and_says_what_it_cannot(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Episodes equal those with PyBullet to the bit; commands and environments that need it name the alternative."""
    has_rays = importlib.util.find_spec("embreex") is not None
    modes, folder = ["state", "state+pointcloud"] if has_rays else ["state"], str(tmp_path / "results")
    found: dict[str, Any] = json.loads(
        run_without_pybullet(tmp_path, PROGRAM.format(obs_modes=modes, folder=folder))[-1]
    )
    (_, doctor), *refusals = found["commands"]
    assert "ok    physics         mujoco" in doctor
    assert "--physics mujoco" in doctor
    for (status, output), (_, advice) in zip(refusals, REFUSED, strict=True):
        assert status != 0
        assert NEEDS in output
        assert advice in output
        assert "Traceback" not in output
    for message in found["environments"]:
        assert NEEDS in message
        assert "physics='mujoco'" in message or "renderer='rays'" in message
    assert found["rollout"].startswith("success")
    if is_pybullet_installed():
        assert found["rollout"] == rollout()
        assert main([*RESULTS, folder]) != 0, "results with and without PyBullet do not share a folder"
        assert "'PyBullet' in the folder, '' now" in capsys.readouterr().err


def test_the_panda_that_ships_is_pybullets() -> None:
    pybullet_data = pytest.importorskip("pybullet_data")
    theirs = Path(pybullet_data.getDataPath()) / "franka_panda"
    files = sorted(path.relative_to(theirs) for path in theirs.rglob("*") if path.is_file())
    assert len(files) > 25
    own = {path.relative_to(PANDA_URDF.parent) for path in PANDA_URDF.parent.rglob("*") if path.is_file()}
    assert own - {*files} == {Path("panda_camera.urdf")}
    for file in files:
        assert (PANDA_URDF.parent / file).read_bytes() == (theirs / file).read_bytes()


POLICIES = f"""
import sys
import handover_marl
import pytest
from handover_marl.config import ProtocolConfig, WorldConfig
from handover_marl.geometry import distance_field
from handover_marl.simulation.engines import list_available_physics
from handover_marl.testing import check_giver, check_receiver
from tests.receivers.quick import shorten_planning

shorten_planning(pytest.MonkeyPatch())
distance_field._CELL = 0.03
assert list_available_physics() == ("mujoco",)
scene = dict(dataset="synthetic", split="test", physics="mujoco", scenes=[{SCENE}], workers=1)
short = WorldConfig(protocol=ProtocolConfig(horizon_steps={SHORT}))
for giver, receiver in {{pairs}}:
    robot = "panda_camera" if receiver.startswith("gaddpg") else "panda"
    report = handover_marl.evaluate_pair(giver, receiver, world_config=short, robot=robot, **scene)
    assert "mujoco physics without PyBullet" in str(report)
    print(receiver, report.episodes[0].status.label)
check_receiver("random", scenes=(9,), steps=200)
check_giver("noisy", scenes=(9,), steps=200)
assert "handover_marl.simulation.bullet.client" not in sys.modules
"""


@pytest.mark.slow
def test_policies_play_and_can_be_checked(tmp_path: Path) -> None:
    pairs = [("cooperative", "yang2021:wait=0.2"), ("noisy", "hold"), ("tired", "random")]
    if importlib.util.find_spec("igl") is not None:
        quick = "reactive:preparation_max_copies=1,preparation_held_time=0.15,preparation_free_time=0.002"
        pairs += [("replay", "omg_hand_aware:wait=0.2"), ("replay", quick)]
    if importlib.util.find_spec("torch") is not None and importlib.util.find_spec("embreex") is not None:
        pairs.append(("replay", "gaddpg:wait=0"))
    lines = run_without_pybullet(tmp_path, POLICIES.format(pairs=pairs))
    assert [line for line in lines if line.endswith(" timeout")] == [f"{receiver} timeout" for _, receiver in pairs]
