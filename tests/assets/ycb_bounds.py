from pathlib import Path
from types import MappingProxyType

import trimesh

from handover_marl.assets.building.object_files import read_parts
from handover_marl.assets.object_models import COLLISION_NAME, OBJECTS_ROOT, VISUAL_NAME, find_object_urdf

#: Lowest and highest corner (m) of the scanned object's bounding box in its frame, by YCB class
#: name; measured on the YCB-Video models (Calli et al., 2015; Xiang et al., 2018).
YCB_BOUNDS = MappingProxyType(
    {
        "002_master_chef_can": ((-0.0525, -0.0508, -0.0737), (0.0499, 0.0519, 0.0665)),
        "003_cracker_box": ((-0.0364, -0.0836, -0.1116), (0.0352, 0.0803, 0.1019)),
        "004_sugar_box": ((-0.0239, -0.0484, -0.0924), (0.0256, 0.0456, 0.0836)),
        "005_tomato_soup_can": ((-0.0341, -0.0323, -0.0593), (0.0336, 0.0354, 0.0426)),
        "006_mustard_bottle": ((-0.0499, -0.0357, -0.0839), (0.0473, 0.0308, 0.1075)),
        "007_tuna_fish_can": ((-0.0428, -0.0429, -0.0208), (0.0428, 0.0424, 0.0127)),
        "008_pudding_box": ((-0.0703, -0.0604, -0.0224), (0.0676, 0.0682, 0.0163)),
        "009_gelatin_box": ((-0.0461, -0.0500, -0.0186), (0.0432, 0.0510, 0.0115)),
        "010_potted_meat_can": ((-0.0534, -0.0308, -0.0498), (0.0488, 0.0293, 0.0338)),
        "011_banana": ((-0.0358, -0.1014, -0.0169), (0.0732, 0.0769, 0.0198)),
        "019_pitcher_base": ((-0.0797, -0.0787, -0.1471), (0.0692, 0.0662, 0.0956)),
        "021_bleach_cleanser": ((-0.0562, -0.0314, -0.1120), (0.0461, 0.0363, 0.1385)),
        "024_bowl": ((-0.0803, -0.0815, -0.0245), (0.0808, 0.0795, 0.0306)),
        "025_mug": ((-0.0503, -0.0457, -0.0391), (0.0669, 0.0472, 0.0424)),
        "035_power_drill": ((-0.1010, -0.1146, -0.0265), (0.0833, 0.0726, 0.0308)),
        "036_wood_block": ((-0.0534, -0.0492, -0.1200), (0.0506, 0.0543, 0.0858)),
        "037_scissors": ((-0.0551, -0.0726, -0.0078), (0.0410, 0.1289, 0.0079)),
        "040_large_marker": ((-0.0105, -0.0583, -0.0098), (0.0105, 0.0625, 0.0092)),
        "051_large_clamp": ((-0.0705, -0.0834, -0.0191), (0.0497, 0.0875, 0.0199)),
        "052_extra_large_clamp": ((-0.1044, -0.0717, -0.0185), (0.1052, 0.0925, 0.0179)),
        "061_foam_brick": ((-0.0261, -0.0389, -0.0172), (0.0266, 0.0388, 0.0339)),
    }
)


def load_visual_mesh(name: str, root: Path = OBJECTS_ROOT) -> trimesh.Trimesh:
    """Load the visual mesh (m) of an object."""
    (mesh,) = read_parts(find_object_urdf(name, root).with_name(VISUAL_NAME))
    return mesh


def load_collision_parts(name: str, root: Path = OBJECTS_ROOT) -> list[trimesh.Trimesh]:
    """Load the convex collision meshes (m) of an object."""
    return read_parts(find_object_urdf(name, root).with_name(COLLISION_NAME))
