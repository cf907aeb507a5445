"""The guide "Your own object and motion": its programs and results."""

from pathlib import Path
from typing import Any

import pytest

import handover_marl
from tests.docs.pages import REPOSITORY, blocks

PAGE = REPOSITORY / "docs" / "tutorials" / "own_object.md"
N_RECORDINGS = 20


def check_results(report: Any, min_success_rate: float) -> None:
    assert len(report.episodes) == N_RECORDINGS
    assert report.success_rate >= min_success_rate, str(report)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_receivers_take_the_bottle_of_the_guide(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("coacd", "trimesh", "igl", "torch", "embreex", "viser"):
        pytest.importorskip(module)
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    for block in blocks(PAGE, "python"):
        exec(block.text, names)
    assert names["scenes"].content.objects[0].n_grasps == 60
    assert set(names["scenes"].content.setups["people"]) == {"train", "val", "test"}
    check_results(names["report"], 0.8)
    assert len(list((tmp_path / "results" / "bottles" / "episodes").glob("*.html"))) == N_RECORDINGS
    check_results(
        handover_marl.benchmark(receiver="vision", dataset="own:bottles", physics="fast", progress=False), 0.6
    )
