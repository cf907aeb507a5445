"""The Franka Panda: what is true of every one, wherever it stands and however it is simulated.

Lengths in m, angles in rad, quaternions xyzw.
"""

#: The Pandas: HandoverSim's usual one, and the one with a depth camera on its hand, which collides and has other
#: finger friction, so that results with it are results of another robot.
PANDA, PANDA_CAMERA = "panda", "panda_camera"
ROBOTS = (PANDA, PANDA_CAMERA)

#: Links by their names in every Panda's URDF; their numbers differ between files.
HAND_LINK = "panda_hand"
CAMERA_LINK = "panda_hand_camera"
FINGER_LINKS = ("panda_leftfinger", "panda_rightfinger")

#: Where the camera's link is on the hand, as URDF writes it: position (m) and roll, pitch, yaw (rad).
HAND_FROM_CAMERA_LINK_URDF = ("0.036 0 0.036", "-1.57079632679 0 -1.57079632679")
#: The same as a pose.
HAND_FROM_CAMERA_LINK = (0.036, 0.0, 0.036, -0.5, 0.5, -0.5, 0.5)

#: Limits of the seven arm joints and the two fingers.
LOWER_LIMITS = (-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973, 0.0, 0.0)
UPPER_LIMITS = (2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.752, 2.8973, 0.04, 0.04)

#: Positions of each finger with the gripper open and closed.
OPEN, CLOSED = 0.04, 0.0

#: Where a receiver waits for the handover (7 arm joints, 2 fingers), as HandoverSim's baselines do.
WAITING_JOINTS = (-0.0593, -1.6124, -0.1970, -2.5300, -0.0952, 1.6780, 0.5870, OPEN, OPEN)

#: The hand link in the frame of HandoverSim's grasps: a quarter turn about z.
GRIPPER_FROM_HAND = (0.0, 0.0, 0.0, 0.0, 0.0, 0.7071068, -0.7071068)

#: A gripper turned by half a turn about its approach grasps the same.
HALF_TURN = (0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0)

#: The gripper's outline in the hand link, a fork from fingertip over palm to fingertip.
GRIPPER_OUTLINE = (
    *((0.0, 0.04, 0.103), (0.0, 0.04, 0.05), (0.0, 0.0, 0.05), (0.0, 0.0, 0.0)),
    *((0.0, 0.0, 0.05), (0.0, -0.04, 0.05), (0.0, -0.04, 0.103)),
)

#: The middle between the fingertips in the hand link.
FINGERTIPS = (0.0, 0.0, 0.1034)
