import functools
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

import handover_marl
from handover_marl.benchmarking import workers
from handover_marl.benchmarking.playing import Task
from handover_marl.errors import DataFormatError, OptionError, WorkerError


def run(data: Path, n_workers: int | None, **options: Any) -> list[tuple[Any, ...]]:
    named = {"split": "val", "receiver": "hold", "scenes": (9, 14), "progress": False}
    report = handover_marl.benchmark(data_dir=data, workers=n_workers, **{**named, **options})
    return [(e.index, e.scene_id, e.status, e.steps, e.release_step, e.fingerprint) for e in report.episodes]


@pytest.mark.parametrize("n_workers", [0, -1, 1.5, "two", True])
def test_bad_numbers_of_workers(fake_data: Path, tmp_path: Path, n_workers: Any) -> None:
    with pytest.raises(OptionError, match="workers"):
        run(fake_data, n_workers, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_results_do_not_depend_on_workers_even_if_one_is_killed(
    fake_data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    alone = run(fake_data, 1)
    assert run(fake_data, 2) == alone
    start, killed = workers._Worker.start, []

    def start_and_kill(worker: Any, task: Task) -> None:
        start(worker, task)
        if not killed:
            killed.append(task.scene_id)
            worker.process.kill()

    monkeypatch.setattr(workers._Worker, "start", start_and_kill)
    with pytest.warns(RuntimeWarning, match="a worker died while playing scene (9|14) "):
        assert run(fake_data, 2) == alone
    assert killed


def test_workers_search_where_the_caller_does(fake_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "numpy.py").write_text("raise SystemExit('not the real one')")
    monkeypatch.chdir(tmp_path)
    assert run(fake_data, 2) == run(fake_data, 1)


def test_a_scene_that_kills_every_worker_ends_the_run(
    fake_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    start = workers._Worker.start

    def start_and_kill(worker: Any, task: Task) -> None:
        start(worker, task)
        if task.scene_id == 14:
            worker.process.kill()

    monkeypatch.setattr(workers._Worker, "start", start_and_kill)
    with pytest.raises(WorkerError, match="died twice while playing scene 14"):
        run(fake_data, 2, out=tmp_path)
    monkeypatch.undo()
    assert len(run(fake_data, 1, out=tmp_path)) == 2


def test_errors_in_workers_come_up_here(own_data: Path) -> None:
    path = own_data / "dex-ycb-cache" / "pose_014.npz"
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(DataFormatError, match="pose_014"):
        run(own_data, 2)


def test_ctrl_c_stops_soon_and_leaves_no_process(tmp_path: Path) -> None:
    # 36 scenes of 13 s each: it cannot end by itself in time.
    command = [sys.executable, "-m", "handover_marl.cli", "benchmark", "--split", "val", "--receiver", "hold"]
    command += ["--dataset", "synthetic", "--out", str(tmp_path / "out"), "--workers", "2"]
    # Tests that run in the background may have been told to ignore Ctrl-C, which children inherit.
    listen = functools.partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, preexec_fn=listen)
    while not (tmp_path / "out" / "config.yaml").exists():
        time.sleep(0.05)
    time.sleep(1.5)
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    assert len(children) == 2
    process.send_signal(signal.SIGINT)
    started = time.monotonic()
    assert process.wait(10) == 130
    assert time.monotonic() - started < 2.0
    assert "goes on from here" in str(process.stderr and process.stderr.read())
    for child in children:
        with pytest.raises(ProcessLookupError):
            os.kill(int(child), 0)
