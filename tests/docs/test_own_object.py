"""Tests of the guide "Your own object and motion": its programs and results."""

from pathlib import Path
from typing import Any

import pytest

import handover_marl
from tests.docs.pages import REPOSITORY, blocks

pytestmark = pytest.mark.slow

PAGE = REPOSITORY / "docs" / "tutorials" / "own_object.md"
N_RECORDINGS = 5


def check_results(report: Any, n_episodes: int, min_success_rate: float) -> None:
    assert len(report.episodes) == n_episodes
    assert report.success_rate >= min_success_rate, str(report)


@pytest.mark.filterwarnings("ignore")
def test_receivers_take_the_bottle_of_the_guide(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("coacd", "trimesh", "igl", "torch", "embreex", "viser"):
        pytest.importorskip(module)
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    for block in blocks(PAGE, "python"):
        # The page makes 20 recordings.
        exec(block.text.replace("range(20)", f"range({N_RECORDINGS})"), names)
    assert names["scenes"].content.objects[0].n_grasps == 60
    assert set(names["scenes"].content.setups["people"]) == {"train", "val", "test"}
    check_results(names["report"], N_RECORDINGS, 0.8)
    assert len(list((tmp_path / "results" / "bottles" / "episodes").glob("*.html"))) == N_RECORDINGS
    few = range(0, N_RECORDINGS, 3)
    report = handover_marl.benchmark(
        receiver="vision", dataset="own:bottles", scenes=few, physics="fast", progress=False
    )
    check_results(report, len(few), 0.6)
