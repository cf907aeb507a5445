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


@pytest.mark.parametrize(("tag", "attribute"), URDF_RANGES)
def test_numbers_are_finite_and_within_their_range(tag: str, attribute: str, tmp_path: Path) -> None:
    path, limits = tmp_path / "model.urdf", URDF_RANGES[tag, attribute]
    for value in (limits.low or 1.0, limits.high, 1.0 if limits.high >= 1.0 else limits.high):
        path.write_text(
            MODEL.replace('<link name="base"/>', f'<link name="base"><{tag} {attribute}="{value}"/></link>')
        )
        parse_urdf(path)
    out = [str(limits.high * 1.01), str(limits.low - 0.01 * abs(limits.low) - 1e-9), "nan", "inf", "-1e400", "", "1_0"]
    out += ["0"] if limits.least else []
    for text in [*out, f"1 {out[0]} 1", "٣"]:
        path.write_text(MODEL.replace('<link name="base"/>', f'<link name="base"><{tag} {attribute}="{text}"/></link>'))
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
