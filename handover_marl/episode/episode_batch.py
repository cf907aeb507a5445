"""Batch of handover episodes that are simulated together; arrays have one row for each episode."""

from handover_marl.config import TIME_STEP, WorldConfig
from handover_marl.datasets.dataset import Scene
from handover_marl.episode.giver_motion import GiverMotion, requests_release
from handover_marl.episode.observations import Observation, observe_giver_motion, state_space
from handover_marl.episode.referee import RELEASE_REASONS, Referee, RefereeState, ReleaseReason, make_judge
from handover_marl.geometry.arrays import NUMPY_ARRAYS, AnyArray, AnyIndices, make_tensor_factory
from handover_marl.geometry.model_files.meshes import check_collision_meshes
from handover_marl.simulation.engines import WARP, BatchBackend, make_world_batch
from handover_marl.simulation.world import Contacts

_VOLUNTARY = RELEASE_REASONS.index(ReleaseReason.VOLUNTARY)


class EpisodeBatch:
    """Batch of n handover episodes, simulated together by MuJoCo or MuJoCo Warp.

    The episodes do not influence each other. Each has the states of a single `handover_marl.episode.episode.Episode`:
    exactly in MuJoCo, to single precision in MuJoCo Warp. Methods apply to the r episodes with the indices `rows` (r,).
    Arrays are NumPy arrays in MuJoCo, and PyTorch tensors on the device in MuJoCo Warp. The device's memory is free
    after `close`, once no tensor is in use any more.

    Args:
        config: Simulated world, protocol and limits of the givers.
        count: Number n of episodes.
        backend: Engine and device of the simulation.

    Attributes:
        arrays: Creator of NumPy arrays, or of tensors on the device of MuJoCo Warp.
        motion: Motion of hands and objects, from the recordings and the givers' actions.
        referees: Status, release and step counts of each episode.
        state: Full state of all episodes after their last `update_state`: arrays (n, ...) by the keys of
            `state_space`.
    """

    def __init__(self, config: WorldConfig, count: int, backend: BatchBackend) -> None:
        self.config = config
        arrays = self.arrays = make_tensor_factory(backend.device) if backend.name == WARP else NUMPY_ARRAYS
        self.motion = GiverMotion(count, config.giver, arrays)
        self._worlds = make_world_batch(config.physics, count, backend, arrays)
        self._start = Referee(config.protocol).get_state()
        self.referees = RefereeState(*(arrays.full(count, value, "int64") for value in self._start))
        self.state: Observation = {
            key: arrays.zeros((count, *(space.shape or ())), "float32") for key, space in state_space().items()
        }
        self._scene_ids = arrays.full(count, -1, "int64")

    @property
    def released(self) -> AnyArray:
        """Mask (n,) of the episodes in which the person has released the object."""
        return self.referees.release_reason >= 0

    def reset(self, row: int, scene: Scene, seed: int = 0) -> None:
        """Start an episode of a scene.

        Args:
            row: Index of the episode.
            scene: Scene of the episode.
            seed: Seed of the robot's initial joint positions, if the configuration has noise on them.
        """
        for urdf in scene.urdfs:
            check_collision_meshes(urdf)
        self._worlds.reset(row, scene, self.motion.reset(row, scene), self.config.draw_initial_joints(seed))
        self.referees.assign_rows(row, self._start)
        self._scene_ids[row], count = scene.info.scene_id, len(scene.info.object_ids)
        for key in ("object_mask", "object_classes"):
            self.state[key][row] = 0.0
        self.state["object_mask"][row, :count] = 1.0
        self.state["object_classes"][row, :count] = self.arrays.asarray(scene.info.object_ids, "float32")

    def advance(self, rows: AnyIndices, robot_targets: AnyArray, steps: int, giver_actions: AnyArray) -> None:
        """Simulate `steps` physics steps with constant actions; steps after the end of an episode do not count.

        Args:
            rows: Indices (r,) of running episodes.
            robot_targets: (r, 9) target joint positions, 7 arm (rad) and 2 fingers (m).
            steps: Number of physics steps (1 ms).
            giver_actions: (r, 8) deviations from the recordings, see `giver_action_space`.
        """
        referees, rules, motion = self.referees, self.config.protocol, self.motion
        while steps > 0 and len(rows):
            held = rows[requests_release(giver_actions) & motion.holding[rows]]
            held = held[referees.release_reason[held] < 0]
            referees.release_reason[held], referees.release_step[held] = _VOLUNTARY, referees.steps[held]
            self._worlds.release_targets(held)
            states = referees.select_rows(rows)
            reasons = states.release_reason
            plan = motion.plan_until_release(rows, steps, giver_actions, reasons >= 0, reasons == _VOLUNTARY)
            steps -= plan.steps
            judge = make_judge(states, rules)
            self.motion.commit(plan, self._worlds.rollout(rows, plan.reference, robot_targets, judge, rules))
            referees.assign_rows(rows, states)
            running = states.status == 0
            rows, robot_targets, giver_actions = rows[running], robot_targets[running], giver_actions[running]

    def update_state(self, rows: AnyIndices) -> None:
        """Read the full state of the episodes `rows` from the simulation into the attribute `state`."""
        for key, values in self._worlds.read_state(rows)._asdict().items():
            self.state[key][rows] = values
        xp = self.arrays.xp
        self.state["released"][rows, 0] = xp.astype(self.released[rows], xp.float32)
        times = xp.astype(self.referees.steps[rows], xp.float64) * TIME_STEP
        self.state["time"][rows, 0] = xp.astype(times, xp.float32)

    def select_state(self, rows: AnyIndices) -> Observation:
        """Return copies (r, ...) of the full state of the episodes `rows` at the last call of `update_state`."""
        return {key: values[rows] for key, values in self.state.items()}

    def select_giver_observation(self, rows: AnyIndices) -> Observation:
        """Return the givers' observations in the episodes `rows`: arrays (r, ...), see `giver_observation_space`."""
        return {**self.select_state(rows), **observe_giver_motion(self.motion, rows)}

    def are_grasped(self, rows: AnyIndices) -> AnyArray:
        """Return whether both fingers touched the object in the last physics step of the episodes `rows`, (r,)."""
        return self._worlds.are_grasped(rows) & (self.referees.steps[rows] > 0)

    def read_contacts(self, row: int) -> Contacts:
        """Return the contacts in the last physics step of the episode `row`; no contacts before the first step."""
        if int(self.referees.steps[row]) == 0:
            return Contacts()
        return self._worlds.read_contacts(row, bool(self.released[row]))

    def make_infos(self, rows: AnyIndices) -> dict[str, AnyArray]:
        """Return the infos of the episodes `rows` as arrays (r,) by key, see docs/reference/environment.md."""
        referees = self.referees
        return {
            "scene_id": self._scene_ids[rows],
            "status": referees.status[rows],
            "steps": referees.steps[rows],
            "release_step": referees.release_step[rows],
            "release_reason": referees.release_reason[rows],
        }

    def close(self) -> None:
        """Free the simulation."""
        self._worlds.close()
