"""Why the rules say what they say about an episode: what they looked at, and when.

    python experiments/verdict.py --scene 37 --receivers yang2021,reactive --data-dir DIR

Plays a scene with each receiver and prints when the robot first touched the object, when and why the person let go, how
long both fingers held on, when the gripper came to the goal, and the verdict. `--hold 3` asks for three seconds at the
goal instead of the official 0.1, so that one sees what became of a success: that is no official verdict.
"""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import tyro

from handover_marl import receivers
from handover_marl.benchmarking.tables import table
from handover_marl.config import OFFICIAL, TIME_STEP
from handover_marl.datasets import open_dataset
from handover_marl.episode.episode import Episode
from handover_marl.episode.play import play
from handover_marl.episode.watchers import Watcher
from handover_marl.models.poses import compose, inverse, rotation_angle
from handover_marl.policies.reference import split_names


@dataclass(frozen=True)
class Args:
    """What to play.

    Attributes:
        scene: The scene, 0 to 999.
        receivers: Receivers, with commas.
        data_dir: Folder in HandoverSim's layout; default: HANDOVER_MARL_DATA.
        dataset: dexycb, synthetic, or auto.
        physics: exact or fast.
        hold: How long (s) the object must be held at the goal; official: 0.1.
    """

    scene: int
    receivers: str = "yang2021"
    data_dir: str | None = None
    dataset: str = "auto"
    physics: str = "exact"
    hold: float = 0.1


class RuleLog(Watcher):
    """Notes what the rules look at.

    Attributes:
        touched: Step of the first contact of robot and object, or None.
        arrived: Step at which the gripper came to the goal after the release, or None.
        gripped: Steps since the release with both fingers on the object.
        supported: Steps since the release in which the object lay on the table or another one.
        grips: Poses (7,) of the object in the Panda's hand link, from the release on.
        forces: Forces (N) between Panda and object, likewise.
    """

    def started(self, episode: Episode) -> None:
        """Forget the last episode."""
        self.touched: int | None = None
        self.arrived: int | None = None
        self.gripped = self.supported = 0
        self.grips: list[npt.NDArray[np.float64]] = []
        self.forces: list[float] = []

    def stepped(self, episode: Episode) -> None:
        """Look at one more step."""
        contacts, rules = episode.contacts, episode.config.protocol
        if self.touched is None and contacts.robot_object:
            self.touched = episode.steps
        if episode.release_step is None:
            return
        state = episode.world.state()
        self.grips.append(compose(inverse(state.gripper_pose), state.object_poses[0]))
        self.forces.append(contacts.robot_object_force)
        self.gripped += contacts.both_fingers
        self.supported += contacts.object_supported
        away = np.linalg.norm(np.subtract(contacts.gripper_position, rules.goal_center))
        if self.arrived is None and away < rules.goal_radius:
            self.arrived = episode.steps

    @property
    def slip(self) -> tuple[float, float]:
        """How far (m) and how much (rad) the object has moved in the gripper since the release."""
        first, last = self.grips[0], self.grips[-1]
        return float(np.linalg.norm(last[:3] - first[:3])), rotation_angle(first[3:], last[3:])


def row(name: str, episode: Episode, log: RuleLog) -> list[str]:
    """A line of the table."""
    release = "" if episode.release is None else f"{seconds(episode.release_step)} ({episode.release.value})"
    after = episode.steps - (episode.release_step or episode.steps)
    slip = turned = gripped = force = ""
    if log.grips:
        moved, angle = log.slip
        slip, turned = f"{1000 * moved:.0f}", f"{np.degrees(angle):.0f}"
        gripped = f"{log.gripped} of {after + 1}"
        force = f"{np.median(log.forces):.1f}"
    verdict = f"{episode.status.label} at {seconds(episode.steps)}"
    return [name, seconds(log.touched), release, gripped, force, slip, turned, seconds(log.arrived), verdict]


def seconds(steps: int | None) -> str:
    """Physics steps as text."""
    return "" if steps is None else f"{steps * TIME_STEP:.3f}"


def main(args: Args) -> None:
    """Play and print."""
    data = open_dataset(args.dataset, args.data_dir)
    rules = replace(OFFICIAL.protocol, success_steps=round(args.hold / TIME_STEP))
    episode = Episode(args.physics, replace(OFFICIAL, protocol=rules))
    info, rows = data.scene(args.scene).info, []
    for name in split_names("receiver", args.receivers):
        log = RuleLog()
        episode.reset(data.scene(args.scene))
        play(episode, receivers.make(name, data), seed=0, watchers=[log])
        rows.append(row(name, episode, log))
    print(
        f"Scene {args.scene}, {', '.join(info.object_names)}, {info.side} hand; {data.name}, {args.physics} physics, "
    )
    print(f"giver replay, {args.hold:g} s at the goal; times in s, force as its median in N, slip in mm and degrees.\n")
    header = ["receiver", "touch", "let go", "both fingers (ms)", "force", "slip", "turned", "at the goal", "verdict"]
    print(table(header, rows))


if __name__ == "__main__":
    main(tyro.cli(Args))
