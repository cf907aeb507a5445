"""Command that builds shipped grasps: `python -m handover_marl.assets.building --help`; needs the extra `assets`."""

import tyro

from handover_marl.assets.building.grasps import build_grasp_validations, build_human_grasps, build_robot_grasps

if __name__ == "__main__":
    tyro.extras.subcommand_cli_from_dict(
        {
            "robot-grasps": build_robot_grasps,
            "human-grasps": build_human_grasps,
            "grasp-validations": build_grasp_validations,
        }
    )
