"""Tests of policies, weights and training files whose reading would never end or fill the memory: they are refused."""

import io
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")

from handover_marl.errors import DataFormatError, HandoverError
from handover_marl.learning.imitation.gaddpg.states import ImitationStates
from handover_marl.learning.imitation.samples import read_samples
from handover_marl.learning.networks.gaddpg_network import GaddpgNetwork, read_gaddpg_checkpoint
from handover_marl.learning.networks.weights import read_network_weights
from handover_marl.learning.policy_files import read_policy
from handover_marl.learning.training.run_folder import read_checkpoint
from handover_marl.policies.reference import read_policy_file
from tests.unreadable import UNREADABLE, check_refusal

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


def pack(members: dict[str, bytes], claims: str = "") -> bytes:
    """Return a zip archive; if `claims` names a member, its entry states a size of 4 GB."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    packed = bytearray(stream.getvalue())
    if claims:
        # In the central directory, at the end of the archive, the size is 22 bytes before the name.
        size = packed.rindex(claims.encode()) - 22
        packed[size : size + 4] = struct.pack("<I", 4_000_000_000)
    return bytes(packed)


def save_array(value: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, value)
    return stream.getvalue()


BOMBS: dict[str, tuple[str, bytes]] = {
    "array": ("policy", pack({"about.npy": save_array(np.zeros(3))}, claims="about.npy")),
    "weights array": ("weights", pack({"about.npy": save_array(np.zeros(3))}, claims="about.npy")),
    "checkpoint": ("GA-DDPG", pack({"data": b""}, claims="data")),
}


@pytest.mark.parametrize("bomb", BOMBS)
def test_archives_that_unpack_to_gigabytes(bomb: str, tmp_path: Path) -> None:
    reader, content = BOMBS[bomb]
    name, read = READERS[reader]
    (tmp_path / name).write_bytes(content)
    (tmp_path / name.replace("_actor_", "_state_feat_")).write_bytes(content)
    with pytest.raises(DataFormatError, match=f"{tmp_path}/.*more than [0-9]* MB"):
        read(tmp_path / name)
