"""Playing scenes with a receiver, and what a scene leaves behind."""

import time
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from handover_marl import givers, receivers
from handover_marl.benchmarking.episodes import EpisodeResult
from handover_marl.config import PANDA_DOF, ProtocolConfig
from handover_marl.datasets import open_dataset
from handover_marl.episode import Episode
from handover_marl.errors import ActionError, OptionError
from handover_marl.fluency import fluency
from handover_marl.givers import Giver
from handover_marl.motion import NO_DEVIATION
from handover_marl.policy_clock import PolicyClock
from handover_marl.receivers import Receiver
from handover_marl.scene import Scene
from handover_marl.spaces import check_giver_action, check_receiver_action
from handover_marl.track import Recorder

#: The giver of official results.
REPLAY = "replay"


@dataclass(frozen=True)
class Job:
    """What is to be played; small and picklable, so that worker processes can build it.

    Attributes:
        dataset: Name of the dataset.
        data_dir: Its folder, or None.
        receiver: Name of the receiver.
        giver: Name of the giver.
        physics: Kind of physics.
        machine: Where it is played, in words.
        trust: Whether code in policy files may run.
    """

    dataset: str
    data_dir: str | None
    receiver: str
    giver: str
    physics: str
    machine: str
    trust: bool = False


@dataclass(frozen=True)
class Task:
    """One scene to play: its number, and its position in the split."""

    index: int
    scene_id: int


@dataclass(frozen=True, eq=False)
class Played:
    """A finished scene.

    Attributes:
        task: What was asked for.
        result: Its outcome.
        actions: (T, 9) the action of every physics step.
        times: (T,) the policy's wall-clock time at every step (s), zero where it was not asked.
    """

    task: Task
    result: EpisodeResult
    actions: npt.NDArray[np.float32]
    times: npt.NDArray[np.float64]


class Player:
    """Plays the scenes of a job one after another in this process."""

    def __init__(self, job: Job) -> None:
        self._dataset = open_dataset(job.dataset, job.data_dir)
        self._policy = receivers.make(job.receiver, self._dataset, job.trust)
        # The official giver is no policy: it cannot fail and takes no time.
        self._giver = None if job.giver == REPLAY else givers.make(job.giver, job.trust)
        self._episode = Episode(job.physics)
        self._machine = job.machine

    def play(self, task: Task) -> Played:
        """Play one scene to its end."""
        scene = self._dataset.scene(task.scene_id)
        try:
            recorder = Recorder(scene)
            actions, times = play(self._episode, scene, self._policy, self._giver, recorder)
        except (ActionError, OptionError) as error:
            players = f"receiver {self._policy.name!r}"
            if self._giver is not None:
                players += f" and giver {self._giver.name!r}"
            raise type(error)(f"{players} in scene {task.scene_id}: {error}") from error
        episode, info = self._episode, scene.info
        track = recorder.finish(episode.world.state(), episode.steps, episode.release_step)
        result = EpisodeResult(
            index=task.index,
            status=episode.status,
            steps=episode.steps,
            plan_time=float(times.sum()),
            scene_id=task.scene_id,
            release_step=episode.release_step,
            object_name=info.target_name,
            subject=info.subject,
            side=info.side,
            n_objects=len(info.object_ids),
            fingerprint=self._dataset.fingerprint(task.scene_id),
            machine=self._machine,
            fluency=fluency(track),
        )
        return Played(task, result, actions, times)

    def close(self) -> None:
        """Free the simulation."""
        self._episode.close()


def play(
    episode: Episode,
    scene: Scene,
    policy: Receiver,
    giver: Giver | None = None,
    recorder: Recorder | None = None,
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float64]]:
    """Play a scene to its end.

    Args:
        episode: What it is played in.
        scene: The scene.
        policy: The receiver; asked when it wants to be.
        giver: The giver, likewise; None replays the recording.
        recorder: Takes note of the motion, or None.

    Returns:
        (T, 9) the receiver's action at every physics step, and (T,) its wall-clock time at every step (s), zero
        where it was not asked because its last action stood.
    """
    horizon = ProtocolConfig().horizon_steps
    actions, times = np.zeros((horizon, PANDA_DOF), dtype=np.float32), np.zeros(horizon)
    episode.reset(scene, recorder)
    clocks = [PolicyClock(player) for player in (policy, giver) if player is not None]
    for clock in clocks:
        clock.reset(scene.info.scene_id)
    robot = np.zeros(PANDA_DOF, dtype=np.float32)
    deviation = NO_DEVIATION
    while not episode.status:
        observation, before = episode.observe(), episode.steps
        if clocks[0].due(before):
            started = time.perf_counter()
            action = clocks[0].ask(observation)
            times[before] = time.perf_counter() - started
            robot = check_receiver_action(action)
        if giver is not None and clocks[1].due(before):
            deviation = check_giver_action(clocks[1].ask(episode.observe_as_giver(observation)))
        until = min(horizon, *(clock.due_ms for clock in clocks))
        episode.advance(robot, until - before, deviation)
        actions[before : episode.steps] = robot
    return actions[: episode.steps], times[: episode.steps]
