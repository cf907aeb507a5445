"""Tests of the time series of evaluated episodes."""

from pathlib import Path

import numpy as np
import pytest

from handover_marl.config import ProtocolConfig, WorldConfig
from handover_marl.errors import OptionError
from handover_marl.evaluation.results import find_recordings
from tests.evaluation.quick import run


@pytest.mark.slow
def test_time_series_of_an_episode(tmp_path: Path) -> None:
    """A finished episode is simulated again; the columns agree with each other and with the metrics."""
    rules = WorldConfig(protocol=ProtocolConfig(horizon_steps=1000))
    options = {"dataset": "synthetic", "scenes": [9], "receiver": "omg:wait=0", "world_config": rules}
    run(None, tmp_path, **options)
    (fluency,) = [episode.fluency for episode in run(None, tmp_path, traces=True, **options).episodes]
    assert fluency is not None
    path = tmp_path / "traces" / "009.csv"
    assert find_recordings(tmp_path) == [path]
    rows = np.genfromtxt(path, delimiter=",", names=True)
    np.testing.assert_allclose(rows["time"], np.arange(51) * 0.02)
    gripper, wrist = (np.stack([rows[f"{point}_{axis}"] for axis in "xyz"], axis=1) for point in ("gripper", "wrist"))
    assert np.isfinite(wrist[-1]).all()
    np.testing.assert_allclose(rows["gripper_wrist_distance"], np.linalg.norm(gripper - wrist, axis=1), atol=1e-5)
    assert rows["gripper_speed"].max() == pytest.approx(fluency.gripper_max_speed, rel=1e-4) != 0.0
    assert rows["robot_object_force"].max() == pytest.approx(fluency.max_robot_object_force, rel=1e-4)
    with pytest.raises(OptionError, match="traces need an output folder"):
        run(None, traces=True, **options)
