"""Worlds of MuJoCo on the processor whose arrays are tensors on another device."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from handover_marl.config import PhysicsConfig, ProtocolConfig
from handover_marl.datasets.dataset import Scene
from handover_marl.geometry.arrays import NUMPY_ARRAYS, ArrayFactory, to_numpy
from handover_marl.simulation.engines import BatchBackend, make_worlds
from handover_marl.simulation.reference_tracking import ReferenceMotion
from handover_marl.simulation.world import Contacts, JudgeFunction, RolloutContacts, RolloutEnd, WorldState
from handover_marl.simulation.worlds import Worlds
from tests.fake_device import DeviceTensor


class TensorWorlds(Worlds):
    """Worlds that take and return tensors on a device; arguments as for `make_worlds`."""

    def __init__(self, config: PhysicsConfig, count: int, backend: BatchBackend, arrays: ArrayFactory) -> None:
        self._worlds, self._arrays = make_worlds(config, count, backend, NUMPY_ARRAYS), arrays

    def reset(self, row: int, scene: Scene, start: ReferenceMotion, robot_joints: Sequence[float]) -> None:
        assert type(row) is int
        self._worlds.reset(row, scene, start, robot_joints)

    def rollout(
        self, rows: Any, reference: ReferenceMotion, robot_targets: Any, judge: JudgeFunction, rules: ProtocolConfig
    ) -> Any:
        def judge_on_device(indices: Any, contacts: RolloutContacts) -> RolloutEnd:
            end = judge(self._arrays.asarray(indices), RolloutContacts(*map(self._arrays.asarray, contacts)))
            return RolloutEnd(*map(to_numpy, end))

        targets = ReferenceMotion(*(_read(getattr(reference, name)) for name in ("objects", "hand", "hand_present")))
        moved = _read(robot_targets, "float32")
        simulated = self._worlds.rollout(_read(rows, "int64"), targets, moved, judge_on_device, rules)
        return self._arrays.asarray(simulated)

    def release_targets(self, rows: Any) -> None:
        self._worlds.release_targets(_read(rows, "int64"))

    def read_state(self, rows: Any) -> WorldState:
        return WorldState(*map(self._arrays.asarray, self._worlds.read_state(_read(rows, "int64"))))

    def are_grasped(self, rows: Any, rules: ProtocolConfig) -> Any:
        return self._arrays.asarray(self._worlds.are_grasped(_read(rows, "int64"), rules))

    def read_contacts(self, row: int, released: bool) -> Contacts:
        assert type(row) is int
        return self._worlds.read_contacts(row, released)

    def close(self) -> None:
        self._worlds.close()


def _read(tensor: Any, dtype: str | None = None) -> Any:
    assert isinstance(tensor, DeviceTensor)
    values = to_numpy(tensor)
    assert dtype is None or values.dtype == np.dtype(dtype)
    return values
