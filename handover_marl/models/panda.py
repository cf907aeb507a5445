"""The Franka Panda: what is true of every one, wherever it stands and however it is simulated.

Lengths in m, angles in rad, quaternions xyzw.
"""

#: Links by their names in every Panda's URDF; their numbers differ between files.
HAND_LINK = "panda_hand"
FINGER_LINKS = ("panda_leftfinger", "panda_rightfinger")

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

#: The middle between the fingertips in the hand link.
FINGERTIPS = (0.0, 0.0, 0.1034)
