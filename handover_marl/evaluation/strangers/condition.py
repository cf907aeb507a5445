"""Condition of an evaluation with unseen partners."""

from dataclasses import dataclass

from handover_marl.evaluation.reports.report import Report

_TEXTS = ("dataset", "setup", "split", "physics", "seed", "version")


@dataclass(frozen=True)
class Condition:
    """Condition of an evaluation; scores are comparable only under the same one.

    Attributes:
        agent: Agent of the evaluated policies, "receiver" or "giver".
        dataset: Name of the data set.
        setup: Setup of the scenes.
        split: Split of the scenes.
        physics: Physics of the simulation.
        seed: Seed of the policies.
        version: Version of the library.
        scenes: Scene numbers in ascending order.
        data: For every scene the hash of its data files, the number of objects and the models.
    """

    agent: str
    dataset: str
    setup: str
    split: str
    physics: str
    seed: str
    version: str
    scenes: tuple[int, ...]
    data: tuple[str, ...]

    @classmethod
    def from_report(cls, agent: str, report: Report) -> "Condition":
        """Return scenes, data, physics, seed and version of a report, in which policies of `agent` are evaluated."""
        metadata, episodes = report.metadata, report.episodes
        scenes = tuple(episode.scene_id if episode.scene_id is not None else -1 for episode in episodes)
        data = tuple(f"{each.fingerprint}, objects: {each.n_objects}, {each.models}" for each in episodes)
        return cls(agent, scenes=scenes, data=data, **{name: getattr(metadata, name) for name in _TEXTS})

    def list_differences(self, other: "Condition") -> list[str]:
        """Return the names of the fields in which another condition differs."""
        return [name for name, value in vars(self).items() if value != vars(other)[name]]
