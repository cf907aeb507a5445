"""Tests that a result folder is resumed only with the code, options and state that its results were made with."""

import importlib
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from handover_marl.errors import ResultsError
from handover_marl.receivers import Receiver
from tests.evaluation.quick import run

MINE = """
import numpy as np
from handover_marl.receivers import Receiver
{imports}

class Mine(Receiver):
    name = "mine"
    control_period = 1.0

    def __init__(self, context, more=0.0):
        super().__init__(context)
        self.more = more

    def reset(self, seed=None):
        pass

    def act(self, observation):
        return observation["robot_joint_position"] + np.float32({shift} + self.more)
"""

Write = Callable[..., type[Receiver]]


@pytest.fixture
def write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Write]:
    """Return a function that writes modules of user code and imports a receiver from them, as a new process would."""
    home = tmp_path / "code"
    home.mkdir()
    monkeypatch.syspath_prepend(home)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)

    def forget() -> None:
        for name in [name for name, module in sys.modules.items() if str(home) in str(getattr(module, "__file__", ""))]:
            del sys.modules[name]
        importlib.invalidate_caches()

    def written(module: str = "robots_of_mine", **files: str) -> type[Receiver]:
        forget()
        for name, text in files.items():
            path = home / f"{name.replace('__in__', '/')}.py"
            path.parent.mkdir(exist_ok=True)
            path.write_text(text)
        kind: type[Receiver] = importlib.import_module(module).Mine
        return kind

    yield written
    forget()


def mine(shift: object = "0.0", imports: str = "") -> str:
    return MINE.format(shift=shift, imports=imports)


def test_changed_code_cannot_resume(fake_data: Path, tmp_path: Path, write: Write) -> None:
    out = tmp_path / "out"

    def play(kind: type[Receiver], **options: Any) -> Any:
        return run(fake_data, out, receiver=kind, **options)

    play(write(robots_of_mine=mine(0.0)), scenes=[14])
    (out / "notes.txt").write_text("precious")
    assert play(write(robots_of_mine=mine(0.0))).n_resumed == 1
    changed = write(robots_of_mine=mine(0.01))
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    with pytest.raises(
        ResultsError, match=r"another evaluation \(receiver hash '[\w.]+' in the folder, '[\w.]+' now\).*fresh=True"
    ):
        play(changed)
    assert before == {path.name: path.read_bytes() for path in out.iterdir()}
    anew = play(changed, fresh=True, scenes=[9])
    assert anew.n_resumed == 0
    assert sorted(path.name for path in out.iterdir()) == [
        *("000.npz", "config.yaml", "episodes.csv", "notes.txt", "report.html", "report.json", "report.md")
    ]
    assert (out / "notes.txt").read_text() == "precious"
    again = play(changed)
    assert again.n_resumed == 1
    with np.load(out / "000.npz") as first, np.load(out / "001.npz") as second:
        np.testing.assert_array_equal(first["action"][0], second["action"][0])
        assert first["action"][0, 0] == np.float32(0.01)


def test_options_are_part_of_the_identity(fake_data: Path, tmp_path: Path, write: Write) -> None:
    kind = write(robots_of_mine=mine())
    run(fake_data, tmp_path / "out", receiver=(kind, {"more": 0.01}), scenes=[9])
    assert run(fake_data, tmp_path / "out", receiver="robots_of_mine:Mine:more=0.01", scenes=[9]).n_resumed == 1
    for other in ((kind, {"more": 0.02}), "robots_of_mine:Mine"):
        with pytest.raises(ResultsError, match=r"another evaluation \(receiver 'mine:more=0.01' in the folder"):
            run(fake_data, tmp_path / "out", receiver=other, scenes=[9])


SCRIPT = """
import sys
import handover_marl
from handover_marl.config import ProtocolConfig, WorldConfig
{mine}
config = WorldConfig(protocol=ProtocolConfig(horizon_steps=300))
try:
    report = handover_marl.evaluate_pair(
        "replay", Mine, split="val", scenes=[9], data_dir=sys.argv[1], out=sys.argv[2], world_config=config, workers=1,
        progress=False,
    )
    print("earlier", report.n_resumed)
except handover_marl.errors.ResultsError as error:
    print("refused", error)
"""


@pytest.mark.slow
def test_code_of_a_script_is_hashed(fake_data: Path, tmp_path: Path) -> None:
    said = []
    for shift in (0.0, 0.0, 0.01):
        (tmp_path / "script.py").write_text(SCRIPT.format(mine=mine(shift)))
        command = [sys.executable, str(tmp_path / "script.py"), str(fake_data), str(tmp_path / "out")]
        said.append(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    assert [line.strip() for line in said[:2]] == ["earlier 0", "earlier 1"]
    assert "another evaluation (receiver hash" in said[2]
