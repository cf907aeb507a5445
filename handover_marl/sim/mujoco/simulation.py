"""One scene's model being stepped, with MuJoCo's warnings as errors."""

import copy

import mujoco

from handover_marl.config import OBJECT_DOF
from handover_marl.errors import SimulationError
from handover_marl.sim.mujoco.scene_model import SceneModel
from handover_marl.sim.mujoco.scene_spec import RELEASED

_WARNINGS = {
    mujoco.mjtWarning.mjWARN_INERTIA: "the inertia of the bodies became singular",
    mujoco.mjtWarning.mjWARN_CONTACTFULL: "there were more contacts than its memory holds",
    mujoco.mjtWarning.mjWARN_CNSTRFULL: "there were more constraints than its memory holds",
    mujoco.mjtWarning.mjWARN_BADQPOS: "a position is not finite",
    mujoco.mjtWarning.mjWARN_BADQVEL: "a velocity is not finite",
    mujoco.mjtWarning.mjWARN_BADQACC: "an acceleration is not finite",
    mujoco.mjtWarning.mjWARN_BADCTRL: "a servo's target is not finite",
}

# Else they go to the console and into a file in the working folder; here they become errors.
if mujoco.get_mju_user_warning() is None:
    mujoco.set_mju_user_warning(lambda message: None)


class Simulation:
    """State of a scene model, with a copy of the model: letting go of an object changes it.

    Args:
        scene: The model.
        gravity: Along world z (m/s^2).

    Attributes:
        scene: The model as it was built.
        model: The copy that is simulated.
        data: Its state.
    """

    def __init__(self, scene: SceneModel, gravity: float) -> None:
        self.scene = scene
        self.model = copy.copy(scene.model)
        self.data = mujoco.MjData(self.model)
        self._weight = gravity * float(self.model.body_mass[scene.objects[0]])
        # Looked at after every step, so as plain bytes.
        self._warnings = memoryview(self.data.warning.number)
        self._none = bytes(self._warnings.nbytes)

    def reset(self) -> None:
        """Go to the model's own state, whatever was simulated before."""
        built, own = self.scene.model, self.model
        own.geom_conaffinity[:] = built.geom_conaffinity
        own.body_conaffinity[:] = built.body_conaffinity
        own.actuator_forcerange[:] = built.actuator_forcerange
        mujoco.mj_resetData(own, self.data)

    def step(self) -> None:
        """One step.

        Raises:
            SimulationError: The engine warned; its state means nothing any more.
        """
        mujoco.mj_step(self.model, self.data)
        if self._warnings.tobytes() != self._none:
            raise SimulationError(self._complaint())

    def free_target(self) -> None:
        """Let the target object move freely under gravity, and touch table, ground and other objects."""
        model, body = self.model, self.scene.objects[0]
        first = model.body_geomadr[body]
        model.geom_conaffinity[first : first + model.body_geomnum[body]] = int(RELEASED)
        model.body_conaffinity[body] = int(RELEASED)
        first = self.scene.object_ctrl.start
        model.actuator_forcerange[first : first + OBJECT_DOF] = 0.0
        self.data.xfrc_applied[body, 2] = self._weight

    def _complaint(self) -> str:
        found = [text for kind, text in _WARNINGS.items() if self.data.warning[int(kind)].number]
        return (
            f"MuJoCo's simulation broke down after {self.data.time:.3f} s: {'; '.join(found) or 'it warned'}. "
            "Play this scene with physics='fast', and report it"
        )
