"""Tests of report pages in a browser: they load nothing else, and lead to a failed episode in two clicks."""

import io
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.evaluation.quick import run

sync_api = pytest.importorskip("playwright.sync_api", reason="needs playwright (extra `dev`)")
pytest.importorskip("viser", reason="needs the extra `replay`")
pytest.importorskip("fast_simplification", reason="needs the extra `replay`")

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(BROWSER is None, reason="NO BROWSER: install Chromium (Debian: apt-get install chromium)"),
]
# Time limit (ms); rendering in software may take long.
PATIENCE = 120_000


@pytest.fixture(scope="module")
def results(fake_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a result folder with a failed episode and its replay."""
    folder = tmp_path_factory.mktemp("results")
    run(fake_data, folder, scenes=[14], replays="failed")
    return folder


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with sync_api.sync_playwright() as play:
        # Render without a graphics card. Disable the sandbox, which does not work for root, as in containers.
        options = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        started = play.chromium.launch(executable_path=BROWSER, args=options)
        yield started
        started.close()


def shown(page: Any) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(page.screenshot(timeout=PATIENCE))).convert("RGB"))


def near(pixels: np.ndarray, color: tuple[int, int, int], reach: int) -> int:
    return int((np.abs(pixels.astype(int) - color).max(axis=2) < reach).sum())


@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (400, "dark")])
def test_two_clicks_from_the_table_to_a_failed_episode(results: Path, browser: Any, width: int, scheme: str) -> None:
    page = browser.new_page(viewport={"width": width, "height": 800}, color_scheme=scheme)
    page.set_default_timeout(PATIENCE)
    troubles: list[str] = []
    requests: list[str] = []
    page.on("console", lambda said: troubles.append(said.text) if said.type == "error" else None)
    page.on("pageerror", lambda error: troubles.append(str(error)))
    page.on("request", lambda request: requests.append(request.url))
    page.goto((results / "report.html").as_uri())
    ground = shown(page)[2, 2]
    assert (ground.max() < 60) == (scheme == "dark")
    assert page.evaluate("document.documentElement.scrollWidth") == width
    page.get_by_role("link", name="timeout").click()
    page.get_by_role("link", name="replay").click()
    page.wait_for_url("**/episodes/014.html")
    assert "Scene 14" in page.title()
    assert page.evaluate("document.documentElement.scrollWidth") == width
    stage = page.frame_locator("iframe")
    stage.locator("canvas").first.wait_for()
    # By default, viser shows the canvas at 5 % opacity until the environment map is decoded: half a minute in software.
    opacities = stage.locator("canvas").evaluate_all("all => all.map(one => getComputedStyle(one).animationName)")
    assert opacities
    assert set(opacities) == {"appear"}
    time = stage.locator("input").first
    sync_api.expect(time).not_to_have_value("0.0", timeout=PATIENCE)
    for _ in range(60):
        pixels = shown(page)
        if near(pixels, (228, 87, 46), 70) > 100:
            break
        page.wait_for_timeout(500)
    assert near(pixels, (228, 87, 46), 70) > 100, "the object is nowhere to be seen"
    assert troubles == []
    assert [url for url in requests if not url.startswith(("file:", "data:", "blob:"))] == []
    page.close()
