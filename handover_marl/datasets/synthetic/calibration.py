"""Aggregate figures of DexYCB that the generated scenes are drawn from.

Source: own measurement on the 1000 recordings of DexYCB (Chao et al., CVPR 2021) in HandoverSim's table frame:
quantiles, shares and correlations only. Positions in m, speeds in m/s, angles in degrees, times in frames (40 ms).
Where sides matter, left hands are mirrored into right ones (x -> 2 * MIRROR_X - x; directions x -> -x).
"""

from types import MappingProxyType

#: Levels of all quantile tables.
LEVELS = (
    0,
    0.01,
    0.025,
    0.05,
    0.1,
    0.15,
    0.2,
    0.25,
    0.3,
    0.35,
    0.4,
    0.45,
    0.5,
    0.55,
    0.6,
    0.65,
    0.7,
    0.75,
    0.8,
    0.85,
    0.9,
    0.95,
    0.975,
    0.99,
    1,
)

#: Length of the recordings and how often it occurs.
FRAME_COUNTS = MappingProxyType({66: 1, 68: 8, 70: 50, 72: 502, 74: 436, 76: 3})

#: The plane in which left- and right-handed people mirror each other.
MIRROR_X = 0.56

#: First frame with a hand.
HAND_ONSET = (
    *(0, 0, 0, 0, 0, 0, 0, 1, 3, 5, 7, 7, 9),
    *(11, 11, 13, 13, 15, 15, 17, 19, 21, 23, 25, 33),
)

#: Where the object lies before it is taken.
START_X = (
    *(0.328, 0.39, 0.413, 0.433, 0.45, 0.462, 0.477, 0.491, 0.506, 0.521, 0.535, 0.547, 0.56),
    *(0.57, 0.579, 0.592, 0.606, 0.619, 0.638, 0.652, 0.672, 0.692, 0.711, 0.733, 0.808),
)

#: As START_X.
START_Y = (
    *(0.043, 0.074, 0.09, 0.101, 0.116, 0.128, 0.139, 0.148, 0.158, 0.168, 0.178, 0.189, 0.2),
    *(0.215, 0.228, 0.245, 0.261, 0.277, 0.296, 0.321, 0.347, 0.383, 0.402, 0.421, 0.473),
)

#: Where the object is offered: its position in the last frame.
OFFER_X = (
    *(0.298, 0.395, 0.415, 0.437, 0.47, 0.49, 0.509, 0.527, 0.539, 0.55, 0.561, 0.571, 0.582),
    *(0.592, 0.602, 0.615, 0.625, 0.638, 0.651, 0.666, 0.685, 0.715, 0.742, 0.771, 0.88),
)

#: As OFFER_X.
OFFER_Y = (
    *(-0.105, -0.022, -0.007, 0.012, 0.033, 0.049, 0.064, 0.076, 0.087, 0.099, 0.107, 0.117, 0.127),
    *(0.136, 0.144, 0.153, 0.166, 0.179, 0.196, 0.224, 0.284, 0.337, 0.38, 0.421, 0.46),
)

#: As OFFER_X.
OFFER_Z = (
    *(0.034, 0.141, 0.172, 0.189, 0.219, 0.236, 0.251, 0.265, 0.28, 0.291, 0.306, 0.317, 0.332),
    *(0.346, 0.361, 0.377, 0.392, 0.403, 0.413, 0.428, 0.444, 0.464, 0.486, 0.505, 0.577),
)

#: Peak speed of the wrist.
PEAK_SPEED = (
    *(0.447, 0.603, 0.661, 0.714, 0.785, 0.825, 0.86, 0.896, 0.929, 0.954, 0.98, 1.004, 1.03),
    *(1.053, 1.074, 1.096, 1.123, 1.158, 1.193, 1.227, 1.284, 1.379, 1.495, 1.644, 2.894),
)

#: Where the wrist is first seen.
ENTRY_X = (
    *(0.157, 0.214, 0.247, 0.267, 0.291, 0.306, 0.318, 0.328, 0.338, 0.349, 0.36, 0.368, 0.377),
    *(0.384, 0.391, 0.4, 0.411, 0.421, 0.434, 0.452, 0.471, 0.518, 0.577, 0.616, 0.741),
)

