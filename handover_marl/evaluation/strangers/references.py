"""Reference scores: for every partner its best response, the best policy that has been evaluated with it.

A file of references has one section for each condition (`Condition`), and for each partner the label, version and
command of the best policy, and its scores by scene.
"""

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from handover_marl.errors import DataFormatError, DataNotFoundError
from handover_marl.evaluation.reports.report import Report
from handover_marl.evaluation.reports.tables import ReportTable, TabularResult
from handover_marl.execution.files import shorten_text
from handover_marl.execution.options import check_path
from handover_marl.execution.reading import read_plain_file
from handover_marl.policies.populations import Population

_MAX_BYTES = 20_000_000
_DIGITS = 6
_TEXTS = ("agent", "dataset", "setup", "split", "physics", "seed", "version")


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
        """Return the condition of a report in which policies of one agent are evaluated."""
        metadata, episodes = report.metadata, report.episodes
        scenes = tuple(episode.scene_id if episode.scene_id is not None else -1 for episode in episodes)
        data = tuple(f"{each.fingerprint}, objects: {each.n_objects}, {each.models}" for each in episodes)
        return cls(agent, scenes=scenes, data=data, **{name: getattr(metadata, name) for name in _TEXTS[1:]})

    def list_differences(self, other: "Condition") -> list[str]:
        """Return the names of the fields in which another condition differs."""
        return [name for name, value in vars(self).items() if value != vars(other)[name]]

    def contains(self, other: "Condition") -> bool:
        """Return whether another condition equals this one, with the same scenes or some of them."""
        same = set(self.list_differences(other)) <= {"scenes", "data"}
        return same and set(zip(other.scenes, other.data, strict=True)) <= set(zip(self.scenes, self.data, strict=True))


@dataclass(frozen=True)
class Reference:
    """Best policy that has been evaluated with a partner.

    Attributes:
        policy: Label of the policy.
        version: Version of the library and hash of the policy.
        command: Command of the evaluation.
        scores: Average-success score of every scene of the condition.
    """

    policy: str
    version: str
    command: str
    scores: tuple[float, ...]

    @property
    def mean(self) -> float:
        """Average success (0..1) of the policy with the partner: the mean of `scores`."""
        return float(np.mean(self.scores))


@dataclass(frozen=True)
class ReferenceTable(TabularResult):
    """References of a population: the best policy known for each partner. `str` returns a Markdown table.

    Attributes:
        population: Population of the partners.
        sections: Best policies by the partner's name, for every condition.
    """

    population: Population
    sections: Mapping[Condition, Mapping[str, Reference]]

    def build_sections(self) -> list[str | ReportTable]:
        """Build a heading and a table with one row for each partner and condition."""
        rows: list[list[object]] = []
        for condition, section in self.sections.items():
            cells = f"{condition.dataset} {condition.setup} {condition.split}", condition.physics
            for partner, best in section.items():
                rows.append([partner, *cells, best.policy, f"{100 * best.mean:.1f}", len(condition.scenes)])
        table = ReportTable(["partner", "scenes", "physics", "best policy", "AS %", "n"], rows)
        return [f"Best policies known for the partners of {self.population.label}.", table]

    def find(self, condition: Condition, partner: str) -> Reference | None:
        """Return the best policy known for a partner, with its scores in a condition's scenes, or None if unknown."""
        found = []
        for known, section in self.sections.items():
            if partner in section and known.contains(condition):
                by_scene = dict(zip(known.scenes, section[partner].scores, strict=True))
                scores = tuple(by_scene[scene] for scene in condition.scenes)
                found.append(replace(section[partner], scores=scores))
        return max(found, key=lambda reference: reference.mean, default=None)

    def find_all(self, condition: Condition, partners: Sequence[str]) -> tuple[Reference, ...] | None:
        """Return the best policy known for each of the partners, see `find`; None if a partner has none."""
        found = [self.find(condition, partner) for partner in partners]
        return None if None in found else tuple(filter(None, found))

    def update(self, condition: Condition, partner: str, reference: Reference) -> "ReferenceTable":
        """Return a copy of the table that keeps, for a partner and condition, the reference with the larger mean AS."""
        section = dict(self.sections.get(condition, {}))
        known = section.get(partner)
        if known is None or reference.mean > known.mean:
            section[partner] = reference
        return ReferenceTable(self.population, {**self.sections, condition: dict(sorted(section.items()))})

    def to_json(self) -> str:
        """Return the content of a file of references, JSON text."""
        sections = []
        for condition, section in self.sections.items():
            rounded = {
                name: {**asdict(each), "scores": [round(score, _DIGITS) for score in each.scores]}
                for name, each in section.items()
            }
            sections.append({**asdict(condition), "partners": rounded})
        return json.dumps({"population_hash": self.population.content_hash, "sections": sections}, indent=1) + "\n"


def load_references(
    population: Population, path: str | os.PathLike[str] | None = None, is_new: bool = False
) -> ReferenceTable:
    """Load the references of a population; return an empty table if there is no file.

    Args:
        population: Population of the partners.
        path: File of references; default: the one that is stored beside the population.
        is_new: Whether a given file may be missing, because it is going to be written.

    Raises:
        DataNotFoundError: The given file does not exist, or cannot be read.
        DataFormatError: The file is malformed, or belongs to another population.
    """
    chosen = population.references_path if path is None else check_path("references", path)
    if not chosen.is_file():
        if path is None or is_new:
            return ReferenceTable(population, {})
        raise DataNotFoundError(
            f"references must be a file that handover-marl strangers-references wrote, got {chosen}"
        )
    try:
        content = json.loads(read_plain_file(chosen, _MAX_BYTES))
        sections = dict(_parse_section(section) for section in content["sections"])
        stored = content["population_hash"]
    except OSError as error:
        raise DataNotFoundError(f"references {chosen} cannot be read ({error.strerror or error})") from error
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise DataFormatError(f"{chosen}: not a readable file of references ({shorten_text(error)})") from error
    if stored != population.content_hash:
        raise DataFormatError(
            f"{chosen}: references must be of population {population.content_hash}, got {shorten_text(stored)}; make "
            "them again with handover-marl strangers-references"
        )
    return ReferenceTable(population, sections)


def _parse_section(section: Mapping[str, Any]) -> tuple[Condition, dict[str, Reference]]:
    condition = Condition(
        **{name: str(section[name]) for name in _TEXTS},
        scenes=tuple(map(int, section["scenes"])),
        data=tuple(map(str, section["data"])),
    )
    partners = {
        name: Reference(
            **{key: str(entry[key]) for key in ("policy", "version", "command")},
            scores=tuple(map(float, entry["scores"])),
        )
        for name, entry in section["partners"].items()
    }
    if {len(condition.data), *(len(each.scores) for each in partners.values())} - {len(condition.scenes)}:
        raise ValueError("each partner must have one score for each scene, and each scene its data")
    return condition, partners
