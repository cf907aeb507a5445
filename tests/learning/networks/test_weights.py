"""Tests of weights: checkpoints of the original code, generated here, and the library's own format."""

import json
import pickle
import re
import shutil
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from handover_marl.assets.shipped import GADDPG_WEIGHTS, find_vision_weights
from handover_marl.datasets.splits import SETUPS, get_prescribed_side, list_split_scenes
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.errors import DataFormatError, DataNotFoundError, UnsafeFileError
from handover_marl.learning.networks.gaddpg_network import GaddpgNetwork, read_gaddpg_checkpoint
from handover_marl.learning.networks.weights import read_network_weights, write_network_weights
from handover_marl.receivers import gaddpg, make

ACTOR, FEATURES = "DDPG_actor_PandaYCBEnv_latest", "DDPG_state_feat_PandaYCBEnv_latest"
STAGES = ((7, 64, 64, 128), (131, 128, 128, 256), (259, 256, 256, 512))


def encoder_weights(prefix: str, channels: int, rng: torch.Generator) -> dict[str, torch.Tensor]:
    weights = {}

    def norm(name: str, width: int) -> None:
        for part in ("weight", "bias", "running_mean"):
            weights[f"{name}.{part}"] = 0.3 * torch.randn(width, generator=rng)
        weights[f"{name}.running_var"] = 0.5 + torch.rand(width, generator=rng)
        weights[f"{name}.num_batches_tracked"] = torch.tensor(7)

    for stage, widths in enumerate(((channels + 3, *STAGES[0][1:]), *STAGES[1:])):
        for layer in range(3):
            name = f"{prefix}.0.{stage}.mlps.0.{3 * layer}"
            shape = (widths[layer + 1], widths[layer], 1, 1)
            weights[f"{name}.weight"] = torch.randn(shape, generator=rng) / widths[layer] ** 0.5
            norm(f"{prefix}.0.{stage}.mlps.0.{3 * layer + 1}", widths[layer + 1])
    for layer, (before, after) in enumerate(((512, 1024), (1024, 512))):
        weights[f"{prefix}.1.{3 * layer}.weight"] = torch.randn((after, before), generator=rng) / before**0.5
        weights[f"{prefix}.1.{3 * layer}.bias"] = torch.zeros(after)
        norm(f"{prefix}.1.{3 * layer + 1}", after)
    return weights


def head_weights(rng: torch.Generator) -> dict[str, torch.Tensor]:
    shapes = {"linear1": (256, 513), "linear2": (256, 256)}
    shapes |= {"mean": (6, 256), "extra_pred": (7, 256), "log_std_linear": (6, 256)}
    weights = {f"{name}.weight": torch.randn(shape, generator=rng) / 16.0 for name, shape in shapes.items()}
    return weights | {f"{name}.bias": torch.randn(shape[0], generator=rng) for name, shape in shapes.items()}


def as_saved(net: dict[str, torch.Tensor]) -> dict[str, Any]:
    """Return weights with the states of an optimizer and a schedule, as the original code saves them."""
    parameter = torch.nn.Parameter(torch.zeros(3))
    optimizer = torch.optim.Adam([parameter], lr=3e-4, eps=1e-5, weight_decay=1e-5)
    parameter.grad = torch.ones(3)
    optimizer.step()
    schedule = torch.optim.lr_scheduler.MultiStepLR(optimizer, milestones=[20000, 40000], gamma=0.5)
    return {"net": OrderedDict(net), "opt": optimizer.state_dict(), "sch": schedule.state_dict()}


