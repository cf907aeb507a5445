"""Lists of the scenes on which the shipped weights were trained."""

import hashlib
import re
from pathlib import Path
from typing import Any

import pytest
import yaml

torch = pytest.importorskip("torch", reason="needs the extra `train`")

import handover_marl.givers  # noqa: E402
from experiments.analysis.list_training_scenes import (  # noqa: E402
    SCENES_SUFFIX,
    Args,
    TrainingSceneList,
    list_scenes_of_training,
    main,
)
from handover_marl.assets.object_models import DATA_ROOT  # noqa: E402
from handover_marl.datasets import OfficialDataset  # noqa: E402
from handover_marl.datasets.splits import SETUPS, get_prescribed_side, list_split_scenes  # noqa: E402
from handover_marl.datasets.synthetic import SyntheticDataset  # noqa: E402
from tests.learning.training.scripts import script  # noqa: E402

CARDS = Path(__file__).parents[2] / "docs" / "reference" / "model_cards.md"
GIVERS = Path(handover_marl.givers.__file__).parent / "policies"
WEIGHTS = sorted([*DATA_ROOT.glob("vision_*.npz"), DATA_ROOT / "gaddpg.npz", *GIVERS.glob("*.npz")])
# The hands of its last trials are known from recordings only.
NEEDS_RECORDINGS = DATA_ROOT / "vision_s2.npz"
DATA = SyntheticDataset(robot="panda_camera")


def text_of(weights: Path) -> str:
    return weights.with_suffix(SCENES_SUFFIX).read_text()


def scenes_of(weights: Path) -> TrainingSceneList:
    return TrainingSceneList(**yaml.safe_load(text_of(weights)))


@pytest.mark.parametrize("weights", [path for path in WEIGHTS if path != NEEDS_RECORDINGS], ids=lambda path: path.stem)
def test_lists_follow_from_the_files(weights: Path) -> None:
    assert text_of(weights) == list_scenes_of_training(weights, DATA).format()


def test_the_list_of_s2_follows_from_its_file(real_dataset: OfficialDataset) -> None:
    assert text_of(NEEDS_RECORDINGS) == list_scenes_of_training(NEEDS_RECORDINGS, real_dataset).format()


@pytest.mark.parametrize("weights", WEIGHTS, ids=lambda path: path.stem)
def test_no_scene_of_a_test_split_was_used(weights: Path) -> None:
    scenes = scenes_of(weights)
    used = {*scenes.training, *scenes.held_out, *scenes.selection}
    assert used
    for setup in scenes.setups:
        # Without recordings, scenes of unknown hand are in no split of s2 here.
        assert not set(scenes.training) & set(list_split_scenes(setup, "test", lambda _: "unknown")), setup
    if len(scenes.setups) == 1:
        assert not used & set(list_split_scenes(scenes.setups[0], "test", lambda _: "unknown"))


def test_hands_of_s2() -> None:
    scenes = scenes_of(NEEDS_RECORDINGS)
    known = [scene for scene in scenes.training if scene % 5 < 4]
    assert {get_prescribed_side(scene) for scene in known} == {"right"}


@pytest.mark.parametrize("setup", [setup for setup in SETUPS if setup != "s2"])
def test_vision_is_trained_on_them(setup: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("tensorboard")
    train = script("train_vision", monkeypatch)
    run: Any = train.Training(train.Args(dataset="synthetic", setup=setup, out=str(tmp_path / "run")))
    scenes = scenes_of(DATA_ROOT / f"vision_{setup}.npz")
    assert (list(run._scenes["synthetic"]), list(run._held_out)) == (scenes.training, scenes.held_out)


def test_gaddpg_is_trained_on_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("tensorboard")
    train = script("train_gaddpg", monkeypatch)
    run: Any = train.Training(train.Args(dataset="synthetic", out=str(tmp_path / "run")))
    scenes = scenes_of(DATA_ROOT / "gaddpg.npz")
    assert (list(run._generator.scenes), list(run._val)) == (scenes.training, scenes.selection)


def test_the_giver_is_trained_on_them(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("stable_baselines3")
    train = script("train_giver_sb3", monkeypatch)
    config = train.Args(dataset="synthetic").make_env_config()
    assert list(config.scenes) == scenes_of(GIVERS / "for_yang2021.npz").training


def test_the_script_writes_them(tmp_path: Path) -> None:
    weights = tmp_path / "vision_s3.npz"
    weights.write_bytes((DATA_ROOT / "vision_s3.npz").read_bytes())
    main(Args(dataset="synthetic", files=(weights,)))
    assert text_of(weights) == text_of(DATA_ROOT / "vision_s3.npz")


@pytest.mark.parametrize("weights", WEIGHTS, ids=lambda path: path.stem)
def test_cards_give_hashes_and_numbers_of_scenes(weights: Path) -> None:
    rows = [re.findall(r"[^|`]+", line) for line in CARDS.read_text().splitlines() if f"{weights.name}` |" in line]
    first, second = ([part.strip() for part in row if part.strip()] for row in rows)
    content, scenes = weights.read_bytes(), scenes_of(weights)
    assert first[-1] == hashlib.sha256(content).hexdigest()[:8]
    assert first[-2] == f"{len(content) / 1000:,.0f}"
    assert second[1:4] == [
        str(len(scenes.training)),
        str(len(scenes.held_out)),
        f"{scenes.selection_setup} val, {len(scenes.selection)}",
    ]


def test_cards_count_training_scenes_in_test_splits(real_dataset: OfficialDataset) -> None:
    splits = [set(real_dataset.list_scenes(setup, "test")) for setup in SETUPS]
    for weights in WEIGHTS:
        counts = [len(split & set(scenes_of(weights).training)) for split in splits]
        (_, line) = (line for line in CARDS.read_text().splitlines() if f"{weights.name}` |" in line)
        assert line.endswith(f" | {' | '.join(map(str, counts))} |"), weights.name
    selection = set(scenes_of(DATA_ROOT / "gaddpg.npz").selection)
    assert [len(split & selection) for split in splits] == [0, 0, 0, 4]
