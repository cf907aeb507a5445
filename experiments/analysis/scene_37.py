"""Print the events and measurements that determine the outcome of an episode.

    python experiments/analysis/scene_37.py --scene 37 --receivers yang2021,reactive --data-dir DIR

The script simulates a scene with each receiver and prints the time of the first contact of robot and object,
the time and cause of the release by the giver, the time with contact of both fingers, the arrival
at the goal, and the outcome. `--hold 3` requires the object to be held at the goal for 3 s instead
of the official 0.1 s, to show whether the grasp is stable; the outcome is then not official.
"""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import tyro

from handover_marl import receivers
from handover_marl.config import OFFICIAL_CONFIG, TIME_STEP
from handover_marl.episode.callbacks import EpisodeCallback
from handover_marl.episode.episode import Episode
from handover_marl.episode.loop import run_episode
from handover_marl.evaluation.reports.tables import format_table
from handover_marl.geometry.poses import compose, compute_rotation_angle, invert_pose
from handover_marl.learning.training.scene_arguments import DatasetArgs
from handover_marl.policies.reference import split_policy_list


@dataclass(frozen=True, kw_only=True)
class Args(DatasetArgs):
    """Options of the analysis of one scene with several receivers.

    Attributes:
        scene: Scene number, 0 to 999.
        receivers: Names of the receivers, separated by commas.
        physics: Physics engine: exact or fast.
        hold: Time (s) for which the object must be held at the goal; official: 0.1.
    """

    scene: int
    receivers: str = "yang2021"
    physics: str = "exact"
    hold: float = 0.1


class RuleLog(EpisodeCallback):
    """Callback that records the measurements on which the referee bases an outcome.

    Attributes:
        touched: Physics step of the first contact of robot and object; None before that contact.
        arrived: First physics step after the release with the gripper in the goal region; None
            before that step.
        gripped: Number of steps since the release with both fingers in contact with the object.
        grips: Pose (7,) of the object in the frame of the Panda's hand link, in every step since the
            release.
        forces: Sum of the normal forces between Panda and object (N), in every step since the
            release.
    """

    def on_reset(self, episode: Episode) -> None:
        """Clear the measurements of the previous episode."""
        self.touched: int | None = None
        self.arrived: int | None = None
        self.gripped = 0
        self.grips: list[npt.NDArray[np.float64]] = []
        self.forces: list[float] = []

    def on_step(self, episode: Episode) -> None:
        """Record the contacts and poses after a physics step."""
        contacts, rules = episode.contacts, episode.config.protocol
        if self.touched is None and contacts.robot_touches_object:
            self.touched = episode.steps
        if episode.release_step is None:
            return
        state = episode.world.read_state()
        self.grips.append(compose(invert_pose(state.gripper_pose), state.object_poses[0]))
        self.forces.append(contacts.robot_object_force)
        self.gripped += contacts.both_fingers_touch
        away = np.linalg.norm(np.subtract(contacts.gripper_position, rules.goal_center))
        if self.arrived is None and away < rules.goal_radius:
            self.arrived = episode.steps

    @property
    def slip(self) -> tuple[float, float]:
        """Translation (m) and rotation (rad) of the object relative to the gripper since the release."""
        first, last = self.grips[0], self.grips[-1]
        return float(np.linalg.norm(last[:3] - first[:3])), compute_rotation_angle(first[3:], last[3:])


def format_row(name: str, episode: Episode, log: RuleLog) -> list[str]:
    """Return the cells of a receiver's table row.

    Args:
        name: Name of the receiver.
        episode: Finished episode.
        log: Measurements in that episode.
    """
    reason = episode.release_reason
    release = "" if reason is None else f"{format_seconds(episode.release_step)} ({reason.value})"
    after = episode.steps - (episode.release_step or episode.steps)
    slip = turned = gripped = force = ""
    if log.grips:
        moved, angle = log.slip
        slip, turned = f"{1000 * moved:.0f}", f"{np.degrees(angle):.0f}"
        gripped = f"{log.gripped} of {after + 1}"
        force = f"{np.median(log.forces):.1f}"
    verdict = f"{episode.status.label} at {format_seconds(episode.steps)}"
    return [
        name,
        format_seconds(log.touched),
        release,
        gripped,
        force,
        slip,
        turned,
        format_seconds(log.arrived),
        verdict,
    ]


def format_seconds(steps: int | None) -> str:
    """Return the time of a number of physics steps in seconds, as text; empty for None."""
    return "" if steps is None else f"{steps * TIME_STEP:.3f}"


def main(args: Args) -> None:
    """Simulate the scene with every receiver and print the table."""
    data = args.open_dataset()
    rules = replace(OFFICIAL_CONFIG.protocol, success_steps=round(args.hold / TIME_STEP))
    episode = Episode(args.physics, replace(OFFICIAL_CONFIG, protocol=rules))
    info, rows = data.load_scene(args.scene).info, []
    for name in split_policy_list("receiver", args.receivers):
        log = RuleLog()
        episode.reset(data.load_scene(args.scene))
        run_episode(episode, receivers.make(name, data), seed=0, callbacks=[log])
        rows.append(format_row(name, episode, log))
    print(
        f"Scene {args.scene}, {', '.join(info.object_names)}, {info.side} hand; {data.name}, {args.physics} physics, "
    )
    print(f"giver replay, {args.hold:g} s at the goal; times in s, force as its median in N, slip in mm and degrees.\n")
    header = ["receiver", "touch", "let go", "both fingers (ms)", "force", "slip", "turned", "at the goal", "verdict"]
    print(format_table(header, rows))


if __name__ == "__main__":
    main(tyro.cli(Args))
