"""HandoverSim's table: PyBullet's own with another top and longer legs."""

from pathlib import Path

from handover_marl.assets.bullet_files import bullet_files
from handover_marl.datasets.importing.asset_files import put_files
from handover_marl.errors import DataFormatError

# What stands in PyBullet's file, what takes its place, and how often it does, in m: middle and size of the top, which
# is there to be seen and to be touched, then the legs' size and their middles.
_REPLACEMENTS = (
    ("0 0 0.6", "0 0 0.9", 2),
    ("1.5 1 0.05", "1.77 0.73 0.04", 2),
    ("0.1 0.1 0.58", "0.1 0.1 0.88", 4),
    ('"-0.65 -0.4 0.29"', '"-0.785 -0.265 0.44"', 1),
    ('"-0.65 0.4 0.29"', '"-0.785 0.265 0.44"', 1),
    ('"0.65 -0.4 0.29"', '"0.785 -0.265 0.44"', 1),
    ('"0.65 0.4 0.29"', '"0.785 0.265 0.44"', 1),
)
_COPIED = ("table.obj", "table.mtl", "table.png")
_INSTEAD = "import with Python 3.10 or 3.11: the folder then serves every Python"


def table_urdf(original: str) -> str:
    """The text of `table.urdf`, made of PyBullet's.

    Raises:
        DataFormatError: PyBullet's is not the one that HandoverSim was made with.
    """
    text = original
    for old, new, times in _REPLACEMENTS:
        if text.count(old) != times:
            raise DataFormatError(
                f"table/table.urdf in pybullet_data has {old} {text.count(old)} times instead of {times}; "
                "install the PyBullet that this library asks for again"
            )
        text = text.replace(old, new)
    return text


def table_folder() -> Path:
    """Where PyBullet has its table.

    Raises:
        OptionError: PyBullet is not installed.
    """
    return bullet_files("HandoverSim's table, which is made of PyBullet's,", _INSTEAD) / "table"


def write_table_assets(assets: Path) -> None:
    """Write `table/`, with copies of PyBullet's mesh and picture, where HandoverSim has links into its installation.

    Args:
        assets: HandoverSim's folder `assets`.

    Raises:
        OptionError: PyBullet is not installed.
        DataFormatError: PyBullet's table cannot be read, or is another one.
        ResultsError: A file is there with other content, or cannot be written.
    """
    source = table_folder()
    try:
        original = (source / "table.urdf").read_bytes().decode()
        copies = {name: (source / name).read_bytes() for name in _COPIED}
    except (OSError, UnicodeDecodeError) as error:
        raise DataFormatError(f"{source}: cannot read PyBullet's table ({error}); install PyBullet again") from error
    put_files(assets / "table", {"table.urdf": table_urdf(original).encode(), **copies})
