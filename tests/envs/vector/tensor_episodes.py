"""Episodes in MuJoCo's physics on the processor whose arrays are tensors on another device."""

from types import SimpleNamespace
from typing import Any

import numpy as np

from handover_marl.config import WorldConfig
from handover_marl.datasets.dataset import Scene
from handover_marl.episode.batch.episodes import MujocoEpisodes
from handover_marl.episode.lockstep import RefereeStateBatch
from handover_marl.episode.observations import Observation
from handover_marl.geometry.arrays import make_tensor_factory, to_numpy
from handover_marl.simulation.contacts import Contacts
from tests.fake_device import DEVICE, DeviceTensor


class TensorEpisodes:
    """Batch of episodes that takes and returns tensors on a device; see `MujocoEpisodes`.

    Args:
        config: Simulated world, protocol and limits of the givers.
        count: Number of episodes.
    """

    def __init__(self, config: WorldConfig, count: int) -> None:
        self._episodes = MujocoEpisodes(config, count)
        self.arrays, self.config = make_tensor_factory(DEVICE.type), config

    @property
    def state(self) -> Observation:
        return self._move(self._episodes.state)

    @property
    def referees(self) -> RefereeStateBatch:
        return RefereeStateBatch(*map(self.arrays.asarray, self._episodes.referees))

    @property
    def motion(self) -> SimpleNamespace:
        motion = self._episodes.motion
        names = ("frame", "rate", "offset", "opening_progress", "holding", "deviation")
        return SimpleNamespace(**self._move({name: getattr(motion, name) for name in names}))

    @property
    def released(self) -> Any:
        return self.arrays.asarray(self._episodes.released)

    def reset(self, row: int, scene: Scene, seed: int = 0) -> None:
        assert type(row) is int
        self._episodes.reset(row, scene, seed)

    def advance(self, rows: Any, robot_targets: Any, steps: int, giver_actions: Any) -> None:
        robot, giver = _read(robot_targets, "float32"), _read(giver_actions, "float32")
        self._episodes.advance(_read(rows, "int64"), robot, steps, giver)

    def observe(self, rows: Any) -> None:
        self._episodes.observe(_read(rows, "int64"))

    def select_state(self, rows: Any) -> Observation:
        return self._move(self._episodes.select_state(_read(rows, "int64")))

    def select_giver_observation(self, rows: Any) -> Observation:
        return self._move(self._episodes.select_giver_observation(_read(rows, "int64")))

    def read_contacts(self, row: int) -> Contacts:
        assert type(row) is int
        return self._episodes.read_contacts(row)

    def are_grasped(self, rows: Any) -> Any:
        found = [self.read_contacts(row).both_fingers_touch for row in rows.tolist()]
        return self.arrays.asarray(np.array(found, dtype=bool))

    def make_infos(self, rows: Any) -> Any:
        return self._move(self._episodes.make_infos(_read(rows, "int64")))

    def close(self) -> None:
        self._episodes.close()

    def _move(self, values: dict[str, Any]) -> dict[str, Any]:
        return {key: self.arrays.asarray(value) for key, value in values.items()}


def _read(tensor: Any, dtype: str) -> Any:
    assert isinstance(tensor, DeviceTensor)
    values = to_numpy(tensor)
    assert values.dtype == dtype
    return values
