"""The same world without what cannot touch: hand and objects are in Bullet only while the Panda is near them.

The Panda, and every object that it could touch or that was let go, are simulated as in the exact world. The hand
follows its targets by the recurrence that its motors obey there. By the collision masks it can touch only the
Panda, and that ends an episode, so its own dynamics never show. Bodies stay loaded between scenes.
"""

from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt

from handover_marl.config import CameraConfig, PhysicsConfig
from handover_marl.datasets.scene import Scene, SceneAssets
from handover_marl.errors import ResetNeededError
from handover_marl.models.kinematic_tree import read_tree
from handover_marl.protocol.contacts import Contacts
from handover_marl.sim.bullet.bounds import link_spheres
from handover_marl.sim.bullet.bullet_world import BulletWorld, lost
from handover_marl.sim.bullet.client import pybullet_error
from handover_marl.sim.bullet.contact_reader import ContactReader
from handover_marl.sim.bullet.dormant_object import DormantObject
from handover_marl.sim.bullet.drawing import without_drawing
from handover_marl.sim.bullet.ghosts import Ghosts
from handover_marl.sim.bullet.kinematic_hand import HandModel, KinematicHand, read_hand
from handover_marl.sim.bullet.panda_body import Panda
from handover_marl.sim.bullet.stage import Stage, set_stage
from handover_marl.sim.camera.photo import Photo
from handover_marl.sim.clearance import Clearance
from handover_marl.sim.motion import Motion
from handover_marl.sim.world import Postures, Snapshot, WorldState


class Sleeper(Protocol):
    """What is in Bullet only once the Panda could come near."""

    @property
    def awake(self) -> bool:
        """Whether it is in Bullet."""

    @property
    def reach(self) -> float:
        """How far it reaches from its middle (m)."""

    def centers(self, row: int) -> npt.NDArray[np.float64]:
        """(n - row, 3) where its middle will be after the steps from `row` on (m); inf where it is not there."""

    def wake(self, row: int) -> None:
        """Come into Bullet before step `row` is simulated."""


_NOTHING = Contacts()
# Once only so few steps are surely clear, looking ahead again and again costs more than being awake.
_WORTH = 5
# PyBullet's window shows hand and objects that often (steps).
_WINDOW_PERIOD = 20