#: As ENTRY_X.
ENTRY_Y = (
    *(0.239, 0.421, 0.467, 0.523, 0.559, 0.585, 0.608, 0.626, 0.641, 0.656, 0.669, 0.678, 0.686),
    *(0.694, 0.704, 0.716, 0.728, 0.742, 0.757, 0.778, 0.808, 0.843, 0.878, 0.917, 1.046),
)

#: As ENTRY_X.
ENTRY_Z = (
    *(-0.035, 0.04, 0.056, 0.071, 0.095, 0.109, 0.12, 0.129, 0.139, 0.145, 0.151, 0.158, 0.164),
    *(0.174, 0.182, 0.191, 0.202, 0.209, 0.218, 0.231, 0.249, 0.289, 0.315, 0.339, 0.493),
)

#: Direction of the straight fingers at the offer, from the robot (-y) towards +x.
POINTING_AZIMUTH = (
    *(-57, -34.8, -29.6, -26.1, -21.5, -18.1, -15.4, -13.1, -10.9, -9.2, -7.7, -6.2, -4.7),
    *(-3.1, -1.4, 0.4, 2.2, 4.5, 7.4, 10.6, 14.5, 23, 29.2, 42.6, 102),
)

#: Direction of the straight fingers at the offer, above the horizontal.
POINTING_ELEVATION = (
    *(-61.8, -42.1, -37.7, -33.1, -29.1, -26.2, -23.7, -21.4, -18.6, -15.9, -13, -10.6, -7.6),
    *(-3.7, 0.1, 3.6, 7.1, 10.5, 14.5, 17.8, 22.2, 27.9, 32.1, 39.8, 58.8),
)

#: Turn of the back of the hand about the fingers at the offer, from up towards fingers x up.
ROLL = (
    *(-72, -17.6, -4.6, 5.4, 21.1, 33.6, 44.1, 50.1, 58.5, 64.9, 71.4, 78.3, 85),
    *(90.6, 100, 106.7, 114.5, 124.7, 132.3, 143.1, 152.5, 169, 176.7, 183.2, 215.6),
)

#: Angle between the up directions that the object has before it is taken and at the offer.
TILT = (
    *(0.6, 2.2, 3, 4.5, 6.7, 9.6, 13.1, 17, 24.5, 35.2, 47.8, 58.2, 66.9),
    *(75.7, 81.2, 86.3, 89.6, 94.2, 103.4, 119.8, 134.2, 152.1, 162.4, 168.5, 177.4),
)

#: Share of the handy robot grasps that the offering hand leaves free; see `room`. Measured on the 900 scenes of
#: the splits with HandoverSim's grasps and DexYCB's hand joints.
ROOM = (
    *(0.0, 0.04, 0.2, 0.32, 0.44, 0.56, 0.64, 0.68, 0.76, 0.76, 0.8, 0.84, 0.88),
    *(0.88, 0.92, 0.92, 0.96, 0.96, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0),
)

#: Rank correlations.
START_OFFER_X = 0.43
START_OFFER_Y = 0.26
ELEVATION_ROLL = -0.66

#: How often each object axis points up before the object is taken: +x, -x, +y, -y, +z, -z, of about 50 recordings.
UP_AXES = MappingProxyType(
    {
        1: (9, 8, 8, 3, 14, 8),
        2: (9, 4, 15, 10, 13, 0),
        3: (15, 5, 12, 7, 10, 0),
        4: (4, 7, 9, 5, 16, 9),
        5: (7, 9, 12, 3, 19, 0),
        6: (9, 3, 3, 4, 24, 7),
        7: (5, 1, 14, 6, 17, 7),
        8: (5, 16, 1, 3, 21, 4),
        9: (4, 5, 6, 10, 15, 10),
        10: (0, 3, 0, 0, 25, 22),
        11: (0, 14, 0, 13, 19, 4),
        12: (10, 11, 4, 9, 16, 0),
        13: (0, 0, 0, 0, 32, 18),
        14: (0, 0, 12, 6, 20, 12),
        15: (0, 0, 23, 1, 12, 14),
        16: (4, 7, 12, 7, 18, 2),
        17: (0, 0, 0, 1, 23, 26),
        18: (7, 16, 19, 0, 4, 4),
        20: (0, 1, 0, 0, 21, 28),
        21: (0, 3, 9, 9, 29, 0),
    }
)
