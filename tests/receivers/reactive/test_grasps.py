"""What is kept of grasps that were tried out."""

from pathlib import Path

import numpy as np
import pytest

from handover_marl.assets.object_models import object_urdf
from handover_marl.models.poses import IDENTITY
from handover_marl.receivers.reactive import grasps
from handover_marl.receivers.reactive.grasps import GraspTrials, TriedGrasps, tried_grasps


def test_every_robot_has_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Trials that need no particular robot are shared; what its fingers hold is not."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    known, done = np.array([IDENTITY]), []

    def tried(*arguments: object) -> TriedGrasps:
        done.append("tried")
        return TriedGrasps(known, np.ones(1))

    def finished(urdf: Path, panda: Path, *arguments: object) -> TriedGrasps:
        done.append(panda.name)
        return TriedGrasps(known, np.full(1, float(len(panda.name))))

    monkeypatch.setattr(grasps, "_try", tried)
    monkeypatch.setattr(grasps, "_finish", finished)
    robots = [tmp_path / "panda", tmp_path / "panda_camera"]
    for robot in robots:
        robot.write_text(robot.name)
    urdf = object_urdf("025_mug")
    for _ in range(2):
        found = [tried_grasps(urdf, robot, known, GraspTrials()) for robot in robots]
        assert [float(grasps.holds[0]) for grasps in found] == [5.0, 12.0]
    assert done == ["tried", "panda", "panda_camera"]
