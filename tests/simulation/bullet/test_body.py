import shutil
from pathlib import Path

import pytest

from handover_marl.config import HandConfig, MotorConfig, ObjectConfig, PandaConfig
from handover_marl.errors import SimulationError
from handover_marl.simulation.bullet.bodies import ArticulatedBody, HandBody, ObjectBody, PandaBody
from handover_marl.simulation.bullet.client import BulletClient, connect

OBJECT = "003_cracker_box/model_normalized.urdf"
PANDA = "franka_panda/panda_gripper.urdf"


@pytest.fixture
def client() -> BulletClient:
    return connect()


@pytest.fixture
def assets(fake_data: Path) -> Path:
    return fake_data / "assets"


def test_links_by_name(client: BulletClient, assets: Path) -> None:
    body = ObjectBody(client, assets / OBJECT, 2, ObjectConfig(), [0.0] * 6)
    assert [body.get_link(f"link{index}") for index in range(1, 7)] == list(range(6))
    with pytest.raises(SimulationError, match=r"'object' loaded as ObjectBody has no link 'link7'.*link1, link2"):
        body.get_link("link7")


@pytest.mark.parametrize("count", [0, 5, 7])
def test_a_motor_for_every_moving_joint(client: BulletClient, assets: Path, count: int) -> None:
    motors = [MotorConfig(position_gain=0.1, velocity_gain=1.0, force=1.0)] * count
    with pytest.raises(SimulationError, match=f"'object' .*must have {count} moving joints, got 6"):
        ArticulatedBody(client, assets / OBJECT, motors, 1)


def test_models_that_are_something_else(client: BulletClient, assets: Path) -> None:
    table = assets / "table" / "table.urdf"
    with pytest.raises(SimulationError, match="'table' loaded as ObjectBody must have 6 moving joints, got 0"):
        ObjectBody(client, table, 2, ObjectConfig(), [0.0] * 6)
    with pytest.raises(SimulationError, match="'object' loaded as HandBody must have 51 moving joints, got 6"):
        HandBody(client, assets / OBJECT, [0.0] * 51, HandConfig())
    with pytest.raises(SimulationError, match="'object' loaded as PandaBody must have 9 moving joints, got 6"):
        PandaBody(client, assets / OBJECT, PandaConfig())


@pytest.mark.parametrize("link", ["panda_hand", "panda_leftfinger", "panda_rightfinger"])
def test_a_panda_without_a_link(client: BulletClient, assets: Path, tmp_path: Path, link: str) -> None:
    shutil.copytree(assets / "franka_panda", tmp_path / "franka_panda", symlinks=True)
    urdf = tmp_path / PANDA
    urdf.write_text(urdf.read_text().replace(f'"{link}"', '"renamed"'))
    with pytest.raises(SimulationError, match=f"loaded as PandaBody has no link '{link}'.*renamed"):
        PandaBody(client, urdf, PandaConfig())
