"""Tests of the library in processes that cannot import PyBullet, as with Python 3.14."""

import hashlib
import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from handover_marl.assets.robot_model import PANDA_URDF
from handover_marl.cli import main
from handover_marl.datasets import DATA_DIR_VARIABLE
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.episode import Episode
from handover_marl.episode.loop import EpisodeCallback, run_episode
from handover_marl.execution.options import is_pybullet_installed
from handover_marl.planning.ik_solvers import PandaIkSolver
from handover_marl.receivers import make, yang2021

pytest.importorskip("mujoco", reason="without PyBullet, MuJoCo is what plays")

SCENE = 209
NEEDS = "needs PyBullet, which is not installed (it has wheels up to Python 3.13"
# Content of sitecustomize.py, which Python runs when it starts, also in worker processes.
BLOCKADE = 'import sys\nsys.modules["pybullet"] = sys.modules["pybullet_data"] = None\n'


@pytest.fixture(scope="module")
def elsewhere(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Return the environment variables of processes without PyBullet and with another cache folder."""
    folder = tmp_path_factory.mktemp("blockade")
    (folder / "sitecustomize.py").write_text(BLOCKADE)
    path = os.pathsep.join([str(folder), str(Path(__file__).parents[1])])
    variables = {name: value for name, value in os.environ.items() if name != DATA_DIR_VARIABLE}
    return {**variables, "PYTHONPATH": path, "XDG_CACHE_HOME": str(folder / "cache"), "COLUMNS": "200"}


def python(elsewhere: dict[str, str], code: str) -> str:
    """Run a program without PyBullet, and return its output."""
    done = subprocess.run([sys.executable, "-c", code], env=elsewhere, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def command(elsewhere: dict[str, str], *arguments: object) -> subprocess.CompletedProcess[str]:
    """Run a command of the library without PyBullet, and return its exit status and output."""
    words = [sys.executable, "-m", "handover_marl.cli", *map(str, arguments)]
    return subprocess.run(words, env=elsewhere, capture_output=True, text=True, check=False)


class Noting(EpisodeCallback):
    """Callback that hashes the observation of every 20th step."""

    def __init__(self) -> None:
        self.digest = hashlib.sha256()

    def on_step(self, episode: Episode) -> None:
        if episode.steps % 20 == 0:
            for value in episode.observe().values():
                self.digest.update(np.asarray(value).tobytes())


def rollout() -> str:
    """Play a handover in MuJoCo with the library's own inverse kinematics.

    Return the outcome, the number of steps and a hash of the observations.
    """
    data = SyntheticDataset()
    receiver, episode, noting = make("yang2021", data), Episode("mujoco"), Noting()
    episode.reset(data.load_scene(SCENE))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(yang2021, "make_ik_solver", PandaIkSolver)
        run_episode(episode, receiver, callbacks=[noting])
    episode.close()
    return f"{episode.status.label} {episode.steps} {noting.digest.hexdigest()}"


@pytest.mark.slow
@pytest.mark.skipif(not is_pybullet_installed(), reason="there is nothing to compare with")
def test_an_episode_is_the_same_to_the_bit(elsewhere: dict[str, str]) -> None:
    reported = python(elsewhere, "from tests.test_without_pybullet import *; print(rollout())").strip()
    assert reported == rollout()
    assert reported.startswith("success")


@pytest.mark.skipif(not is_pybullet_installed(), reason="there is nothing to compare with")
def test_the_panda_that_ships_is_pybullets() -> None:
    import pybullet_data

    theirs = Path(pybullet_data.getDataPath()) / "franka_panda"
    files = sorted(path.relative_to(theirs) for path in theirs.rglob("*") if path.is_file())
    assert len(files) > 25
    own = {path.relative_to(PANDA_URDF.parent) for path in PANDA_URDF.parent.rglob("*") if path.is_file()}
    assert own - {*files} == {Path("panda_camera.urdf")}
    for file in files:
        assert (PANDA_URDF.parent / file).read_bytes() == (theirs / file).read_bytes()


#: Steps of episodes in which agents observe and act, but which end before the handover.
SHORT = 700
PLAYING = f"""
import sys
import handover_marl
from handover_marl.config import OFFICIAL_CONFIG, ProtocolConfig, WorldConfig
from handover_marl.execution.options import is_pybullet_installed
from handover_marl.simulation.engines import list_available_physics
from handover_marl.testing import check_giver, check_receiver

assert not is_pybullet_installed()
assert list_available_physics() == ("mujoco",)
scene = dict(dataset="synthetic", physics="mujoco", scenes=[{SCENE}], workers=1)
short = WorldConfig(protocol=ProtocolConfig(horizon_steps={SHORT}))
for giver, receiver, is_whole in {{pairs}}:
    report = handover_marl.evaluate_pair(giver, receiver, world_config=OFFICIAL_CONFIG if is_whole else short, **scene)
    assert "mujoco physics without PyBullet" in str(report)
    fluency = report.episodes[0].fluency
    assert fluency.min_distance is None or 0.0 <= fluency.min_distance < 1.0
    print(receiver, report.episodes[0].status.label)
check_receiver("random", scenes=(9,), steps=100)
check_giver("noisy", scenes=(9,), steps=100)
assert "handover_marl.simulation.bullet.client" not in sys.modules
"""


@pytest.mark.slow
def test_policies_play_and_can_be_checked(elsewhere: dict[str, str]) -> None:
    """Shipped policies play in one process; `reactive` plays a whole handover."""
    pairs = [("cooperative", "yang2021", False), ("noisy", "hold", False), ("tired", "random", False)]
    if importlib.util.find_spec("igl") is not None:
        # The number of copies limits the time of the validation of grasps.
        pairs += [("replay", "omg_hand_aware:wait=0.1", False), ("replay", "reactive:preparation_max_copies=1", True)]
    if importlib.util.find_spec("torch") is not None and importlib.util.find_spec("embreex") is not None:
        pairs.append(("replay", "vision", False))
    reported = python(elsewhere, PLAYING.format(pairs=pairs)).splitlines()
    assert [line.partition(" ")[0] for line in reported] == [receiver for _, receiver, _ in pairs]
    for line, (_, _, is_whole) in zip(reported, pairs, strict=True):
        assert line.endswith(" success") == is_whole, line


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("embreex") is None, reason="the extra vision is not installed")
def test_gaddpg_moves_towards_points(elsewhere: dict[str, str]) -> None:
    """GA-DDPG moves the gripper without PyBullet's inverse kinematics; the network always predicts a step forwards."""
    python(
        elsewhere,
        f"""
import numpy as np
from handover_marl.datasets import open_dataset
from handover_marl.episode.episode import Episode
from handover_marl.episode.loop import run_episode
from handover_marl.receivers import make
from handover_marl.receivers.gaddpg import GaddpgReceiver
data = open_dataset("synthetic", robot="panda_camera")
asked = []
def ahead(points, remaining):
    asked.append(remaining)
    return np.array([0.0, 0.0, 0.03, 0.0, 0.0, 0.05])
receiver, episode = GaddpgReceiver(make("hold", data).context, ahead), Episode("mujoco")
episode.reset(data.load_scene({SCENE}))
start = episode.observe()["gripper_pose"]
run_episode(episode, receiver, until=lambda: len(asked) == 4 or episode.steps > 9000)
way = episode.observe()["gripper_pose"][:3] - start[:3]
assert len(asked) == 4
assert 0.04 < np.linalg.norm(way) < 0.1, way
""",
    )


ENVIRONMENT = f"""
import numpy as np
import pytest
import handover_marl
from handover_marl.errors import OptionError
scene = dict(dataset="synthetic", split="test", scenes=[{SCENE}])
for obs_mode in {{obs_modes}}:
    env = handover_marl.parallel_env(physics="mujoco", obs_mode=obs_mode, **scene)
    observations, _ = env.reset(seed=0)
    for _ in range(15):
        actions = {{{{agent: env.action_space(agent).sample() for agent in env.agents}}}}
        observations, *_ = env.step(actions)
        if not env.agents:
            break
    env.close()
refused = dict(physics="exact"), dict(physics="fast"), dict(), dict(physics="mujoco", render_mode="rgb_array")
for options in (*refused, dict(physics="mujoco", obs_mode="state+pointcloud", renderer="bullet")):
    with pytest.raises(OptionError, match="needs PyBullet.*up to Python 3.13.*(physics='mujoco'|renderer='rays')"):
        handover_marl.parallel_env(dataset="synthetic", **options)
"""


@pytest.mark.slow
def test_environments_run_and_say_what_they_cannot(elsewhere: dict[str, str]) -> None:
    has_rays = importlib.util.find_spec("embreex") is not None
    python(elsewhere, ENVIRONMENT.format(obs_modes=["state", "state+pointcloud"] if has_rays else ["state"]))


#: Commands that need PyBullet, and what their errors recommend.
REFUSED: list[tuple[list[str], str]] = [
    (["benchmark", "--setup", "s3", "--receiver", "yang2021"], "take physics='mujoco' (--physics mujoco)"),
    (["benchmark", "--physics", "fast"], "take physics='mujoco' (--physics mujoco)"),
    (["agreement", "--receiver", "hold"], "take physics='mujoco'"),
    (["render", "--scene", str(SCENE), "--physics", "mujoco", "--out", "video.gif"], "--out FILE.html"),
    (["import", "--dexycb", "here", "--mano", "here", "--out", "there"], "import with Python 3.10 to 3.13"),
]


@pytest.fixture(scope="module")
def refusals(elsewhere: dict[str, str]) -> list[tuple[int, str]]:
    """Return the exit status and the error messages of each refused command, which run in one process."""
    reported = python(
        elsewhere,
        f"""
import contextlib, io, json
from handover_marl.cli import main
found = []
for arguments in {[arguments for arguments, _ in REFUSED]}:
    errors = io.StringIO()
    with contextlib.redirect_stderr(errors), contextlib.redirect_stdout(io.StringIO()):
        status = main(arguments)
    found.append((status, errors.getvalue()))
print(json.dumps(found))
""",
    )
    return [(status, errors) for status, errors in json.loads(reported)]


@pytest.mark.slow
@pytest.mark.parametrize("number", range(len(REFUSED)), ids=[arguments[0] for arguments, _ in REFUSED])
def test_commands_say_what_they_cannot(refusals: list[tuple[int, str]], number: int) -> None:
    status, errors = refusals[number]
    assert status != 0
    assert NEEDS in errors
    assert REFUSED[number][1] in errors
    assert "Traceback" not in errors


def test_the_doctor_says_what_can_be_played(elsewhere: dict[str, str]) -> None:
    reported = command(elsewhere, "doctor").stdout
    assert "ok    physics         mujoco" in reported
    assert "--physics mujoco" in reported


@pytest.mark.slow
@pytest.mark.skipif(not is_pybullet_installed(), reason="there is no result with PyBullet")
def test_results_with_and_without_do_not_share_a_folder(
    elsewhere: dict[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--dataset", "synthetic", "--physics", "mujoco", "--split", "val", "--scenes", "9", "--workers", "1"]
    arguments = ["benchmark", "--receiver", "hold", *options, "--out", str(tmp_path / "out")]
    python(
        elsewhere, f"from handover_marl.cli import main; assert main({arguments}) == 0; assert main({arguments}) == 0"
    )
    assert main(arguments) != 0
    assert "'PyBullet' in the folder, '' now" in capsys.readouterr().err
