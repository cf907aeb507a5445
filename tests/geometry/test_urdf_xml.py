"""Tests of the ranges of numbers in URDF files."""

import os
from pathlib import Path

import pytest

import handover_marl.assets
from handover_marl.errors import SimulationError
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.model_files.urdf_xml import URDF_RANGES, parse_urdf

MODEL = """<robot name="thing">
  <link name="base"/>
  <joint name="joint" type="revolute"><parent link="base"/><child link="body"/></joint>
  <link name="body">
    <inertial><mass value="0.5"/></inertial>
    <collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision>
  </link>
</robot>
"""


@pytest.mark.parametrize("name", URDF_RANGES)
def test_numbers_are_finite_and_within_their_range(name: str, tmp_path: Path) -> None:
    path, (low, high) = tmp_path / "model.urdf", URDF_RANGES[name]
    tag, attribute = name.split() if " " in name else ("thing", name)

    def write(text: str) -> None:
        path.write_text(MODEL.replace('<link name="base"/>', f'<link name="base"><{tag} {attribute}="{text}"/></link>'))

    write(f"{low} {high}")
    parse_urdf(path)
    out = (f"{high * 1.01}", f"{low - 0.01 * abs(low) - 1e-9}", "nan", "inf", "", "1_0", "٣", "1 nan 1")
    for text in out:
        write(text)
        with pytest.raises(SimulationError, match=rf"{attribute} of <{tag}> must be a number from .* to .*, got"):
            read_tree(path)


def test_moving_links_have_a_mass(tmp_path: Path) -> None:
    path = tmp_path / "model.urdf"
    path.write_text(MODEL.replace('value="0.5"', 'value="0"'))
    with pytest.raises(SimulationError, match=r"mass of link 'body' must be at least 1e-06 kg, got 0"):
        read_tree(path)
    path.write_text(MODEL.replace('value="0.5"', 'value="0"').replace("revolute", "fixed"))
    read_tree(path)


def test_official_files_pass() -> None:
    folders = [Path(handover_marl.assets.__file__).parent]
    folders += [
        Path(os.environ[name]) for name in ("HANDOVER_MARL_DATA", "HANDOVER_MARL_SEVERAL_OBJECTS") if name in os.environ
    ]
    files = [path for folder in folders for path in folder.rglob("*.urdf") if path.parent.name != "templates"]
    assert len(files) > 10
    for path in files:
        parse_urdf(path)
