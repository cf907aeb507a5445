"""The comparison of MuJoCo Warp with MuJoCo; here both simulate with MuJoCo, without compiling Warp's kernels."""

import re
from pathlib import Path

import pytest

from tests.learning.training.scripts import script


def test_equal_backends_agree(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("mujoco", reason="needs MuJoCo")
    module = script("measure_warp_agreement", monkeypatch)
    monkeypatch.setattr(module, "WARP", module.THREADS)
    out = tmp_path / "agreement.md"
    module.main(module.Args(receiver="hold", dataset="synthetic", scenes=1, horizon=50, out=out))
    assert re.search(
        r"Running at the horizon: 1 and 1\. The object was released in both in 0 episodes", out.read_text()
    )
