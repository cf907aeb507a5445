"""Playing scenes one after another in one process, and what a scene leaves behind."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from handover_marl.benchmarking.episodes import EpisodeResult
from handover_marl.benchmarking.machine import describe_machine
from handover_marl.benchmarking.scribes import Scribe, ScribeMaker
from handover_marl.datasets.data_place import check_scene
from handover_marl.episode.episode import Episode
from handover_marl.episode.fluency import fluency
from handover_marl.episode.play import play
from handover_marl.episode.track import Recorder
from handover_marl.episode.watchers import ActionLog, Watcher
from handover_marl.errors import ActionError, HandoverError, OptionError, PolicyError
from handover_marl.run import REPLAY, Run, reference_of


@dataclass(frozen=True)
class Task:
    """One scene to play.

    Attributes:
        index: Its position in the split.
        scene_id: Its number.
        fingerprint: Hash of its data where it is asked for, which those must have where it is played; empty if any do.
    """

    index: int
    scene_id: int
    fingerprint: str = ""


@dataclass(frozen=True, eq=False)
class Played:
    """A finished scene.

    Attributes:
        task: What was asked for.
        result: Its outcome.
        actions: (T, 9) the action of every physics step.
        times: (T,) the policy's wall-clock time at every step (s), zero where it was not asked.
        written: What each scribe wrote about it.
    """

    task: Task
    result: EpisodeResult
    actions: npt.NDArray[np.float32]
    times: npt.NDArray[np.float64]
    written: tuple[bytes, ...] = ()


class Player:
    """Plays the scenes of a run in this process.

    Args:
        run: What is run, resolved.
        company: How many play beside each other, in words.
        scribes: Who puts the episodes into writing besides.
    """

    def __init__(self, run: Run, company: str, scribes: Sequence[ScribeMaker] = ()) -> None:
        self._run, self._machine = run, f"{describe_machine()}, {company}"
        self._dataset = run.open_dataset()
        giver, receiver = reference_of(run.giver), reference_of(run.receiver)
        self._receiver = receiver.make(self._dataset, run.config, run.setup)
        # The official giver is no policy: it cannot fail and takes no time.
        self._giver = None if giver.text == REPLAY else giver.make(self._dataset, run.config, run.setup)
        self._episode = Episode(run.physics, run.config, sight=run.camera)
        self._recorder, self._log = Recorder(), ActionLog()
        self._scribes: list[Scribe] = [scribe(run, self._receiver) for scribe in scribes]

    def play(self, task: Task) -> Played:
        """Play one scene to its end.

        Raises:
            HandoverError: The scene cannot be played or is another here, or a policy fails.
        """
        episode, scene = self._episode, self._dataset.scene(task.scene_id)
        fingerprint = self._dataset.fingerprint(task.scene_id)
        check_scene(task.scene_id, fingerprint, task.fingerprint)
        episode.reset(scene)
        try:
            watchers: list[Watcher] = [self._recorder, self._log, *self._scribes]
            play(episode, self._receiver, self._giver, seed=self._run.seed, watchers=watchers)
        except (ActionError, OptionError, PolicyError) as error:
            raise self._told(error, task) from error
        info = scene.info
        result = EpisodeResult(
            index=task.index,
            status=episode.status,
            steps=episode.steps,
            plan_time=float(self._log.times.sum()),
            scene_id=task.scene_id,
            release_step=episode.release_step,
            object_name=info.target_name,
            subject=info.subject,
            side=info.side,
            n_objects=len(info.object_ids),
            models=self._dataset.models_in_words(task.scene_id) or None,
            fingerprint=fingerprint,
            machine=self._machine,
            fluency=fluency(self._recorder.track),
        )
        written = tuple(scribe.written(result) for scribe in self._scribes)
        return Played(task, result, self._log.actions, self._log.times, written)

    def close(self) -> None:
        """Free the simulation."""
        self._episode.close()
        self._recorder.close()

    def _told(self, error: HandoverError, task: Task) -> HandoverError:
        players = f"receiver {self._receiver.name!r}"
        if self._giver is not None:
            players += f" and giver {self._giver.name!r}"
        return type(error)(f"{players} in scene {task.scene_id}: {error}")
