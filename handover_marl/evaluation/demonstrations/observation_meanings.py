"""Meaning, unit and frame of each observation, for the cards of data sets."""

_WORLD = "world frame"
_HAND_LINK = "frame of the Panda's hand link"

#: Meaning of each key of `receiver_observation_space`, in all observation modes.
OBSERVATION_MEANINGS = {
    "robot_joint_position": "positions of 7 arm joints (rad) and 2 fingers (m)",
    "robot_joint_velocity": "velocities of 7 arm joints (rad/s) and 2 fingers (m/s)",
    "gripper_pose": f"pose of the Panda's hand link, {_WORLD}: xyz (m), quaternion xyzw",
    "object_poses": f"poses of the objects, the one to be handed over first, {_WORLD}: xyz (m), quaternion xyzw; "
    "zeros for no object",
    "object_mask": "1 for an object, 0 for none",
    "object_classes": "class number: 1 to 21 for YCB, from 22 on for others, 0 for no object",
    "hand_dof_position": f"base (m, rad, {_WORLD}) and finger joints (rad) of the human hand; zeros without a hand",
    "hand_keypoints": f"origins of wrist and 15 finger joints of the human hand, {_WORLD} (m); zeros without a hand",
    "hand_present": "1 with a human hand, 0 without",
    "released": "1 after the person has released the object",
    "time": "time since the start of the episode (s)",
    "wrist_object_points": f"points of the object to be handed over, {_HAND_LINK} (m), padded with zeros",
    "wrist_hand_points": f"points of the human hand, {_HAND_LINK} (m), padded with zeros",
    "wrist_other_points": f"points of the other objects, {_HAND_LINK} (m), padded with zeros",
    "wrist_point_counts": "number of pixels on object, hand and, with their points, other objects; a cloud has this "
    "many valid rows, at most all",
    "wrist_object_cloud": f"all points of the object to be handed over, {_HAND_LINK} (m), padded with zeros",
    "wrist_hand_cloud": f"all points of the human hand, {_HAND_LINK} (m), padded with zeros",
    "robot_joint_position_exact": "robot joints before rounding to float32 (rad, m)",
    "wrist_depth": "depth along the viewing axis of the wrist camera (m)",
    "wrist_segmentation": "0 background, 1 robot, 2 table, 3 object to be handed over, 4 other object, 5 human hand",
    "wrist_rgb": "colours of the wrist camera",
}
#: Meaning of the actions of both agents.
RECEIVER_ACTION_MEANING = "target positions of 7 arm joints (rad) and 2 fingers (m)"
GIVER_ACTION_MEANING = (
    "deviation from the recorded motion: playback rate minus 1, wrist displacement (m) and rotation vector (rad), "
    f"{_WORLD}, release; zeros replay the recording"
)
