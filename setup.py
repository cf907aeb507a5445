"""List of the installed packages; givers/, receivers/ and assets/ stand at the top of the tree."""

from setuptools import find_packages, setup

_FOLDERS = ("givers", "receivers", "assets")

setup(
    packages=[
        *find_packages(include=["handover_marl*"]),
        *(f"handover_marl.{name}" for name in find_packages(include=[f"{folder}*" for folder in _FOLDERS])),
    ],
    package_dir={"handover_marl": "handover_marl"} | {f"handover_marl.{folder}": folder for folder in _FOLDERS},
)
