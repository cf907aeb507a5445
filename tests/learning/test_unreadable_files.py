"""Tests of policies, weights and training files whose reading would never end or fill the memory: they are refused."""

import io
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

pytest.importorskip("torch")

from handover_marl.errors import DataFormatError, HandoverError
from handover_marl.learning.imitation.gaddpg.data_generation import ImitationStates
from handover_marl.learning.imitation.run import read_samples
from handover_marl.learning.networks.gaddpg_network import GaddpgNetwork, read_gaddpg_checkpoint
from handover_marl.learning.networks.weights import read_network_weights
from handover_marl.learning.policy_files import read_policy
from handover_marl.learning.training.run_folder import read_checkpoint
from handover_marl.policies.reference import read_policy_file
from tests.helpers.unreadable import UNREADABLE, check_refusal

READERS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "policy": ("policy.npz", lambda path: read_policy(path, "giver")),
    "own policy": ("weights.bin", read_policy_file),
    "weights": ("weights.npz", lambda path: read_network_weights(path, GaddpgNetwork)),
    "GA-DDPG": ("DDPG_actor_PandaYCBEnv_latest", lambda path: read_gaddpg_checkpoint(path.parent)),
    "checkpoint": ("checkpoint.pt", lambda path: read_checkpoint(path, print)),
    "samples": ("samples.npz", lambda path: read_samples(ImitationStates, path)),
}


@pytest.mark.parametrize("kind", UNREADABLE)
@pytest.mark.parametrize("reader", READERS)
def test_unreadable_file(reader: str, kind: str, tmp_path: Path) -> None:
    name, read = READERS[reader]
    check_refusal(read, tmp_path / name, kind, HandoverError)


@pytest.mark.parametrize("reader", ["policy", "weights", "GA-DDPG"])
def test_archives_that_unpack_to_gigabytes(reader: str, tmp_path: Path) -> None:
    stream, (name, read) = io.BytesIO(), READERS[reader]
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("about.npy", b"")
    packed = bytearray(stream.getvalue())
    # In the central directory, at the end of the archive, the size is 22 bytes before the name.
    size = packed.rindex(b"about.npy") - 22
    packed[size : size + 4] = struct.pack("<I", 4_000_000_000)
    for file in (tmp_path / name, tmp_path / name.replace("_actor_", "_state_feat_")):
        file.write_bytes(packed)
    with pytest.raises(DataFormatError, match=f"{tmp_path}/.*more than [0-9]* MB"):
        read(tmp_path / name)
