"""Columns of the built-in features and action schemes: quantity, scale, unit and frame of every number.

`docs/reference/features.md` shows these tables. Frames: "world"; "gripper" is the Panda's hand link;
"handover" is `handover_marl.learning.features.compute_handover_frame`; "joint" for joint coordinates; "-" for
numbers without a frame. Rotation matrices are given by their first two columns, row by row.
"""

from collections.abc import Iterator
from dataclasses import dataclass

from gymnasium import spaces

from handover_marl.episode.observations import giver_observation_space, state_space
from handover_marl.geometry.ycb import LARGEST_YCB_CLASS


@dataclass(frozen=True)
class EncodingColumn:
    """Group of consecutive numbers of a feature vector, or of outputs of an action scheme.

    Attributes:
        name: Name of the quantity.
        size: Number of columns.
        value: Feature computed from the quantity q, or meaning of an output.
        unit: Unit of the quantity q, or of the motion that an output commands.
        frame: Frame in which the quantity is expressed.
    """

    name: str
    size: int
    value: str
    unit: str
    frame: str


_CLASS = EncodingColumn("YCB class of the object", LARGEST_YCB_CLASS, "1 for the class, else 0", "1", "-")
_RELEASED = EncodingColumn("released", 1, "1 after the person has released the object", "1", "-")
_FINGERS = EncodingColumn("finger joints of the robot", 2, "50 q - 1", "m", "joint")

_RECEIVER = (
    EncodingColumn("object, from the gripper", 3, "5 q", "m", "gripper"),
    EncodingColumn("person's wrist, from the gripper; zeros without a hand", 3, "5 q", "m", "gripper"),
    EncodingColumn("mean of the person's finger joints, from the gripper", 3, "5 q", "m", "gripper"),
    EncodingColumn("goal, from the gripper", 3, "5 q", "m", "gripper"),
    EncodingColumn("orientation of the object", 6, "q", "1", "gripper"),
    EncodingColumn("vertical of the world", 3, "q", "1", "gripper"),
    _FINGERS,
    EncodingColumn("velocities of the finger joints", 2, "10 q", "m/s", "joint"),
    EncodingColumn("arm joints of the robot", 7, "q", "rad", "joint"),
    _RELEASED,
    EncodingColumn("time", 1, "share of the longest episode, 13 s", "1", "-"),
    EncodingColumn("hand present", 1, "1 with a hand, else 0", "1", "-"),
    _CLASS,
)
_GRASP = (
    EncodingColumn("grasp, from the gripper; zeros without a grasp", 3, "5 q", "m", "gripper"),
    EncodingColumn("rotation vector to the grasp; zeros without a grasp", 3, "q", "rad", "gripper"),
)
_GIVER = (
    EncodingColumn("horizontal distance of the gripper from the object in 0.5 s", 1, "10 q - 5", "m", "handover"),
    EncodingColumn("height of the gripper above the object in 0.5 s", 1, "10 q - 5", "m", "handover"),
    EncodingColumn("object in 0.5 s, from the goal", 3, "10 q", "m", "world"),
    EncodingColumn("person's wrist in 0.5 s, from the object", 3, "10 q", "m", "handover"),
    EncodingColumn("mean of the finger joints in 0.5 s, from the object", 3, "10 q", "m", "handover"),
    EncodingColumn("orientation of the object in 0.5 s", 6, "q", "1", "handover"),
    _RELEASED,
    _CLASS,
)
# Unit and frame of the entries of an observation.
_OBSERVED = {
    "deviation": ("1, m, rad", "world"),
    "gripper_pose": ("m, quaternion xyzw", "world"),
    "hand_dof_position": ("m, rad", "world, joint"),
    "hand_keypoints": ("m", "world"),
    "object_poses": ("m, quaternion xyzw", "world"),
    "replay_object_poses": ("m, quaternion xyzw", "world"),
    "replay_wrist_poses": ("m, quaternion xyzw", "world"),
    "robot_joint_position": ("rad, m", "joint"),
    "robot_joint_velocity": ("rad/s, m/s", "joint"),
    "time": ("s", "-"),
}


def _flat(space: spaces.Dict) -> tuple[EncodingColumn, ...]:
    """Return the columns of a flattened observation, whose entries are in alphabetical order."""
    return tuple(
        EncodingColumn(f"`{key}`", spaces.flatdim(part), "q, row by row", *_OBSERVED.get(key, ("1", "-")))
        for key, part in space.items()
    )


_PROXIMITY = (
    *_GRASP,
    EncodingColumn("distance to the grasp", 1, "exp(-q / 0.03); 0 without a grasp", "m", "-"),
    EncodingColumn("angle to the grasp", 1, "exp(-q / 0.2); 0 without a grasp", "rad", "-"),
    _FINGERS,
    _RELEASED,
    EncodingColumn("grasp exists", 1, "1 if grasps of the object are known, else 0", "1", "-"),
)
# Decisions of stacked features, and the other cells of their rows.
_DECISIONS = ("present decision", "decision before it", "second decision before it", "third decision before it")
_AS_THERE = ("as in `close`; zeros before the first decision", "-", "-")