class FastWorld(BulletWorld):
    """See the module.

    Args:
        config: Constants of the world.
        window: Whether to show PyBullet's window.
    """

    def __init__(self, config: PhysicsConfig, window: bool = False) -> None:
        super().__init__(config, window)
        self._window = window
        self._stage: Stage | None = None
        self._stage_files: tuple[Path, Path] | None = None
        self._hand_models: dict[Path, HandModel] = {}
        self._objects: list[DormantObject] = []
        self._hand: KinematicHand | None = None
        self._ghosts = Ghosts(self._client)
        # Physics steps since the last reset.
        self._simulated = 0

    def reset(self, scene: Scene, start: Motion) -> None:
        """Put everything at a scene's start; what does not change between scenes stays loaded."""
        try:
            with without_drawing(self._client):
                self._clear()
                self._scene = scene
                panda = self._prepare(scene.assets).panda
                self._forget(panda)
                self._bring(scene, start)
                panda.restart()
        except pybullet_error as error:
            raise lost(error) from error

    def _clear(self) -> None:
        self._ghosts.clear()
        if self._hand is not None:
            self._hand.remove()
        for item in self._objects:
            item.remove()
        self._objects, self._hand = [], None

    def _prepare(self, assets: SceneAssets) -> Stage:
        files = (assets.table, assets.panda)
        if self._stage is None or files != self._stage_files:
            self._stage = None
            self._hand_models.clear()
            self._stage = set_stage(self._client, assets, self._config)
            # In a server's first step of all, contacts of the Panda with itself come out otherwise (1e-8 m) than
            # in any later one; with that step behind it, a new world is like one that has been used.
            self._client.stepSimulation()
            self._stage_files = files
            self._reader = ContactReader(self._client, self._stage.panda)
            self._clearance = Clearance(read_tree(assets.panda), link_spheres(assets.panda), self._config.panda)
        return self._stage

    def _forget(self, panda: Panda) -> None:
        """Bring Bullet's broad phase to one and the same state, whatever was simulated before.

        It sorts out old pairs a few at a time and files away what rests by turns of two steps; where it stands in
        both would show in the last bits of what follows. With no pairs left and an even number of steps it stands
        where it does in a new server.
        """
        panda.withdraw()
        for _ in range(2 + self._simulated % 2):
            self._client.stepSimulation()
        self._simulated = 0

    def _bring(self, scene: Scene, start: Motion) -> None:
        urdf = scene.assets.hand
        if urdf not in self._hand_models:
            self._hand_models[urdf] = read_hand(self._client, urdf)
        self._hand = KinematicHand(self._client, self._hand_models[urdf], self._config.hand, start)
        self._objects = [
            DormantObject(self._client, urdf, class_id, dof, self._config.objects)
            for urdf, class_id, dof in zip(scene.assets.objects, scene.info.object_ids, start.objects[0], strict=True)
        ]
        self._release_pending = False
        self._checked_target: list[float] | None = None
        self._row = -1

    def lead(self, motion: Motion) -> None:
        """Say where objects and hand are led in the coming steps, one row a step."""
        self._row = -1
        self._clear_until = 0
        self._length = len(motion)
        self._hand_now.lead(motion)
        for number, item in enumerate(self._objects):
            item.lead(motion.objects[:, number])

    def step(self, robot_target: list[float]) -> None:
        """Simulate one step."""
        self._row += 1
        row, panda = self._row, self._stage_now.panda
        if self._release_pending:
            self._let_go(row)
        if row >= self._clear_until or robot_target != self._checked_target:
            self._look_ahead(robot_target)
        panda.drive(robot_target)
        for item in self._objects:
            item.drive(row)
        self._hand_now.move(row)
        self._simulate()
        self._simulated += 1
        if self._window and self._simulated % _WINDOW_PERIOD == 0:
            self._draw()

    def _look_ahead(self, robot_target: list[float]) -> None:
        """Wake what the Panda could come near in the next steps; note for how many steps all others are safe."""
        row = self._row
        self._checked_target = robot_target
        self._clear_until = self._length
        everything: list[Sleeper] = [self._hand_now, *self._objects]
        asleep = [item for item in everything if not item.awake]
        if not asleep:
            return
        centers = np.stack([item.centers(row) for item in asleep], axis=1)
        reaches = np.array([item.reach for item in asleep])
        panda, links = self._stage_now.panda, self._clearance.links
        clear = self._clearance.clear_steps(
            panda.joint_states(), panda.link_poses(links), robot_target, centers, reaches
        ).tolist()
        worth = min(_WORTH, self._length - row)
        for item, steps in zip(asleep, clear, strict=True):
            if steps < worth:
                item.wake(row)
            else:
                self._clear_until = min(self._clear_until, row + steps)

    def _let_go(self, row: int) -> None:
        # What it can fall on or be carried against must be there too.
        for item in self._objects:
            item.wake(row)
        if self._objects[0].body is not None:
            self._objects[0].body.release()
        self._release_pending = False

    def release_target(self) -> None:
        """Let go of the target object; takes effect in the next step."""
        self._release_pending = True

    def contacts(self, released: bool) -> Contacts:
        """The last step's contacts, as far as the rules ask about them."""
        target, *others = (item.body for item in self._objects)
        hand = self._hand_now.bodies
        if target is None and not hand:
            return _NOTHING
        supports = {self._stage_now.table_id, *(other.id for other in others if other is not None)}
        return self._reader.read(hand, target, supports if released else ())

    def state(self) -> WorldState:
        """The present state of everything."""
        panda, hand, row = self._stage_now.panda, self._hand_now, self._row
        position, velocity = panda.joint_states()
        present = hand.present_after(row)
        return WorldState(
            robot_joint_position=position,
            robot_joint_velocity=velocity,
            gripper_pose=panda.link_poses([panda.hand_link])[0],
            object_poses=np.stack([item.pose(row) for item in self._objects]),
            hand_dof_position=hand.dof(row) if present else None,
            hand_keypoints=hand.keypoints(row) if present else None,
        )

    def postures(self) -> Postures:
        """The present joints of robot and hand."""
        hand, row = self._hand_now, self._row
        robot = self._stage_now.panda.joint_positions()
        return Postures(robot, hand.dof(row) if hand.present_after(row) else None)

    def exact_joints(self) -> npt.NDArray[np.float64]:
        """The robot's joints (9,) in double precision (m, rad)."""
        return self._stage_now.panda.exact_joints()

    def object_dof(self) -> npt.NDArray[np.float32]:
        """(n, 6) joint positions of the objects' chains (m, rad), float32."""
        return np.stack([item.dof(self._row) for item in self._objects])

    def render(self, camera: CameraConfig) -> npt.NDArray[np.uint8]:
        """An RGB picture (height, width, 3) of the present state."""
        if self._window:
            self._draw()
            return super().render(camera)
        return self._picture_world().draw(self.snapshot(), camera)

    def photograph(self, color: bool, at: Snapshot | None = None) -> Photo:
        """What the wrist camera shows."""
        return self._picture_world().photograph(at or self.snapshot(), color)

    def _draw(self) -> None:
        """Show what is not simulated."""
        hand, row = self._hand_now, self._row
        for number, item in enumerate(self._objects):
            if item.awake:
                self._ghosts.hide(number)
            else:
                self._ghosts.show(number, item.urdf, item.tree, item.dof(row))
        if hand.present_after(row):
            self._ghosts.show("hand", hand.model.urdf, hand.model.tree, hand.dof(row))
        else:
            self._ghosts.hide("hand")

    @property
    def _stage_now(self) -> Stage:
        if self._stage is None:
            raise ResetNeededError("the world is empty; call reset() first")
        return self._stage

    @property
    def _hand_now(self) -> KinematicHand:
        if self._hand is None:
            raise ResetNeededError("the world is empty; call reset() first")
        return self._hand
