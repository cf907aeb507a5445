"""Tests of weights in the library's own format: small files without pickled objects, read by default."""

from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the extra `train`")

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


def test_they_are_small_and_say_nearly_the_same(file: Path) -> None:
    torch.manual_seed(0)
    network = GaddpgNetwork().eval()
    assert file.stat().st_size < 4_000_000
    found, fingerprint = read_network_weights(file, GaddpgNetwork)
    assert len(fingerprint) == 8
    points = np.zeros((4, 1030))
    points[:3] = np.random.default_rng(0).uniform(0.1, 0.3, (3, 1030))
    np.testing.assert_allclose(found.predict_step(points, 7), network.predict_step(points, 7), atol=2e-3)


def test_the_receiver_says_whose_they_are(file: Path) -> None:
    receiver = make(("gaddpg", {"weights": str(file)}), DATA)
    assert receiver.label.startswith("gaddpg@own weights ")


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