@pytest.fixture(scope="module")
def made_up(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a generated checkpoint; tests share it, so do not write to it."""
    folder, rng = tmp_path_factory.mktemp("output") / "demo_model", torch.Generator().manual_seed(0)
    folder.mkdir()
    torch.save(as_saved(head_weights(rng)), folder / ACTOR)
    encoders = encoder_weights("module.encoder", 4, rng) | encoder_weights("module.value_encoder", 10, rng)
    torch.save({**as_saved(encoders), "step": 80_000}, folder / FEATURES)
    (folder / "config.yaml").write_text("RL_MAX_STEP: 20\n")
    return folder


@pytest.fixture
def own(made_up: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made_up, tmp_path / "own"))


def cloud() -> np.ndarray:
    rng = np.random.default_rng(0)
    points = rng.uniform((-0.05, -0.05, 0.2), (0.05, 0.05, 0.3), (1030, 3)).T
    return np.concatenate([points, np.zeros((1, 1030))])


def test_weights_come_to_their_layers(made_up: Path) -> None:
    network, fingerprint = read_gaddpg_checkpoint(made_up)
    saved = torch.load(made_up / FEATURES, weights_only=True)["net"]
    head = torch.load(made_up / ACTOR, weights_only=True)["net"]
    state = network.state_dict()
    for own, other in (
        ("features.stages.1.mlps.0.3.weight", saved["module.encoder.0.1.mlps.0.3.weight"]),
        ("features.stages.0.mlps.0.7.running_var", saved["module.encoder.0.0.mlps.0.7.running_var"]),
        ("features.dense.3.weight", saved["module.encoder.1.3.weight"]),
        ("policy.mean.weight", head["mean.weight"]),
    ):
        assert state[own].equal(other)
    count = sum(name.startswith("module.encoder.") for name in saved) + len(head)
    assert len(state) == count
    assert len(fingerprint) == 8
    assert np.ptp(network.predict_step(cloud(), 20)) > 0.01


def test_of_several_the_latest_is_taken(own: Path) -> None:
    _, latest = read_gaddpg_checkpoint(own)
    (own / "DDPG_actor_PandaYCBEnv_80000").write_bytes(b"")
    assert read_gaddpg_checkpoint(own)[1] == latest
    (own / "BC_actor_PandaYCBEnv_latest").write_bytes(b"")
    with pytest.raises(DataNotFoundError, match=r"got BC_actor_PandaYCBEnv_latest, DDPG_actor_.*; pass the path"):
        read_gaddpg_checkpoint(own)


class Evil:
    def __reduce__(self) -> tuple[Any, ...]:
        return (Path.touch, (Path("evil-was-here"),))


def test_files_that_ask_for_more_are_refused(own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(own)
    torch.save({"net": {"linear1.weight": Evil()}}, own / ACTOR)
    with pytest.raises(UnsafeFileError, match="more than weights"):
        read_gaddpg_checkpoint(own)
    (own / ACTOR).write_bytes(pickle.dumps(Evil()))
    with pytest.raises((UnsafeFileError, DataFormatError)):
        read_gaddpg_checkpoint(own)
    assert not Path("evil-was-here").exists()


def test_what_is_no_such_network_is_refused(own: Path) -> None:
    good = torch.load(own / ACTOR, weights_only=True)
    wrong: list[tuple[Any, str]] = [
        ([1, 2], "not a readable checkpoint of GA-DDPG"),
        ({"net": {"linear1.weight": 3}}, "not a readable checkpoint of GA-DDPG"),
        ({"net": {**good["net"], "mean.bias": torch.zeros(5)}}, "state_dict.*mean.bias"),
        ({"net": {name: value for name, value in good["net"].items() if name != "mean.bias"}}, "Missing key"),
        ({"net": {**good["net"], "mean.bias": torch.full((6,), float("nan"))}}, "must be finite"),
    ]
    for content, message in wrong:
        torch.save(content, own / ACTOR)
        with pytest.raises(DataFormatError, match=f"{ACTOR}.*{message}"):
            read_gaddpg_checkpoint(own)
    whole = (own / FEATURES).read_bytes()
    torch.save(good, own / ACTOR)
    (own / FEATURES).write_bytes(whole[: len(whole) // 2])
    with pytest.raises(DataFormatError, match=FEATURES):
        read_gaddpg_checkpoint(own)


def test_the_receiver_takes_them(made_up: Path) -> None:
    receiver = make(f"gaddpg:weights={made_up},wait=0", SyntheticDataset())
    assert receiver.label == f"gaddpg@{read_gaddpg_checkpoint(made_up)[1]}"
    assert receiver.wait == 0.0


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
    with pytest.raises(DataNotFoundError, match=r"none\.npz does not exist; .*train_gaddpg"):
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
    bias = "policy.mean.bias"
    for name, value in (("about", np.array("{}")), (bias, np.float32([np.nan] * 6)), (bias, np.array([object()]))):
        np.savez(damaged, **(arrays | {name: value}))
        with pytest.raises(DataFormatError):
            read_network_weights(damaged, GaddpgNetwork)


@pytest.mark.parametrize(
    ("path", "setups"),
    [
        (GADDPG_WEIGHTS, SETUPS),
        (find_vision_weights("segmentation", "s0"), ("s0",)),
        *((find_vision_weights("vision", setup), (setup,)) for setup in SETUPS),
    ],
    ids=["gaddpg", "segmentation", *SETUPS],
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
    assert "/" not in re.sub(r"^experiments/[\w/]+\.py", "", command)
    named = re.search(r"\bsetups?=(\([^)]*\)|'[^']*')", command)
    assert named is not None
    assert "dataset='dexycb'" in command
    assert tuple(re.findall(r"s\d", named[1])) == setups
    used = set.intersection(*(set(list_split_scenes(setup, "train", get_prescribed_side)) for setup in setups))
    assert used
    for setup in setups:
        assert used.isdisjoint(list_split_scenes(setup, "test", get_prescribed_side))