#: Columns of the built-in features by agent and name.
FEATURE_COLUMNS: dict[str, dict[str, tuple[EncodingColumn, ...]]] = {
    "giver": {"giver": _GIVER, "flat_giver": _flat(giver_observation_space())},
    "receiver": {
        "receiver": _RECEIVER,
        "flat_receiver": _flat(state_space()),
        "grasp": (
            *_RECEIVER,
            *_GRASP,
            EncodingColumn("distance of the person's hand from the gripper at the grasp", 1, "10 q", "m", "-"),
            EncodingColumn("grasp exists", 1, "1 if grasps of the object are known, else 0", "1", "-"),
        ),
        "close": _PROXIMITY,
        "close_stack": tuple(
            EncodingColumn(f"features `close` at the {decision}", sum(column.size for column in _PROXIMITY), *_AS_THERE)
            for decision in _DECISIONS
        ),
    },
}

_CLOSE = EncodingColumn("gripper", 1, "closed above 0, else open", "1", "-")
_CARTESIAN = (
    EncodingColumn("motion of the hand link", 3, "0.08 at 1", "m", "gripper"),
    EncodingColumn("rotation vector of the hand link", 3, "0.3 at 1", "rad", "gripper"),
)
_TARGETS = ("arm joint targets", 7), ("finger targets", 2)
#: Outputs that the built-in action schemes decode, by agent and name.
SCHEME_COLUMNS: dict[str, dict[str, tuple[EncodingColumn, ...]]] = {
    "giver": {
        "giver": (
            EncodingColumn("playback rate minus 1", 1, "the action itself", "1", "-"),
            EncodingColumn("displacement of the wrist", 3, "the action itself", "m", "world"),
            EncodingColumn("rotation vector of the wrist", 3, "the action itself", "rad", "world"),
            EncodingColumn("release", 1, "above 0.5", "1", "-"),
        ),
        "deviation": (
            EncodingColumn("playback rate minus 1", 1, "1 at 1", "1", "-"),
            EncodingColumn("displacement of the wrist", 3, "0.3 at 1", "m", "world"),
            EncodingColumn("rotation vector of the wrist", 3, "1 at 1", "rad", "world"),
            EncodingColumn("release", 1, "above 0.5", "1", "-"),
        ),
        "offer": (
            EncodingColumn("displacement of the object", 3, "0.25 at 1", "m", "handover"),
            EncodingColumn("rotation vector of hand and object about the object", 3, "1 at 1", "rad", "handover"),
            EncodingColumn("withdrawal of the hand after the release", 1, "0.3 at 1, 0 at -1", "m", "-"),
        ),
    },
    "receiver": {
        "receiver": (
            EncodingColumn(*_TARGETS[0], "the action itself", "rad", "joint"),
            EncodingColumn(*_TARGETS[1], "the action itself", "m", "joint"),
        ),
        "joints": (
            EncodingColumn(*_TARGETS[0], "lower limit at -1, upper limit at 1", "rad", "joint"),
            EncodingColumn(*_TARGETS[1], "0 at -1, 0.04 at 1", "m", "joint"),
        ),
        "joint_delta": (EncodingColumn("increments of the arm joints", 7, "0.2 at 1", "rad", "joint"), _CLOSE),
        "cartesian_delta": (*_CARTESIAN, _CLOSE),
        "grasp_servo": (
            EncodingColumn("displacement of the target", 3, "0.01, 0.01 and 0.03 at 1", "m", "target"),
            EncodingColumn("rotation vector of the target", 3, "0.1 at 1", "rad", "target"),
            EncodingColumn("gripper", 1, "closes above 0.5, and stays closed", "1", "-"),
        ),
    },
}


def locate_columns(columns: tuple[EncodingColumn, ...]) -> Iterator[tuple[slice, EncodingColumn]]:
    """Yield the slice of each group of columns in the vector, and the group."""
    start = 0
    for column in columns:
        yield slice(start, start + column.size), column
        start += column.size


def format_columns(columns: tuple[EncodingColumn, ...]) -> str:
    """Return a Markdown table of groups of columns, as the documentation shows it."""
    lines = ["| column | quantity q | value | unit of q | frame |", "|---|---|---|---|---|"]
    for place, column in locate_columns(columns):
        last = place.stop - 1
        numbers = f"{place.start}" if column.size == 1 else f"{place.start} to {last}"
        lines.append(f"| {numbers} | {column.name} | {column.value} | {column.unit} | {column.frame} |")
    return "\n".join(lines) + "\n"
