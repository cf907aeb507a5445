import shutil
from pathlib import Path

import pytest

from handover_marl.config import HandConfig, ObjectConfig, PandaConfig
from handover_marl.errors import SimulationError
from handover_marl.simulation.bullet.bodies import HandBody, ObjectBody, PandaBody
from handover_marl.simulation.bullet.client import BulletClient, connect

OBJECT = "003_cracker_box/model_normalized.urdf"
PANDA = "franka_panda/panda_gripper.urdf"


@pytest.fixture
def client() -> BulletClient:
    return connect()


@pytest.fixture
def assets(fake_data: Path) -> Path:
    return fake_data / "assets"


def test_models_that_are_something_else(client: BulletClient, assets: Path) -> None:
    table = assets / "table" / "table.urdf"
    with pytest.raises(SimulationError, match="'table' loaded as ObjectBody must have 6 moving joints, got 0"):
        ObjectBody(client, table, 2, ObjectConfig(), [0.0] * 6)
    with pytest.raises(SimulationError, match="'object' loaded as HandBody must have 51 moving joints, got 6"):
        HandBody(client, assets / OBJECT, [0.0] * 51, HandConfig())
    with pytest.raises(SimulationError, match="'object' loaded as PandaBody must have 9 moving joints, got 6"):
        PandaBody(client, assets / OBJECT, PandaConfig())


def test_a_panda_without_a_link(client: BulletClient, assets: Path, tmp_path: Path) -> None:
    shutil.copytree(assets / "franka_panda", tmp_path / "franka_panda", symlinks=True)
    urdf = tmp_path / PANDA
    urdf.write_text(urdf.read_text().replace('"panda_leftfinger"', '"renamed"'))
    with pytest.raises(SimulationError, match=r"loaded as PandaBody has no link 'panda_leftfinger'.*renamed"):
        PandaBody(client, urdf, PandaConfig())
