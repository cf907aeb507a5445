"""What stands in every world before objects and hand come: ground, table and Panda."""

from dataclasses import dataclass

from handover_marl.assets.bullet_files import bullet_files
from handover_marl.config import TIME_STEP, PhysicsConfig
from handover_marl.datasets.scene import SceneAssets
from handover_marl.sim.bullet.body import Body, Start
from handover_marl.sim.bullet.client import BulletClient, float32_list, load_urdf
from handover_marl.sim.bullet.panda_body import Panda

TABLE_MASK = 1


@dataclass(frozen=True)
class Stage:
    """The table's body number and the Panda, at its start pose."""

    table_id: int
    panda: Panda


def set_stage(client: BulletClient, assets: SceneAssets, config: PhysicsConfig) -> Stage:
    """Empty the physics server and load ground, table and Panda.

    Bullet is deterministic for equal call sequences only, so the order is fixed.
    """
    client.resetSimulation()
    client.setGravity(0.0, 0.0, config.gravity)
    client.setPhysicsEngineParameter(fixedTimeStep=TIME_STEP, numSubSteps=1, deterministicOverlappingPairs=1)
    load_urdf(client, bullet_files("this", "take physics='mujoco'") / "plane_implicit.urdf")
    place = Start(base=[*float32_list(config.table_position), 0.0, 0.0, 0.0, 1.0])
    table = Body(client, assets.table, (), TABLE_MASK, place)
    return Stage(table.id, Panda(client, assets.panda, config.panda))
