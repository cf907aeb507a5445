"""The URDF of an object: its mesh at the end of three prismatic and three continuous joints, as in HandoverSim."""

import xml.etree.ElementTree as ET

#: Every object's mass (kg) and lateral friction (1) in HandoverSim, whatever it is made of.
MASS, FRICTION = 0.5, 0.9
_TRAVEL = 1000  # m; far beyond any trajectory
_AXES = ("1 0 0", "0 1 0", "0 0 1")


def chain_urdf(visual: str, collision: str) -> str:
    """The URDF text with links link0..link6 and joints joint1..joint6; link6 carries the meshes.

    Args:
        visual: File name of the mesh to show, relative to the URDF.
        collision: File name of the convex parts, relative to the URDF.
    """
    robot = ET.Element("robot", name="model_normalized")
    for number in range(7):
        _add_link(robot, number, visual, collision)
        if number:
            _add_joint(robot, number)
    ET.indent(robot)
    return '<?xml version="1.0"?>\n' + ET.tostring(robot, encoding="unicode") + "\n"


def _add_link(robot: ET.Element, number: int, visual: str, collision: str) -> None:
    link = ET.SubElement(robot, "link", name=f"link{number}")
    carries = number == 6
    if carries:
        ET.SubElement(ET.SubElement(link, "contact"), "lateral_friction", value=str(FRICTION))
    inertial = ET.SubElement(link, "inertial")
    ET.SubElement(inertial, "mass", value=str(MASS if carries else 0))
    # Bullet computes the inertia from the collision shape; URDF only wants the element to be there.
    moment = "1" if carries else "0"
    ET.SubElement(inertial, "inertia", ixx=moment, ixy="0", ixz="0", iyy=moment, iyz="0", izz=moment)
    if not carries:
        return
    for kind, file_name in (("visual", visual), ("collision", collision)):
        element = ET.SubElement(link, kind)
        ET.SubElement(ET.SubElement(element, "geometry"), "mesh", filename=file_name, scale="1 1 1")
        if kind == "visual":
            ET.SubElement(ET.SubElement(element, "material", name="palette"), "color", rgba="1 1 1 1")


def _add_joint(robot: ET.Element, number: int) -> None:
    slides = number <= 3
    joint = ET.SubElement(robot, "joint", name=f"joint{number}", type="prismatic" if slides else "continuous")
    ET.SubElement(joint, "parent", link=f"link{number - 1}")
    ET.SubElement(joint, "child", link=f"link{number}")
    ET.SubElement(joint, "axis", xyz=_AXES[(number - 1) % 3])
    if slides:
        ET.SubElement(joint, "limit", lower=str(-_TRAVEL), upper=str(_TRAVEL))
