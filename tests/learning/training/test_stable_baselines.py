"""Tests of reading checkpoints of Stable-Baselines3 models without running code from them."""

import io
import pickle
from pathlib import Path
from typing import Any

import pytest

from handover_marl.errors import ResultsError
from tests.learning.training.evil import Evil

torch = pytest.importorskip("torch", reason="needs the extra `train`")
sb3 = pytest.importorskip("stable_baselines3", reason="needs the extra `train`")


def model(width: int = 4) -> Any:
    options = {"n_steps": 8, "batch_size": 8, "n_epochs": 1, "device": "cpu"}
    return sb3.PPO("MlpPolicy", "CartPole-v1", policy_kwargs={"net_arch": [width]}, **options)


def flat(state: Any) -> list[Any]:
    if isinstance(state, dict):
        return [part for key in sorted(state, key=str) for part in (str(key), *flat(state[key]))]
    if isinstance(state, list):
        return [part for each in state for part in flat(each)]
    return [state.tolist() if isinstance(state, torch.Tensor) else state]


def test_saved_checkpoint_is_loaded(tmp_path: Path) -> None:
    from handover_marl.learning.training.stable_baselines import load_checkpoint, save_checkpoint

    first, second = model().learn(16), model()
    save_checkpoint(first, tmp_path / "checkpoint.pt")
    drawn = torch.rand(3)
    load_checkpoint(second, tmp_path / "checkpoint.pt")
    assert torch.equal(torch.rand(3), drawn), "random numbers continue"
    assert flat(second.get_parameters()) == flat(first.get_parameters())
    assert flat(second.get_parameters()["policy.optimizer"])
    assert second.num_timesteps == 16
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoint.pt"]
    state = torch.load(tmp_path / "checkpoint.pt", weights_only=True)
    assert set(state) == {"parameters", "num_timesteps", "random"}


def evil_files(marker: Path) -> list[bytes]:
    state = {"parameters": Evil(marker), "num_timesteps": 0, "random": torch.get_rng_state()}
    contents = [pickle.dumps(each, protocol=2) for each in (Evil(marker), state)]
    for new in (True, False):
        stream = io.BytesIO()
        torch.save(state, stream, _use_new_zipfile_serialization=new)
        contents.append(stream.getvalue())
    return contents


@pytest.mark.parametrize("kind", range(4))
def test_checkpoints_do_not_run_code(tmp_path: Path, kind: int) -> None:
    from handover_marl.learning.training.stable_baselines import load_checkpoint

    path = tmp_path / "checkpoint.pt"
    path.write_bytes(evil_files(tmp_path / "ran")[kind])
    with pytest.raises(
        ResultsError, match=r"(?s)checkpoint\.pt: not a checkpoint of this run .*remove it to start anew"
    ):
        load_checkpoint(model(), path)
    assert not (tmp_path / "ran").exists()
    if kind == 0:
        pickle.loads(path.read_bytes())
        assert (tmp_path / "ran").exists(), "unpickling runs the code"


@pytest.mark.parametrize("content", [b"", b"no checkpoint", b"PK\x03\x04"])
def test_damaged_checkpoints_are_refused(tmp_path: Path, content: bytes) -> None:
    from handover_marl.learning.training.stable_baselines import load_checkpoint

    (tmp_path / "checkpoint.pt").write_bytes(content)
    with pytest.raises(ResultsError, match="not a checkpoint of this run"):
        load_checkpoint(model(), tmp_path / "checkpoint.pt")


def test_checkpoints_of_other_models_are_refused(tmp_path: Path) -> None:
    from handover_marl.learning.training.stable_baselines import load_checkpoint, save_checkpoint

    save_checkpoint(model(5), tmp_path / "checkpoint.pt")
    with pytest.raises(ResultsError, match="not a checkpoint of this run"):
        load_checkpoint(model(4), tmp_path / "checkpoint.pt")
    torch.save({"weights": torch.zeros(3)}, tmp_path / "checkpoint.pt")
    with pytest.raises(ResultsError, match="KeyError"):
        load_checkpoint(model(4), tmp_path / "checkpoint.pt")
