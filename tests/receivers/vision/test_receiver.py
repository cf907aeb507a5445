"""Tests of the receiver `vision` and its weights."""

from pathlib import Path

import pytest
import torch

from handover_marl import receivers
from handover_marl.datasets import open_dataset
from handover_marl.episode.episode import Episode
from handover_marl.episode.loop import run_episode
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.errors import OptionError
from handover_marl.learning.networks.grasp_network import GraspNetwork
from handover_marl.learning.networks.weights import write_network_weights
from handover_marl.policies.reference import parse_policy

pytest.importorskip("embreex")
DATA = open_dataset("synthetic")


@pytest.mark.slow
def test_shipped_weights_succeed() -> None:
    receiver, episode = receivers.make("vision", DATA), Episode("fast")
    ends: list[EpisodeStatus] = []
    # Rounding differs between machines, and may change the outcome of single episodes: one of three is enough.
    for scene in (9, 39, 139):
        if EpisodeStatus.SUCCESS not in ends:
            episode.reset(DATA.load_scene(scene))
            run_episode(episode, receiver, seed=0)
            ends.append(episode.status)
    assert EpisodeStatus.SUCCESS in ends


def test_default_weights_depend_on_the_setup(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("handover_marl.assets.shipped.DATA_ROOT", tmp_path)
    hashes = set()
    for setup in ("s0", "s2"):
        torch.manual_seed(len(hashes))
        write_network_weights(tmp_path / f"vision_{setup}.npz", GraspNetwork(), {})
        reference = parse_policy("receiver", "vision").resolve(DATA, setup=setup)
        assert reference.label == "vision"
        hashes.add(reference.code_hash)
    assert len(hashes) == 2
    with pytest.raises(OptionError, match=r"s1.*--setup s1"):
        receivers.make("vision", DATA, setup="s1")
