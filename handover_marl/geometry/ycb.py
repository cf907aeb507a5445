"""YCB object classes and subjects of the DexYCB dataset, numbered as in HandoverSim."""

from types import MappingProxyType

_NAMES = (
    *("002_master_chef_can", "003_cracker_box", "004_sugar_box", "005_tomato_soup_can", "006_mustard_bottle"),
    *("007_tuna_fish_can", "008_pudding_box", "009_gelatin_box", "010_potted_meat_can", "011_banana"),
    *("019_pitcher_base", "021_bleach_cleanser", "024_bowl", "025_mug", "035_power_drill", "036_wood_block"),
    *("037_scissors", "040_large_marker", "051_large_clamp", "052_extra_large_clamp", "061_foam_brick"),
)
#: Class number (as in DexYCB and `ycb_ids`) -> class name.
CLASS_NAMES = MappingProxyType(dict(enumerate(_NAMES, start=1)))

#: Largest class number of YCB; classes of other data sets have larger ones.
LARGEST_YCB_CLASS = max(CLASS_NAMES)

#: The twenty classes that DexYCB's people hand over (no large clamp), in the order of the scene numbering.
SCENE_CLASSES = tuple(number for number in CLASS_NAMES if number != 19)

SUBJECTS = (
    *("20200709-subject-01", "20200813-subject-02", "20200820-subject-03", "20200903-subject-04"),
    *("20200908-subject-05", "20200918-subject-06", "20200928-subject-07", "20201002-subject-08"),
    *("20201015-subject-09", "20201022-subject-10"),
)
