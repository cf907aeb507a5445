import contextlib
import functools
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.evaluation import quick
from tests.helpers.equality import assert_equal

pytestmark = pytest.mark.slow

PROGRAM = "import sys; from handover_marl.cli import main; sys.exit(main())"


def files(folder: Path) -> dict[str, dict[str, np.ndarray]]:
    """Return the arrays of a folder's result files, without the measured times and the machine."""
    found = {}
    for path in sorted(folder.glob("*.npz")):
        with np.load(path) as archive:
            found[path.name] = {key: archive[key] for key in archive if key not in ("elapsed_time", "machine")}
    return found


def test_random_policies_are_independent_of_earlier_scenes(fake_data: Path, tmp_path: Path) -> None:
    """Results do not depend on the scenes simulated before in the same process."""
    drawing: dict[str, Any] = {"receiver": "random", "giver": "noisy"}
    quick.run(fake_data, tmp_path / "one", **drawing)
    for number in (14, 9):
        quick.run(fake_data, tmp_path / "apart", **drawing, scenes=[number])
    together = files(tmp_path / "one")
    assert list(together) == ["000.npz", "001.npz"]
    assert_equal(files(tmp_path / "apart"), together)
    # Both policies drew random numbers, which differ between scenes and seeds.
    first, second = (scene["action"][::100] for scene in together.values())
    assert len(np.unique(first, axis=0)) == len(first) == quick.HORIZON // 100
    assert not (first == second).any()


def test_ctrl_c_leaves_no_process(tmp_path: Path) -> None:
    # The 36 scenes of 13 s each take longer than this test, so that the process cannot end by itself.
    command = [sys.executable, "-c", PROGRAM, "benchmark", "--split", "val", "--receiver", "hold"]
    command += ["--dataset", "synthetic", "--out", str(tmp_path / "out"), "--workers", "2"]
    # Background processes may ignore Ctrl-C, and their children inherit this; the command must not.
    listen = functools.partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, preexec_fn=listen)
    while not (tmp_path / "out" / "config.yaml").exists():
        time.sleep(0.05)
    time.sleep(1.5)
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    assert len(children) >= 2
    process.send_signal(signal.SIGINT)
    started = time.monotonic()
    assert process.wait(10) == 130
    assert time.monotonic() - started < 2.0
    assert "resumes from here" in str(process.stderr and process.stderr.read())
    assert waited_for(lambda: all(ended(int(child)) for child in children), 2.0)


SLEEPING = """
import os, sys, time
from pathlib import Path
import handover_marl
from handover_marl.receivers.baselines import HoldReceiver

class Sleeping(HoldReceiver):
    name = "sleeping"

    def act(self, observation):
        Path(folder, str(os.getpid())).touch()
        time.sleep(60)

folder = sys.argv[2]
handover_marl.benchmark("s0", "val", Sleeping, data_dir=sys.argv[1], scenes=[9, 14], workers=2, progress=False)
"""


def ended(process: int) -> bool:
    """Return whether a process has ended, even if its parent has not yet read its exit status."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] in "ZX"
    except OSError:
        return True


def waited_for(condition: Any, seconds: float) -> bool:
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.02)
    return True


def test_workers_end_with_a_killed_parent(fake_data: Path, tmp_path: Path) -> None:
    """Workers end if their parent is killed during a scene, even if their policy sleeps."""
    (tmp_path / "script.py").write_text(SLEEPING)
    (tmp_path / "awake").mkdir()
    command = [sys.executable, str(tmp_path / "script.py"), str(fake_data), str(tmp_path / "awake")]
    process = subprocess.Popen(command)
    try:
        assert waited_for(lambda: len(list((tmp_path / "awake").iterdir())) == 2, 60.0)
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        assert {path.name for path in (tmp_path / "awake").iterdir()} <= set(children)
        assert not any(ended(int(child)) for child in children)
        process.kill()
        process.wait()
        assert waited_for(lambda: all(ended(int(child)) for child in children), 2.0)
    finally:
        process.kill()
        process.wait()
        for path in (tmp_path / "awake").iterdir():
            with contextlib.suppress(ProcessLookupError):
                os.kill(int(path.name), signal.SIGKILL)


SCRIPT = """
import sys
import numpy as np
import handover_marl
from handover_marl.config import ProtocolConfig, WorldConfig
from handover_marl.givers import Giver, make_giver_action
from handover_marl.receivers import Receiver

print("once")
SHIFT = 0.01

def shifted(joints):
    return joints + np.float32(SHIFT)

class Base(Receiver):
    control_period = 0.3

    def reset(self, seed=None):
        self.rng = np.random.default_rng(seed)

class Mine(Base):
    name = "mine"

    def act(self, observation):
        return shifted(np.float32(self.context.panda.start_joints) - self.rng.random() * np.float32(0.01))

class MyGiver(Giver):
    name = "mine"

    def reset(self, seed=None):
        self.rng = np.random.default_rng(seed)

    def act(self, observation):
        return make_giver_action(displacement=(0.0, 0.0, SHIFT * self.rng.random()))

config = WorldConfig(protocol=ProtocolConfig(horizon_steps=310))
for workers in (1, 2):
    try:
        report = handover_marl.evaluate_pair(
            MyGiver, Mine, split="val", scenes=[9, 14], data_dir=sys.argv[1], world_config=config, physics="fast",
            workers=workers, progress=False, out=f"{sys.argv[2]}/{workers}",
        )
        print(report.n_resumed, [(e.scene_id, e.status.label, e.steps, e.fluency) for e in report.episodes])
    except handover_marl.errors.ResultsError as error:
        print(error)
"""


def test_script_policies_in_workers(fake_data: Path, tmp_path: Path) -> None:
    """Workers use policies of a script without running it again, so that it needs no `__main__` guard.

    Results of policies that draw random numbers do not depend on the number of workers. They are resumed, but not with
    other code.
    """

    def run_script(text: str) -> list[str]:
        (tmp_path / "script.py").write_text(text)
        command = [sys.executable, str(tmp_path / "script.py"), str(fake_data), str(tmp_path / "out")]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()

    once, alone, together = run_script(SCRIPT)
    assert once == "once"
    assert alone == together
    assert alone.startswith("0 [(9, 'timeout', 310")
    one, two = (files(tmp_path / "out" / name) for name in ("1", "2"))
    assert_equal(two, one)
    assert [len(np.unique(arrays["action"], axis=0)) for arrays in one.values()] == [2, 2]
    assert run_script(SCRIPT)[1:] == [f"2{alone[1:]}"] * 2
    for refusal in run_script(SCRIPT.replace("np.float32(0.01)", "np.float32(0.02)"))[1:]:
        assert "another evaluation (receiver hash" in refusal
