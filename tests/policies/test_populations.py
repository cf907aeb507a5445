"""Tests of population files."""

import configparser
from pathlib import Path
from typing import Any

import pytest

from handover_marl import evaluate_pair
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.errors import DataFormatError, DataNotFoundError
from handover_marl.policies.populations import DEFAULT_POPULATION, list_populations, load_population
from handover_marl.policies.reference import parse_policy
from tests.evaluation.strangers.populations import GIVERS, RECEIVERS, write_population


def test_own_file(tmp_path: Path) -> None:
    found = load_population(write_population(tmp_path))
    assert found.label == f"small 1.0 ({found.content_hash})"
    assert [partner.name for partner in found.select("giver", "test")] == ["fast", "slow"]
    assert [partner.name for partner in found.select("giver", "all")] == ["recorded", "fast", "slow"]
    assert [partner.policy for partner in found.select("receiver", "test")] == ["hold"]
    assert found.references_path == tmp_path / "small.references.json"


def test_the_hash_covers_the_content_and_policy_files(tmp_path: Path) -> None:
    first = load_population(write_population(tmp_path)).content_hash
    assert load_population(write_population(tmp_path, version="1.1")).content_hash != first
    learned = GIVERS[0] | {"policy": "learned:{folder}/giver.npz"}
    path = write_population(tmp_path, givers=[learned])
    with pytest.raises(DataNotFoundError, match=r"giver\.npz cannot be read"):
        load_population(path)
    (tmp_path / "giver.npz").write_bytes(b"1")
    found = load_population(path)
    assert found.get_policy(found.givers[0]) == f"learned:{tmp_path}/giver.npz"


@pytest.mark.slow
@pytest.mark.parametrize(
    "policy",
    [
        "learned:{folder}/weights.pth",
        "vision:weights={folder}/weights.pth",
        "gaddpg:weights={folder}/weights.pth,wait=1",
        "gaddpg:weights={outside}/weights.pth",
        "not_installed.robots:MyReceiver:weights={folder}/weights.pth",
    ],
)
def test_the_hash_covers_the_files_that_policies_name(tmp_path: Path, policy: str) -> None:
    outside, inside = tmp_path / "outside", tmp_path / "inside"
    outside.mkdir()
    inside.mkdir()
    path = write_population(inside, receivers=[RECEIVERS[0] | {"policy": policy.replace("{outside}", str(outside))}])
    hashes = set()
    for content in (b"1", b"2"):
        for folder in (outside, inside):
            (folder / "weights.pth").write_bytes(content)
        hashes.add(load_population(path, trust=True).content_hash)
    assert len(hashes) == 2


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"givers": [GIVERS[0], GIVERS[0]]}, "every name must be unique, got 'recorded' twice"),
        ({"givers": [GIVERS[1], GIVERS[2] | {"split": "train"}]}, "family in one split must be unique, got 'timing'"),
        ({"givers": [GIVERS[0] | {"split": "val"}]}, "split must be train or test, got 'val'"),
        ({"givers": [{"name": "a"}]}, "not a readable population .*missing 4 required"),
        ({"name": "a\nb"}, "values must be text without control characters"),
    ],
)
def test_malformed_files(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(DataFormatError, match=message):
        load_population(write_population(tmp_path, **changes))


@pytest.mark.slow
def test_shipped_populations() -> None:
    """All partners of the default population can be parsed, and all givers made; train and test share no family."""
    assert DEFAULT_POPULATION in list_populations()
    dataset = SyntheticDataset()
    found = load_population(DEFAULT_POPULATION)
    # One version names one content: whoever changes the file or a policy file beside it raises the version.
    assert found.label == "strangers-v1 1.1 (55138fb9c728)"
    assert len(found.givers) >= 24
    assert len({giver.family for giver in found.givers}) >= 6
    for agent in ("giver", "receiver"):
        families = [{partner.family for partner in found.select(agent, split)} for split in ("train", "test")]
        assert not families[0] & families[1]
        references = [parse_policy(agent, found.get_policy(partner)) for partner in found.select(agent, "all")]
        if agent == "giver":
            labels = [reference.resolve(dataset).label for reference in references]
            assert len(set(labels)) == len(labels)


@pytest.mark.slow
def test_learned_givers_act_and_are_installed() -> None:
    found = load_population()
    learned = [giver for giver in found.givers if giver.family == "learned"]
    assert len(learned) == 3
    setup = configparser.ConfigParser()
    setup.read(Path(__file__).parents[2] / "setup.cfg")
    patterns = setup["options.package_data"]["handover_marl.assets"].split()
    motions = set()
    for giver in learned:
        policy = found.get_policy(giver)
        file = Path(policy.removeprefix("learned:"))
        assert any(file.match(pattern) for pattern in patterns)
        report = evaluate_pair(
            policy, "hold", dataset="synthetic", split="val", scenes=[9], physics="fast", progress=False
        )
        fluency = report.episodes[0].fluency
        assert fluency is not None
        motions.add(fluency.giver_path)
    assert len(motions) == 3
