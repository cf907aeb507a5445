"""Constants of the Franka Panda, among them those of the grasp ranking by Yang et al. (ICRA 2021).

Lengths are in m, angles in rad, quaternions xyzw.
"""

#: Robots: HandoverSim's Panda without and with a wrist camera. The camera's housing collides and the finger friction
#: differs, so results of the two are not comparable.
PANDA, PANDA_CAMERA = "panda", "panda_camera"
ROBOTS = (PANDA, PANDA_CAMERA)

#: Names of links in the URDF files; link numbers differ between files.
HAND_LINK = "panda_hand"
CAMERA_LINK = "panda_hand_camera"
FINGER_LINKS = ("panda_leftfinger", "panda_rightfinger")
#: Links on which a camera can be mounted, along the chain.
MOUNT_LINKS = (*(f"panda_link{number}" for number in range(1, 8)), HAND_LINK)

#: Pose (7,) of the camera link in the hand link, xyz and quaternion.
HAND_FROM_CAMERA_LINK = (0.036, 0.0, 0.036, -0.5, 0.5, -0.5, 0.5)

#: Joint limits of the seven arm joints and the two fingers.
LOWER_LIMITS = (-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973, 0.0, 0.0)
UPPER_LIMITS = (2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.752, 2.8973, 0.04, 0.04)

#: Height of the shoulder, where the axes of the first two joints meet, above the base.
SHOULDER_HEIGHT = 0.333

#: Finger joint positions of the open and the closed gripper.
OPEN, CLOSED = 0.04, 0.0

#: Joint positions (7 arm joints, 2 fingers) in which HandoverSim's baselines wait for the handover.
WAITING_JOINTS = (-0.0593, -1.6124, -0.1970, -2.5300, -0.0952, 1.6780, 0.5870, OPEN, OPEN)

#: Pose (7,) of the hand link in the gripper frame of HandoverSim's grasps: a rotation by 90 degrees about z.
GRIPPER_FROM_HAND = (0.0, 0.0, 0.0, 0.0, 0.0, 0.7071068, -0.7071068)

#: Pose (7,) of the equivalent grasp in the hand link's frame: rotated by 180 degrees about the approach axis z.
HALF_TURN = (0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0)

#: Polyline of the gripper in the hand link's frame, from fingertip over palm to fingertip.
GRIPPER_OUTLINE = (
    *((0.0, 0.04, 0.103), (0.0, 0.04, 0.05), (0.0, 0.0, 0.05), (0.0, 0.0, 0.0)),
    *((0.0, 0.0, 0.05), (0.0, -0.04, 0.05), (0.0, -0.04, 0.103)),
)

#: Distance (m) along the hand link's z axis from its origin to the middle between the finger pads.
PAD_DISTANCE = 0.1

#: Point between the fingertips in the hand link's frame.
FINGERTIPS = (0.0, 0.0, 0.1034)

#: Standoff pose (7,) in the hand link's frame at the grasp: 20 cm back.
RANKING_STANDOFF = (0.0, 0.0, -0.2, 0.0, 0.0, 0.0, 1.0)

#: World pose (7,) of the hand link near the waiting joints; standoffs are ranked by their distance to it.
PREFERRED_HAND_POSE = (*(0.6914180, -0.4314530, 1.5511079), *(0.6429956, 0.6701149, 0.2626269, -0.2617819))

#: Weight (m^2) of the rotations in `compute_squared_pose_distances`.
RANKING_ROTATION_WEIGHT = 0.5

#: Largest number of grasps that are considered: those of the best ranks.
MAX_RANKED_GRASPS = 25
