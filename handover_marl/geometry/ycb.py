"""YCB object classes and subjects of the DexYCB dataset, numbered as in HandoverSim."""

from types import MappingProxyType

#: Class number (as in DexYCB and `ycb_ids`) -> class name.
CLASS_NAMES = MappingProxyType(
    {
        1: "002_master_chef_can",
        2: "003_cracker_box",
        3: "004_sugar_box",
        4: "005_tomato_soup_can",
        5: "006_mustard_bottle",
        6: "007_tuna_fish_can",
        7: "008_pudding_box",
        8: "009_gelatin_box",
        9: "010_potted_meat_can",
        10: "011_banana",
        11: "019_pitcher_base",
        12: "021_bleach_cleanser",
        13: "024_bowl",
        14: "025_mug",
        15: "035_power_drill",
        16: "036_wood_block",
        17: "037_scissors",
        18: "040_large_marker",
        19: "051_large_clamp",
        20: "052_extra_large_clamp",
        21: "061_foam_brick",
    }
)

#: Largest class number of YCB; classes of other data sets have larger ones.
LARGEST_YCB_CLASS = max(CLASS_NAMES)

#: The twenty classes that DexYCB's people hand over (no large clamp), in the order of the scene numbering.
SCENE_CLASSES = tuple(number for number in CLASS_NAMES if number != 19)

SUBJECTS = (
    "20200709-subject-01",
    "20200813-subject-02",
    "20200820-subject-03",
    "20200903-subject-04",
    "20200908-subject-05",
    "20200918-subject-06",
    "20200928-subject-07",
    "20201002-subject-08",
    "20201015-subject-09",
    "20201022-subject-10",
)
