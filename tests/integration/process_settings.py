"""Play shipped policies, and return a hash of each episode; as a program, change settings of the process before."""

import hashlib
import json
import locale
import os
import random
import struct
import sys
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

#: Name of the locale in a process with the environment that `install_comma_locale` returns.
COMMA = "comma"
_MAGIC, _CATEGORY = 0x20031115, 1
FOLDER = Path(__file__).parent
LEARNED = FOLDER.parent / "data" / "v0_7_0" / "policies" / "receiver.npz"
SCENE, STEPS = 209, 120
#: Physics and receivers, with a giver that each is played with.
EPISODES = (
    ("exact", "yang2021:wait=0.1", "cooperative"),
    ("mujoco", "yang2021:wait=0.1", "stop_when_near"),
    ("exact", "omg:wait=0.1", "replay"),
    ("mujoco", "reactive", "noisy"),
    ("exact", "gaddpg:wait=0.1", "withdrawing"),
    ("mujoco", "vision", "hesitant"),
    ("mujoco", f"learned:{LEARNED}", "adaptive"),
    ("exact", "random", "recording_spread"),
)


def install_comma_locale(folder: Path) -> dict[str, str]:
    """Write the locale's category LC_NUMERIC in the GNU C library's format; return the environment of its processes."""
    if not sys.platform.startswith("linux"):
        pytest.skip("needs the GNU C library")
    # Decimal point, separator of thousands, grouping, the first two as wide characters, and the character set.
    values = [b",\0", b"\0", b"\xff\xff", struct.pack("=I", ord(",")), struct.pack("=I", 0), b"UTF-8\0"]
    offsets, content, start = [], b"", 4 * (2 + len(values))
    for value in values:
        content += b"\0" * (-(start + len(content)) % 4 if len(value) == 4 else 0)
        offsets.append(start + len(content))
        content += value
    (folder / COMMA).mkdir(parents=True)
    header = struct.pack(f"={2 + len(values)}I", _MAGIC ^ _CATEGORY, len(values), *offsets)
    (folder / COMMA / "LC_NUMERIC").write_bytes(header + content)
    return os.environ | {"LOCPATH": str(folder)}


def set_numpy() -> None:
    np.seterr(all="raise")
    np.set_printoptions(precision=1, threshold=2, suppress=True, legacy="1.13")


def seed_generators() -> None:
    random.seed(7)
    np.random.seed(7)  # noqa: NPY002
    torch.manual_seed(7)


def read_generators() -> tuple[object, ...]:
    return random.getstate(), str(np.random.get_state()), torch.get_rng_state().tolist()  # noqa: NPY002


#: Settings that the program that calls the library may have changed before.
SETTINGS: tuple[Callable[[], object], ...] = (
    lambda: locale.setlocale(locale.LC_NUMERIC, COMMA),
    lambda: os.umask(0o777),
    lambda: warnings.simplefilter("error"),
    set_numpy,
    seed_generators,
    lambda: torch.set_default_dtype(torch.bfloat16),
    lambda: torch.autocast("cpu", dtype=torch.bfloat16).__enter__(),
    lambda: torch.set_float32_matmul_precision("medium"),
    lambda: torch.set_default_device("meta"),
    lambda: torch.use_deterministic_algorithms(True),
    lambda: torch.set_flush_denormal(True),
    lambda: torch.set_num_threads(2),
    lambda: torch.set_grad_enabled(False),
)


def play(reference: str, giver: str, physics: str) -> str:
    """Play an episode of `STEPS` ms, and return a hash of the actions and the last observation."""
    # Imported only here, as by a program that changes settings first.
    from handover_marl import givers, receivers
    from handover_marl.datasets import open_dataset
    from handover_marl.episode.camera_observations import SensorConfig
    from handover_marl.episode.episode import Episode
    from handover_marl.episode.loop import ActionRecorder, run_episode
    from handover_marl.geometry.panda import PANDA, PANDA_CAMERA
    from tests.integration.test_causality import make_receiver

    robot = PANDA_CAMERA if reference.startswith(("gaddpg", "vision")) else PANDA
    dataset = open_dataset("synthetic", robot=robot)
    receiver, recorder = make_receiver(reference, dataset), ActionRecorder()
    assert receivers.list_available()
    episode = Episode(physics, sensors=SensorConfig("rays" if physics != "exact" else "bullet"))
    episode.reset(dataset.load_scene(SCENE))
    run_episode(episode, receiver, givers.make(giver, dataset), seed=1, until=STEPS, callbacks=[recorder])
    digest = hashlib.sha256(recorder.actions.tobytes())
    for value in episode.observe().values():
        digest.update(value.tobytes())
    digest.update(f"{episode.status} {episode.release_step} {episode.steps}".encode())
    episode.close()
    return digest.hexdigest()[:16]


def apply(module: torch.nn.Module) -> str:
    """Apply a user's module as a policy and as the policy file made of it, and return a hash of the outputs."""
    from handover_marl.learning.adapters.function_policy import TorchFunction
    from handover_marl.learning.adapters.modules import dense_network_from_module

    inputs = np.linspace(-1.0, 1.0, 30, dtype=np.float32)
    outputs = TorchFunction(module)(inputs), dense_network_from_module(module)(inputs)
    return hashlib.sha256(b"".join(one.tobytes() for one in outputs)).hexdigest()[:16]


def hash_results(change_settings: bool = False) -> dict[str, str]:
    """Return the hash of each episode and of a user's module, and check that no global random generator changes."""
    module = torch.nn.Sequential(torch.nn.Linear(30, 50), torch.nn.Tanh(), torch.nn.Linear(50, 4))
    for number, parameter in enumerate(module.parameters()):
        torch.nn.init.normal_(parameter, generator=torch.Generator().manual_seed(number))
    if change_settings:
        for change in SETTINGS:
            change()
    before = read_generators()
    found = {" ".join(one): play(one[1], one[2], one[0]) for one in EPISODES}
    found["module"] = apply(module)
    assert read_generators() == before, "a global random generator has changed"
    return found


if __name__ == "__main__":
    print("hashes:", json.dumps(hash_results(change_settings=True)))
