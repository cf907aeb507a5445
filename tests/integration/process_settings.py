"""Play shipped policies after changing a setting of the process, and print a hash of each episode.

`python process_settings.py SETTINGS PHYSICS STEPS [RECEIVER ...]`, with names of `SETTINGS` and of engines, separated
by commas.
"""

import decimal
import gc
import hashlib
import json
import locale
import os
import random
import sys
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from tests.comma_locale import COMMA

FOLDER = Path(__file__).parent
LEARNED = FOLDER.parent / "data" / "v0_7_0" / "policies" / "receiver.npz"
SCENE = 209
#: Receivers, with a giver that each is played with.
PAIRS = {
    "yang2021:wait=0.1": "cooperative",
    "omg:wait=0.1": "replay",
    "reactive": "noisy",
    "gaddpg:wait=0.1": "withdrawing",
    "vision": "hesitant",
    f"learned:{LEARNED}": "learned",
    "yang2021:wait=0.5": "stop_when_near",
    "yang2021:wait=0.6": "recording_spread",
    f"population:population={FOLDER / 'population.json'}": "population",
    "random": "tired",
    "hold": "hurried",
    "yang2021:wait=0.2": "displaced",
    "yang2021:wait=0.3": "early_release",
    "yang2021:wait=0.4": "interrupting",
}


def set_numpy() -> None:
    np.seterr(all="raise")
    np.set_printoptions(precision=1, threshold=2, suppress=True, legacy="1.13")


def seed_generators() -> None:
    random.seed(7)
    np.random.seed(7)  # noqa: NPY002
    torch.manual_seed(7)


def read_generators() -> tuple[object, ...]:
    return random.getstate(), str(np.random.get_state()), torch.get_rng_state().tolist()  # noqa: NPY002


def set_decimal() -> None:
    decimal.setcontext(decimal.Context(prec=1, rounding=decimal.ROUND_UP))


#: Settings by name: what the program that calls the library may do before.
SETTINGS: dict[str, Callable[[], object]] = {
    "none": lambda: None,
    "locale": lambda: locale.setlocale(locale.LC_NUMERIC, COMMA),
    "bfloat16": lambda: torch.set_default_dtype(torch.bfloat16),
    "autocast": lambda: torch.autocast("cpu", dtype=torch.bfloat16).__enter__(),
    "precision": lambda: torch.set_float32_matmul_precision("medium"),
    "device": lambda: torch.set_default_device("meta"),
    "deterministic": lambda: torch.use_deterministic_algorithms(True),
    "denormals": lambda: torch.set_flush_denormal(True),
    "threads": lambda: torch.set_num_threads(2),
    "gradients": lambda: torch.set_grad_enabled(False),
    "numpy": set_numpy,
    "warnings": lambda: warnings.simplefilter("error"),
    "generators": seed_generators,
    "decimal": set_decimal,
    "garbage": gc.disable,
    "umask": lambda: os.umask(0o777),
}


def play(reference: str, giver: str, physics: str, steps: int) -> str:
    """Play an episode of at most `steps` ms, and return a hash of the actions and the last observation."""
    # Imported only here, as by a program that changes settings first.
    from handover_marl import givers, receivers
    from handover_marl.datasets import open_dataset
    from handover_marl.episode.callbacks import ActionRecorder
    from handover_marl.episode.camera_observations import WristCameraConfig
    from handover_marl.episode.episode import Episode
    from handover_marl.episode.loop import run_episode
    from handover_marl.geometry.panda import PANDA, PANDA_CAMERA
    from tests.integration.test_causality import make_receiver

    robot = PANDA_CAMERA if reference.startswith(("gaddpg", "vision")) else PANDA
    dataset = open_dataset("synthetic", robot=robot)
    receiver, recorder = make_receiver(reference, dataset), ActionRecorder()
    assert receivers.list_available()
    episode = Episode(physics, wrist_camera=WristCameraConfig("rays" if physics != "exact" else "bullet"))
    episode.reset(dataset.load_scene(SCENE))
    run_episode(episode, receiver, givers.make(giver, dataset), seed=1, until=steps, callbacks=[recorder])
    digest = hashlib.sha256(recorder.actions.tobytes())
    for value in episode.observe().values():
        digest.update(value.tobytes())
    digest.update(f"{episode.status} {episode.release_step} {episode.steps}".encode())
    episode.close()
    return digest.hexdigest()[:16]


def main(settings: str, engines: str, steps: str, *chosen: str) -> None:
    for name in settings.split(","):
        SETTINGS[name]()
    before = read_generators()
    found = {
        f"{physics} {receiver} {giver}": play(receiver, giver, physics, int(steps))
        for physics in engines.split(",")
        for receiver, giver in PAIRS.items()
        if not chosen or receiver.partition(":")[0] in chosen
    }
    if read_generators() != before:
        raise SystemExit("a global random generator has changed")
    print("hashes:", json.dumps(found))


if __name__ == "__main__":
    main(*sys.argv[1:])
