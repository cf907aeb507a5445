"""Tests of weights in the library's own format: small files without pickled objects, read by default."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the extra `train`")

from handover_marl.assets.shipped import GADDPG_WEIGHTS, find_vision_weights  # noqa: E402
from handover_marl.datasets.splits import SETUPS, get_prescribed_side, list_split_scenes  # noqa: E402
from handover_marl.datasets.synthetic import SyntheticDataset  # noqa: E402
from handover_marl.errors import DataFormatError, DataNotFoundError  # noqa: E402
from handover_marl.learning.networks.gaddpg_network import GaddpgNetwork  # noqa: E402
from handover_marl.learning.networks.weights import read_network_weights, write_network_weights  # noqa: E402
from handover_marl.receivers import gaddpg, make  # noqa: E402

DATA = SyntheticDataset(robot="panda_camera")


@pytest.fixture
def file(tmp_path: Path) -> Path:
    torch.manual_seed(0)
    path = tmp_path / "policy.npz"
    write_network_weights(path, GaddpgNetwork(), {"made by": "a test"})
    return path


def test_without_options_the_shipped_ones_are_taken(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gaddpg, "GADDPG_WEIGHTS", file)
    assert make("gaddpg", DATA).label.startswith("gaddpg@own weights ")
    monkeypatch.setattr(gaddpg, "GADDPG_WEIGHTS", file.with_name("none.npz"))
    with pytest.raises(DataNotFoundError, match=r"none\.npz: cannot read these weights"):
        make("gaddpg", DATA)


def test_others_are_refused(file: Path, tmp_path: Path) -> None:
    with pytest.raises(DataNotFoundError):
        read_network_weights(tmp_path / "none.npz", GaddpgNetwork)
    damaged = tmp_path / "damaged.npz"
    damaged.write_bytes(file.read_bytes()[:1000])
    with pytest.raises(DataFormatError):
        read_network_weights(damaged, GaddpgNetwork)
    with np.load(file) as content:
        arrays = dict(content)
    for name, value in (("about", np.array("{}")), ("policy.mean.bias", np.full(6, np.nan, dtype=np.float32))):
        np.savez(damaged, **(arrays | {name: value}))
        with pytest.raises(DataFormatError):
            read_network_weights(damaged, GaddpgNetwork)
    np.savez(damaged, **(arrays | {"policy.mean.bias": np.array([object()])}), allow_pickle=True)
    with pytest.raises(DataFormatError):
        read_network_weights(damaged, GaddpgNetwork)


@pytest.mark.parametrize(
    ("path", "setups"),
    [(GADDPG_WEIGHTS, SETUPS), *((find_vision_weights(setup), (setup,)) for setup in SETUPS)],
    ids=["gaddpg", *SETUPS],
)
def test_shipped_weights_were_not_trained_on_test_scenes(path: Path, setups: tuple[str, ...]) -> None:
    """Trainings use the scenes that are in the train splits of all setups that the card of a file names.

    The cards have no paths, and the files are small.
    """
    assert path.stat().st_size < (1_900_000 if path == GADDPG_WEIGHTS else 1_500_000)
    with np.load(path) as content:
        about = json.loads(str(content["about"]))
    command = about["made_by"]["made by"]
    assert path != GADDPG_WEIGHTS or about["settings"]["max_steps"] == 30
    assert "/" not in re.sub(r"^experiments/\w+\.py", "", command)
    named = re.search(r"\bsetups?=(\([^)]*\)|'[^']*')", command)
    assert named is not None
    assert "dataset='dexycb'" in command
    assert tuple(re.findall(r"s\d", named[1])) == setups
    used = set.intersection(*(set(list_split_scenes(setup, "train", get_prescribed_side)) for setup in setups))
    assert used
    for setup in setups:
        assert used.isdisjoint(list_split_scenes(setup, "test", get_prescribed_side))
