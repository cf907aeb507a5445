"""Controls, cards and image grids of the givers of a population."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from experiments.strangers.measure_controls import NO_PREVIEW, count_changes, format_noise_floor, list_conditions
from experiments.strangers.measure_controls import Args as ControlArgs
from experiments.strangers.measure_controls import main as measure_controls
from experiments.strangers.render_image_grids import Args as GridArgs
from experiments.strangers.render_image_grids import main as render_image_grids
from experiments.strangers.render_image_grids import project_points
from handover_marl.config import CameraConfig
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.episode import Episode
from handover_marl.errors import OptionError
from handover_marl.policies.populations import load_population
from handover_marl.policies.reference import parse_policy
from tests.docs.pages import REPOSITORY
from tests.learning.training.scripts import script
from tests.short_episodes import shorten_episodes

# Difference of two equal outcomes, with its interval.
_NO_GAIN = "+0.0 (-65.3 to +65.3)"


def test_noise_floor_counts_changed_outcomes() -> None:
    entry = {
        "outcomes": {"none 0": ["success", "drop"], "perturbation 0": ["success"] * 2, "perturbation 1": ["drop"] * 2}
    }
    assert count_changes([entry]) == (2, 4)
    assert format_noise_floor([entry]) == "50.0 (15.0 to 85.0), n = 4"
    assert format_noise_floor([{"outcomes": {"none 0": ["success"]}}]) == "-"


def test_controls_are_measured_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shorten_episodes(monkeypatch, 2000)
    options: dict[str, Any] = {"dataset": "synthetic", "receiver": "hold", "names": ("hurried",), "workers": 1}
    args = ControlArgs(out=tmp_path / "controls.json", n_scenes=1, n_perturbations=1, **options)
    measure_controls(args)
    rows = [[cell.strip() for cell in line.split("|")] for line in capsys.readouterr().out.splitlines()]
    assert rows[2][1:6] == ["hurried", "0.0 (0.0 to 79.3)", "0.0 (0.0 to 79.3), n = 1", f"{_NO_GAIN}, n = 1", "-"]
    stored = args.out.read_text()
    outcomes = json.loads(stored)["givers"]["hurried"]["outcomes"]
    assert outcomes == {"none 0": ["timeout"], "perturbation 0": ["timeout"], "start 0": ["timeout"]}
    args.out.write_text(stored.replace("timeout", "drop"))
    measure_controls(args)
    assert "timeout" not in args.out.read_text(), "nothing was simulated again"
    with pytest.raises(OptionError, match="same setting"):
        measure_controls(replace(args, offset=0.1))


def test_only_givers_with_that_control_use_the_preview(tmp_path: Path) -> None:
    dataset, population = SyntheticDataset(), load_population()
    episode = Episode("fast")
    episode.reset(dataset.load_scene(5))
    observations = []
    for _ in range(5):
        observations.append(episode.observe_giver(episode.observe()))
        episode.advance(observations[0]["robot_joint_position"], 400)
    episode.close()
    for partner in population.givers:
        conditions = [condition.kind for condition in list_conditions(ControlArgs(out=tmp_path), partner)]
        if NO_PREVIEW in conditions:
            continue
        seeing, blind = (
            parse_policy("giver", population.get_policy(partner)).make(dataset, setup="s0") for _ in range(2)
        )
        for policy in (seeing, blind):
            policy.prepare(dataset.load_scene(5).info.object_names)
            policy.reset(3)
        for observation in observations:
            unseen = {key: np.zeros_like(value) if "replay" in key else value for key, value in observation.items()}
            np.testing.assert_array_equal(blind.act(unseen), seeing.act(observation), err_msg=partner.name)


def test_cards_are_up_to_date(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    cards = script("make_cards", monkeypatch)
    monkeypatch.chdir(REPOSITORY)
    page = REPOSITORY / "docs" / "reference" / "strangers_v1.md"
    (tmp_path / "strangers_v1").symlink_to(page.with_suffix(""))
    cards.main(cards.Args(out=tmp_path / "strangers_v1.md"))
    assert page.read_text() == (tmp_path / "strangers_v1.md").read_text(), "run make_cards.py again"


def test_image_grid_has_a_row_for_each_giver(tmp_path: Path) -> None:
    args = GridArgs(out=tmp_path, families=("place",), receiver="hold", times=(0.1, 0.2), width=80)
    render_image_grids(args)
    with Image.open(tmp_path / "place.jpg") as image:
        assert image.size == (160, 240)


def test_points_are_projected_as_the_camera_sees_them() -> None:
    camera = CameraConfig(width=200, height=100, position=(2.0, 0.0, 1.0), target=(0.0, 0.0, 1.0), vertical_fov=90.0)
    pixels = project_points(camera, [(0.0, 0.0, 1.0), (0.0, 1.0, 1.0), (0.0, 0.0, 2.0)])
    np.testing.assert_allclose(pixels, [[100.0, 50.0], [125.0, 50.0], [100.0, 25.0]])
