"""Tests of the randomisation of cameras."""

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

import handover_marl
from handover_marl import CameraRandomization
from handover_marl.config import make_camera
from handover_marl.errors import OptionError
from tests.helpers.equality import assert_equal

Observation = dict[str, npt.NDArray[Any]]

SMALL = (make_camera("wrist", width=64, height=48), make_camera("front", width=64, height=48))
EVERY = CameraRandomization(0.3, 0.3, 0.01, 0.05, 0.05, 2.0, 0.003, 0.05)
KEYS = [f"{name}_{key}" for name in ("wrist", "front") for key in ("rgb", "depth", "object_points")]


def observe(count: int, randomization: CameraRandomization | None, seed: int = 5, **options: Any) -> Observation:
    """Return the camera data of `count` environments after a reset and a step."""
    own: dict[str, Any] = {"cameras": SMALL, "obs_mode": "rgbd+pointcloud", "dataset": "synthetic"} | options
    envs = handover_marl.vector_env(count, "receiver", camera_randomization=randomization, **own)
    envs.reset(seed=seed)
    observations = envs.step(envs.action_space.low)[0]
    envs.close()
    return {key: observations[key] for key in KEYS}


@pytest.mark.slow
@pytest.mark.parametrize("renderer", ["rays", "bullet"])
def test_draws_depend_on_the_seed_of_the_environment_only(renderer: str) -> None:
    pair = observe(2, EVERY, renderer=renderer)
    assert_equal(observe(2, EVERY, renderer=renderer), pair)
    assert_equal(observe(1, EVERY, seed=6, renderer=renderer), {key: value[1:] for key, value in pair.items()})
    plain = observe(2, None, renderer=renderer)
    for key in ("wrist_rgb", "wrist_depth", "front_rgb", "front_depth"):
        assert (pair[key] != plain[key]).any()


@pytest.mark.slow
def test_no_randomisation_is_the_default() -> None:
    assert_equal(observe(2, CameraRandomization()), observe(2, None))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "value", "changed"),
    [
        ("color", 0.5, {"rgb"}),
        ("brightness", 0.5, {"rgb"}),
        ("position", 0.02, {"rgb", "depth", "object_points"}),
        ("rotation", 0.05, {"rgb", "depth", "object_points"}),
        ("focal", 0.1, {"rgb", "depth", "object_points"}),
        ("principal", 5.0, {"rgb", "depth", "object_points"}),
        ("depth_noise_std", 0.01, {"depth", "object_points"}),
    ],
)
def test_each_value_changes_its_data(name: str, value: float, changed: set[str]) -> None:
    plain, other = observe(2, None), observe(2, CameraRandomization(**{name: value}))
    found = {key.split("_", 1)[1] for key in KEYS if not np.array_equal(plain[key], other[key])}
    assert found == changed


def test_calibration_is_that_of_the_configuration() -> None:
    random, plain = (
        handover_marl.parallel_env(dataset="synthetic", physics="mujoco", camera_randomization=own, cameras=SMALL)
        for own in (EVERY, None)
    )
    for name, info in random.camera_info().items():
        assert_equal(vars(info), vars(plain.camera_info()[name]))


@pytest.mark.slow
def test_late_images_show_an_earlier_step() -> None:
    """With a random latency of up to 1 s, images after 0.1 s are those of one of the steps before."""
    options: dict[str, Any] = {"dataset": "synthetic", "physics": "mujoco", "obs_mode": "depth", "cameras": SMALL[:1]}
    late, every = (
        handover_marl.parallel_env(camera_randomization=own, control_period=period, **options)
        for own, period in ((CameraRandomization(latency=1.0), 0.1), (None, 0.001))
    )
    actions = {"giver": np.zeros(8, np.float32), "receiver": late.action_space("receiver").high}
    late.reset(seed=4)
    seen = [every.reset(seed=4)[0]["receiver"]["wrist_depth"]]
    seen += [every.step(actions)[0]["receiver"]["wrist_depth"] for _ in range(300)]
    shown = [late.step(actions)[0]["receiver"]["wrist_depth"] for _ in range(3)][-1]
    assert [np.array_equal(shown, one) for one in seen].count(True) >= 1
    assert not np.array_equal(shown, seen[-1])


@pytest.mark.parametrize("value", [{"color": 2.0}, {"latency": -1.0}, {"focal": "a"}])
def test_values_out_of_range_are_refused(value: dict[str, Any]) -> None:
    with pytest.raises(OptionError, match=next(iter(value))):
        CameraRandomization(**value)
    with pytest.raises(OptionError, match="camera_randomization must be a CameraRandomization"):
        handover_marl.parallel_env(dataset="synthetic", camera_randomization=value)
