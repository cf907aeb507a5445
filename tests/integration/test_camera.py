"""Tests of the wrist camera: equality with recordings of the reference, and agreement of its two renderers."""

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from handover_marl.datasets import OfficialDataset
from handover_marl.episode.episode import Episode
from handover_marl.simulation.camera.images import SegmentationLabel
from tests.conftest import RECORDINGS
from tests.integration.test_reference import STRIDE

pytestmark = pytest.mark.slow

#: Steps that are compared; one recording is played to its end, and one until its images of another direction.
MAX_STEPS, WHOLE, ASIDE = 1520, "camera_scene297_omg", "camera_scene883_random"
NAMES = sorted(path.stem for path in Path(RECORDINGS).glob("camera/*.npz")) if RECORDINGS else ["none"]
#: Labels of the recordings' body numbers: ground 0, table 1, Panda 2, object 3, hand 4, nothing -1.
SEEN = np.array(
    [SegmentationLabel[name] for name in ("BACKGROUND", "TABLE", "ROBOT", "TARGET", "HAND", "BACKGROUND")], np.uint8
)


class Clouds:
    """Point clouds of object and hand in a recording, by frame."""

    def __init__(self, recording: dict[str, npt.NDArray[np.generic]]) -> None:
        ends = {name: np.cumsum(recording[f"{name}_cloud_size"])[:-1] for name in ("object", "hand")}
        parts = [np.split(recording[f"{name}_cloud"], ends[name]) for name in ("object", "hand")]
        self.by_frame = dict(zip(recording["cloud_frames"].tolist(), zip(*parts, strict=True), strict=True))


@pytest.mark.parametrize("name", NAMES)
def test_recorded_views_are_seen(name: str, recordings: Path, real_data: Path) -> None:
    with np.load(recordings / f"camera/{name}.npz") as archive:
        expected = dict(archive)
    clouds, episode = Clouds(expected).by_frame, Episode("exact")
    episode.reset(OfficialDataset(real_data, robot="panda_camera").load_scene(int(expected["scene_id"])))
    actions = expected["action"][: {WHOLE: None, ASIDE: 3001}.get(name, MAX_STEPS)]
    for step in range(len(actions) + 1):
        if step in clouds:
            view = episode.capture_wrist_camera()
            np.testing.assert_array_equal(view.object_points, clouds[step][0], err_msg=f"object at {step}")
            np.testing.assert_array_equal(view.hand_points, clouds[step][1], err_msg=f"hand at {step}")
            if f"depth_{step}" in expected:
                np.testing.assert_array_equal(view.depth, expected[f"depth_{step}"])
                np.testing.assert_array_equal(view.segmentation, SEEN[expected[f"segmentation_{step}"]])
        if step == len(actions):
            break
        assert not episode.status
        episode.advance(actions[step], 1)
        if step % STRIDE == 0:
            seen = episode.observe()
            for key, value in (
                ("robot_joint_position", seen["robot_joint_position"]),
                ("object_pose", seen["object_poses"][0]),
                ("hand_dof_position", seen["hand_dof_position"]),
            ):
                np.testing.assert_array_equal(value, expected[key][step // STRIDE], err_msg=f"{key} after {step + 1}")
    if name == WHOLE:
        assert (episode.status, episode.steps) == (expected["status"], expected["steps"])
    episode.close()
