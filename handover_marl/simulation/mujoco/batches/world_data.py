"""State of one world in MuJoCo during an episode, and its simulation."""

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco.batch import Batch

from handover_marl.simulation.mujoco.contacts import SensorReadings
from handover_marl.simulation.mujoco.engine import check_warnings
from handover_marl.simulation.mujoco.models.scene_model import SceneModel

Array = npt.NDArray[np.float64]

_STATE = mujoco.mjtState
# Controls of a step in MuJoCo's order: actuator targets, then mocap poses.
_CONTROLS = int(_STATE.mjSTATE_CTRL | _STATE.mjSTATE_MOCAP_POS | _STATE.mjSTATE_MOCAP_QUAT)
# State that a step changes, the start of a state vector: all components from the time to the warm start.
_STEP_STATE = 2 * int(_STATE.mjSTATE_WARMSTART) - 1


class WorldData:
    """Model and state of a world during one episode, in the initial state of the model.

    Args:
        scene: Model of the scene.
        batch: Batch of one world of MuJoCo whose model has the layout of the scene's model. Worlds may share a
            batch: each rollout starts with setting its state.

    Attributes:
        scene: Model of the scene.
        batch: Batch of MuJoCo that simulates the world.
        released: Whether the human has released the target object.
        qpos: Writable view of the joint positions (q,), like the following arrays.
        qvel: Joint velocities (v,).
        ctrl: Actuator targets (u,).
        mocap_pos: Positions (m, 3) of the mocap bodies (m).
        mocap_quat: Quaternions wxyz (m, 4) of the mocap bodies.
        time: Simulation time (1,) (s).
        sensordata: Data (s,) of the sensors in the last step.
    """

    def __init__(self, scene: SceneModel, batch: Batch) -> None:
        self.scene, self.batch, self.released = scene, batch, False
        # Variants that were used in this episode are held, since they are likely to be used again.
        self._variants: dict[tuple[bool, bool], mujoco.MjModel] = {}
        batch.set_models(scene.model)
        batch.reset(stage=int(mujoco.mjtStage.mjSTAGE_NONE))
        self._state = batch.state[0].copy()
        self.time, self.qpos, self.qvel = (
            self._view(part) for part in (_STATE.mjSTATE_TIME, _STATE.mjSTATE_QPOS, _STATE.mjSTATE_QVEL)
        )
        self.ctrl, self._forces = self._view(_STATE.mjSTATE_CTRL), self._view(_STATE.mjSTATE_XFRC_APPLIED, 6)
        self.mocap_pos = self._view(_STATE.mjSTATE_MOCAP_POS, 3)
        self.mocap_quat = self._view(_STATE.mjSTATE_MOCAP_QUAT, 4)
        self.sensordata = np.zeros(scene.model.nsensordata)

    @property
    def step_state_size(self) -> int:
        """Number p of the values of the state that a step changes: time, positions, velocities and warm start."""
        return int(mujoco.mj_stateSize(self.scene.model, _STEP_STATE))

    def select_model(self, hand_collides: bool) -> "mujoco.MjModel":
        """Return the variant of the scene model for the coming steps.

        Args:
            hand_collides: Whether the hand can collide in these steps.
        """
        key = self.released, hand_collides
        if key not in self._variants:
            self._variants[key] = self.scene.variants.select(*key)
        return self._variants[key]

    def release_object(self, gravity: float) -> None:
        """Release the target object: it falls, and collides with table, ground and other objects.

        Args:
            gravity: Gravity along world z (m/s^2).
        """
        self.released = True
        body = self.scene.objects[0]
        self._forces[body, 2] = gravity * float(self.scene.model.body_mass[body])

    def simulate(self, hand_collides: bool, controls: Array, sensordata: Array, step_states: Array) -> None:
        """Simulate k physics steps from this state, which is not changed; see `set_step`.

        Args:
            hand_collides: Whether the hand can collide in these steps.
            controls: Controls (k, c): actuator targets, mocap positions, mocap quaternions wxyz.
            sensordata: Array (k, s) to write the sensor data of each step to.
            step_states: Array (k, p) to write the changed part of the state after each step to.

        Raises:
            SimulationError: The engine failed; the written values are invalid.
        """
        batch, model = self.batch, self.select_model(hand_collides)
        if batch.models is not model:
            batch.set_models(model)
        batch.state[0], batch.warning[0] = self._state, 0
        records = {"sensordata": sensordata[None], _STEP_STATE: step_states[None]}
        batch.rollout(len(controls), controls[None], _CONTROLS, tuple(records), out=records)
        check_warnings(batch)

    def set_step(self, controls: Array, sensordata: Array, step_state: Array) -> None:
        """Set the state to that after a simulated step.

        Args:
            controls: Controls (c,) of the step.
            sensordata: Sensor data (s,) of the step.
            step_state: Changed part (p,) of the state after the step.
        """
        self._state[: len(step_state)], self.sensordata[:] = step_state, sensordata
        self.ctrl[:], self.mocap_pos[:], self.mocap_quat[:] = self.split_controls(controls)

    def split_controls(self, controls: Array) -> tuple[Array, Array, Array]:
        """Split controls (..., c) into views of actuator targets (..., u), mocap positions and quaternions.

        Returns:
            Targets (..., u), positions (..., m, 3) (m), quaternions wxyz (..., m, 4).
        """
        u, m, shape = len(self.ctrl), len(self.mocap_pos), controls.shape[:-1]
        positions, quaternions = controls[..., u : u + 3 * m], controls[..., u + 3 * m :]
        return controls[..., :u], positions.reshape(*shape, m, 3), quaternions.reshape(*shape, m, 4)

    def get_joint_positions(self, step_states: Array) -> Array:
        """Return the joint positions (..., q) from the changed parts (..., p) of states."""
        size = len(self.time)
        positions: Array = step_states[..., size : size + len(self.qpos)]
        return positions

    def read_sensors(self) -> SensorReadings:
        """Return the contact-sensor readings of the last physics step."""
        return SensorReadings(self.scene.contact_sensors, self.sensordata, self.qpos)

    def _view(self, component: "mujoco.mjtState", columns: int | None = None) -> Array:
        """Return a view of a component of the state, as rows with a number of columns."""
        model, bit = self.scene.model, int(component)
        # Components are stored in the order of their bits.
        first = mujoco.mj_stateSize(model, bit - 1)
        part: Array = self._state[first : first + mujoco.mj_stateSize(model, bit)]
        return part if columns is None else part.reshape(-1, columns)
