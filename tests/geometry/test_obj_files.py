from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handover_marl.assets.object_models import OBJECTS_ROOT
from handover_marl.errors import DataFormatError, SimulationError
from handover_marl.geometry.model_files.obj_files import check_mesh, read_obj
from handover_marl.simulation.bullet.client import connect, load_urdf

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"


def write(folder: Path, text: str) -> Path:
    path = folder / "mesh.obj"
    path.write_text(text)
    return path


def test_groups_polygons_and_counting_back(tmp_path: Path) -> None:
    text = f"o first\n{TRIANGLE}v 1 1 0\nf 1//1 2//1 4//1 3//1\no second\nf -4/1 -3/2 -2/3\n"
    found = read_obj(write(tmp_path, text))
    assert found.vertices.shape == (4, 3)
    assert [group.tolist() for group in found.groups] == [[[0, 1, 3], [0, 3, 2]], [[0, 1, 2]]]
    assert len(found.faces) == 3


READERS: dict[str, Callable[[Path], object]] = {
    "read": read_obj,
    "check": lambda path: check_mesh(path, solid=True),
}


@pytest.mark.parametrize(
    ("readers", "text", "message"),
    [
        ("read check", TRIANGLE, "empty"),
        ("read check", f"{TRIANGLE}v nan 0 0\nf 1 2 3\n", "not finite"),
        ("read check", f"{TRIANGLE}v 0 0 1\nf 1 2 3\nf 2 3", "at least three corners"),
        ("read", f"{TRIANGLE}f 1 2 4\n", "not there"),
        ("read", f"{TRIANGLE}f 0 1 2\n", "not there"),
        ("read", f"{TRIANGLE}f 1 2 -4\n", "not there"),
        ("read", f"{TRIANGLE}f one two three\n", "not an OBJ file"),
        ("check", "", "empty"),
        ("check", "f 1 2 3\n", "empty"),
        ("check", f"{TRIANGLE}f 1 2 3\n", "one plane"),
        ("check", f"{TRIANGLE}v 0 0 inf\nf 1 2 3\n", "not finite"),
        ("check", f"{TRIANGLE}v 0 0\nf 1 2 3\n", "three numbers"),
        ("check", f"{TRIANGLE}v 0 0 a\nf 1 2 3\n", "three numbers"),
        ("check", f"{TRIANGLE}v 0 0 1\nf 1/1 2/2 3/3\nf 2/2", "at least three corners"),
    ],
)
def test_damaged_files(tmp_path: Path, readers: str, text: str, message: str) -> None:
    for reader in readers.split():
        with pytest.raises(DataFormatError, match=message):
            READERS[reader](write(tmp_path, text))


@pytest.mark.parametrize("corner", ["4", "0", "-4", "999999999"])
def test_vertex_numbers_out_of_range_do_not_reach_pybullet(tmp_path: Path, corner: str) -> None:
    write(tmp_path, f"{TRIANGLE}f 1 2 {corner}\n")
    mesh = '<geometry><mesh filename="mesh.obj"/></geometry>'
    urdf = tmp_path / "model.urdf"
    urdf.write_text(f'<robot name="r"><link name="l"><collision>{mesh}</collision></link></robot>')
    client = connect()
    with pytest.raises(SimulationError, match=r"mesh\.obj: a face names a corner"):
        load_urdf(client, urdf)


def test_shipped_meshes_are_whole() -> None:
    paths = sorted(OBJECTS_ROOT.rglob("*.obj"))
    assert len(paths) > 20
    for path in paths:
        check_mesh(path)
        assert np.isfinite(read_obj(path).vertices).all()


@settings(max_examples=60)
@given(st.lists(st.integers(-6, 6), min_size=1, max_size=4))
def test_check_and_reader_agree(tmp_path_factory: pytest.TempPathFactory, corners: list[int]) -> None:
    path = write(tmp_path_factory.mktemp("obj"), TRIANGLE + "f " + " ".join(map(str, corners)) + "\n")

    def refused(read: object) -> bool:
        try:
            read(path)  # type: ignore[operator]
        except DataFormatError:
            return True
        return False

    assert refused(check_mesh) == refused(read_obj)
