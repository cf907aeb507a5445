"""Command that builds shipped files: `python -m handover_marl.assets.building FILES`, with the extra `assets`."""

import tyro

from handover_marl.assets.building.grasps import build_grasp_validations, build_human_grasps, build_robot_grasps
from handover_marl.assets.building.hands import build_hands
from handover_marl.assets.building.objects import build_objects

if __name__ == "__main__":
    tyro.extras.subcommand_cli_from_dict(
        {
            "objects": build_objects,
            "hands": build_hands,
            "robot-grasps": build_robot_grasps,
            "human-grasps": build_human_grasps,
            "grasp-validations": build_grasp_validations,
        }
    )
