"""Tests of heat maps."""

import io

import pytest
from PIL import Image

pytest.importorskip("matplotlib", reason="needs the extra `plot`")

from handover_marl.visualization.figures import draw_heat_map

LONG = "cooperative:" + ",".join(f"option_{number}=0.123" for number in range(30))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("rows", "columns"), [(["replay", LONG], ["hold"]), (["replay", "noisy"], [LONG])])
def test_long_names_are_wrapped_and_cut_off(rows: list[str], columns: list[str]) -> None:
    picture = Image.open(io.BytesIO(draw_heat_map([[0.5], [1.0]], rows, columns, "title")))
    assert max(picture.size) < 1500
