"""How far from an object's origin people hold it when they offer it: what the synthetic grasps are chosen by.

Source: own measurement on DexYCB (Chao et al., CVPR 2021), last frame of 994 of the 1000 recordings (six end
without a hand); aggregate figures only.
"""

from types import MappingProxyType
from typing import Final

import numpy as np
import numpy.typing as npt

#: The levels of the quantiles below.
LEVELS: Final = (0.02, 0.10, 0.25, 0.40, 0.50, 0.60, 0.75, 0.90, 0.98)

#: Quantiles of the distance (m) from the wrist to the object's origin, per class, about 50 recordings each.
WRIST_DISTANCE_QUANTILES: Final = MappingProxyType(
    {
        "002_master_chef_can": (0.114, 0.122, 0.127, 0.132, 0.135, 0.143, 0.151, 0.169, 0.172),
        "003_cracker_box": (0.148, 0.165, 0.173, 0.176, 0.184, 0.188, 0.202, 0.213, 0.221),
        "004_sugar_box": (0.110, 0.125, 0.133, 0.141, 0.143, 0.148, 0.153, 0.165, 0.176),
        "005_tomato_soup_can": (0.115, 0.117, 0.124, 0.129, 0.132, 0.134, 0.142, 0.150, 0.163),
        "006_mustard_bottle": (0.108, 0.116, 0.121, 0.125, 0.129, 0.134, 0.138, 0.153, 0.176),
        "007_tuna_fish_can": (0.116, 0.119, 0.125, 0.132, 0.136, 0.139, 0.144, 0.148, 0.152),
        "008_pudding_box": (0.123, 0.133, 0.143, 0.147, 0.149, 0.151, 0.155, 0.162, 0.174),
        "009_gelatin_box": (0.127, 0.133, 0.139, 0.142, 0.144, 0.148, 0.153, 0.157, 0.158),
        "010_potted_meat_can": (0.118, 0.128, 0.135, 0.139, 0.143, 0.144, 0.152, 0.157, 0.163),
        "011_banana": (0.112, 0.122, 0.131, 0.136, 0.144, 0.148, 0.156, 0.169, 0.178),
        "019_pitcher_base": (0.122, 0.138, 0.148, 0.156, 0.167, 0.177, 0.186, 0.194, 0.216),
        "021_bleach_cleanser": (0.111, 0.116, 0.121, 0.129, 0.132, 0.136, 0.141, 0.161, 0.189),
        "024_bowl": (0.109, 0.115, 0.125, 0.163, 0.170, 0.174, 0.181, 0.193, 0.197),
        "025_mug": (0.118, 0.126, 0.133, 0.139, 0.142, 0.149, 0.164, 0.175, 0.180),
        "035_power_drill": (0.081, 0.099, 0.114, 0.126, 0.132, 0.136, 0.145, 0.159, 0.173),
        "036_wood_block": (0.118, 0.135, 0.143, 0.148, 0.149, 0.154, 0.161, 0.182, 0.199),
        "037_scissors": (0.112, 0.124, 0.131, 0.143, 0.148, 0.152, 0.169, 0.201, 0.224),
        "040_large_marker": (0.107, 0.119, 0.124, 0.132, 0.137, 0.142, 0.151, 0.164, 0.173),
        "052_extra_large_clamp": (0.106, 0.130, 0.141, 0.148, 0.161, 0.167, 0.180, 0.189, 0.210),
        "061_foam_brick": (0.122, 0.131, 0.137, 0.140, 0.143, 0.145, 0.151, 0.158, 0.162),
    }
)

#: Median share of the object's surface that is more than 30 mm from the hand, per class: 25 recordings each, with
#: this library's capsules on the recorded joints.
FREE_SHARE_MEDIAN: Final = MappingProxyType(
    {
        "002_master_chef_can": 0.61,
        "003_cracker_box": 0.82,
        "004_sugar_box": 0.63,
        "005_tomato_soup_can": 0.41,
        "006_mustard_bottle": 0.55,
        "007_tuna_fish_can": 0.39,
        "008_pudding_box": 0.55,
        "009_gelatin_box": 0.53,
        "010_potted_meat_can": 0.54,
        "011_banana": 0.48,
        "019_pitcher_base": 0.80,
        "021_bleach_cleanser": 0.65,
        "024_bowl": 0.72,
        "025_mug": 0.55,
        "035_power_drill": 0.62,
        "036_wood_block": 0.74,
        "037_scissors": 0.46,
        "040_large_marker": 0.33,
        "052_extra_large_clamp": 0.57,
        "061_foam_brick": 0.43,
    }
)


def wrist_distance_quantile(object_name: str, level: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Wrist distances (m) at quantile levels in 0 to 1, interpolated; the outermost values hold beyond."""
    return np.asarray(np.interp(np.asarray(level), LEVELS, WRIST_DISTANCE_QUANTILES[object_name]))
