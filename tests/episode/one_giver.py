"""Motion of one giver, and of several scenes, for tests."""

import numpy as np

from handover_marl.config import OFFICIAL_CONFIG
from handover_marl.datasets.dataset import Scene
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.giver_motion import NO_DEVIATION, GiverMotion, PlannedMotion
from handover_marl.simulation.reference_tracking import ReferenceMotion

CONFIG = OFFICIAL_CONFIG.giver
SCENES = [SyntheticDataset().load_scene(number) for number in (209, 5, 31, 87)]
COUNT = len(SCENES)
ROWS = np.arange(COUNT)
HIGH = np.array([1.0, *[CONFIG.displacement] * 3, *[CONFIG.rotation] * 3, 1.0], dtype=np.float32)


class OneGiver:
    """`GiverMotion` of a single giver, whose arrays have no leading axis of givers."""

    def __init__(self, scene: Scene) -> None:
        self.motion = GiverMotion(1, CONFIG)
        self._n_objects = self.motion.reset(0, scene).objects.shape[1]
        self._planned: PlannedMotion | None = None

    def plan(
        self, steps: int, action: np.ndarray = NO_DEVIATION, released: bool = False, is_opening: bool = False
    ) -> ReferenceMotion:
        flags = np.array([[released], [is_opening]])
        self._planned = self.motion.plan(ROWS[:1], steps, action[None], *flags)
        return self._planned.reference.select(0, self._n_objects)

    def commit(self, steps: int) -> None:
        assert self._planned is not None
        self.motion.commit(self._planned, np.array([steps]))

    @property
    def frame(self) -> int:
        return int(self.motion.state.frame[0])

    @property
    def holding(self) -> bool:
        return bool(self.motion.holding[0])

    @property
    def deviation(self) -> np.ndarray:
        return self.motion.deviation[0]

    @property
    def opening_progress(self) -> float:
        return float(self.motion.state.opening_progress[0])

    def preview(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the preview poses of wrist and object at a frame of the recording."""
        self.motion.state.frame[0] = frame
        wrists, objects = self.motion.read_previews(ROWS[:1])
        return wrists[0], objects[0]
