import functools
import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import handover_marl
from handover_marl.cli import main
from handover_marl.config import ProtocolConfig, WorldConfig
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.errors import OptionError, ResultsError
from handover_marl.evaluation import verification
from handover_marl.evaluation.benchmark import benchmark, evaluate_pair
from handover_marl.evaluation.config import EvaluationConfig, resolve_config
from handover_marl.evaluation.episode_runner import EpisodeRunner, SceneTask
from handover_marl.evaluation.metadata import ResultMetadata
from handover_marl.evaluation.reports.report import load_report, write_report
from handover_marl.evaluation.verification import (
    Difference,
    StoredActions,
    Verification,
    check_actions,
    check_episode,
    check_reports,
    compare_results,
    verify,
)
from tests.evaluation.quick import make_report, write_results

SCENE, INDEX = 9, 0
OPTIONS: dict[str, Any] = {"dataset": "synthetic", "physics": "fast", "workers": 1, "progress": False}
#: World of short episodes whose initial joint positions depend on the seed.
NOISY = WorldConfig(protocol=ProtocolConfig(horizon_steps=300), initial_joint_noise=0.1)
Arrays = dict[str, Any]


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("original")
    benchmark("s0", "val", "yang2021:wait=0", scenes=[SCENE], out=folder, **OPTIONS)
    return folder


@pytest.fixture
def folder(original: Path, tmp_path: Path) -> Path:
    return shutil.copytree(original, tmp_path / "copy")


@pytest.fixture(scope="module")
def runner() -> Iterator[EpisodeRunner]:
    short = WorldConfig(protocol=ProtocolConfig(horizon_steps=2000))  # the original episode is shorter
    named = {"dataset": "synthetic", "physics": "fast", "receiver": "hold", "world_config": short}
    config, _ = resolve_config(EvaluationConfig("s0", "val", (SCENE,), **named))
    made = EpisodeRunner(config, parallelism="")
    yield made
    made.close()


def change_arrays(folder: Path, change: Callable[[Arrays], object]) -> None:
    path = folder / "000.npz"
    with np.load(path) as archive:
        arrays = dict(archive)
    change(arrays)
    np.savez_compressed(path, **arrays)


def replaced(key: str, value: Any) -> Callable[[Arrays], object]:
    return lambda arrays: arrays.update({key: np.array(value)})


def shorten(arrays: Arrays) -> None:
    n = int(arrays["elapsed_frame"]) - 100
    arrays.update(action=arrays["action"][:n], elapsed_time=arrays["elapsed_time"][:n], elapsed_frame=np.int64(n))


ACTION_FORGERIES: dict[str, Callable[[Arrays], object]] = {
    "shortened": shorten,
    "open fingers": lambda arrays: arrays["action"].__setitem__((slice(None), slice(7, None)), 0.04),
    "one row less": lambda arrays: arrays.update(action=arrays["action"][:-1]),
    "not a number": lambda arrays: arrays["action"].__setitem__((50, 3), np.nan),
}


def describe(differences: list[Difference]) -> list[tuple[int | None, str, str, str]]:
    return [(each.scene_id, each.key, each.stored, each.expected) for each in differences]


def test_differences_are_named_by_their_values() -> None:
    """The outcome comes first; long texts are cut off; planning times and their machine are not compared."""
    result = make_report().episodes[0]
    assert result.fluency is not None
    fluency = replace(result.fluency, giver_path=2.0, reach=result.fluency.reach + 5e-7, gripper_jerk=1.5)
    fluency = replace(fluency, handover_time=0.250005)
    changed = replace(result, status=EpisodeStatus.TIMEOUT, steps=1, plan_s=9.0, machine="other", fluency=fluency)
    changed = replace(changed, models="x" * 61, fingerprint="y" * 60)
    found = describe(compare_results(changed, result, same_version=True))
    path = f"{result.fluency.giver_path:g}"
    expected = [
        (209, "outcome", "timeout", "success"),
        (209, "fluency.giver_path", "2", path),
        (209, "fluency.gripper_jerk", "1.5", "none"),
        (209, "fluency.handover_time", "0.250005", "0.25"),
        (209, "steps", "1", "4000"),
    ]
    versioned = [(209, "fingerprint", "y" * 60, "data"), (209, "models", "x" * 57 + "...", "MANO hands")]
    assert found == [expected[0], versioned[0], *expected[1:4], versioned[1], expected[4]]
    assert describe(compare_results(changed, result, same_version=False)) == expected
    unknown = replace(result, scene_id=None, models=None, fingerprint=None, n_objects=None, fluency=None)
    assert compare_results(unknown, result, same_version=True) == []
    assert len(compare_results(replace(unknown, scene_id=209), result, same_version=True)) > 3
    changed = replace(unknown, steps=1)
    assert describe(compare_results(changed, result, same_version=True)) == [(209, "steps", "1", "4000")]


def test_the_text_of_a_verification() -> None:
    metadata = ResultMetadata("s0", "val", "mine", "replay", "fast", "synthetic", "1.0")
    keys = ((9, "outcome"), (9, "steps"), (None, "giver_hash"))
    found = Verification(metadata, (9, 14), tuple(Difference(scene, key, "old", "new") for scene, key in keys))
    text = str(found)
    assert "receiver mine, giver replay, fast physics, handover_marl 1.0: 2 of 36 scenes simulated again" in text
    assert "Not equal: episodes 1 of 2, values of the folder 1." in text
    assert "The giver's code, or the way in which it was named, differs from that of the evaluation." in text
    assert (found.is_verified, found.changed_scenes) == (False, (9,))
    equal = Verification(replace(metadata, version=handover_marl.__version__), tuple(range(36)), (), 2)
    assert "Verified: all 36 episodes are equal." in str(equal)
    assert equal.is_verified


@pytest.mark.slow
def test_values_of_a_report_are_compared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert check_reports(write_results(tmp_path)) == ([], 0), "there is no report"
    write_report(tmp_path, load_report(tmp_path))
    path = tmp_path / "report.json"
    report = json.loads(path.read_text())

    def check(**changes: Any) -> tuple[list[tuple[int | None, str, str, str]], int]:
        path.write_text(json.dumps(report | changes))
        differences, n_unreported = check_reports(tmp_path)
        return describe(differences), n_unreported

    assert check(n_resumed=-1) == ([], 0), "another version wrote it"
    monkeypatch.setattr(verification, "__version__", "1.0")
    assert check() == ([], 0)
    one, two = report["episodes"]
    assert check(n_resumed=-1) == ([(None, "report.json.n_resumed", "-1", "0")], 0)
    forged = [one, two | {"steps": 1, "plan_s": 9.0}]
    expected = [(None, "report.json.episodes[1].plan_s", "9", f"{two['plan_s']:.6g}")]
    assert check(episodes=forged) == (expected, 0), "the first value that differs"
    assert check(n_resumed=3)[0][0] == (None, "report.json.n_resumed", "3", "2")
    assert not [each[1] for each in check(n_resumed=2)[0] if "report.json" in each[1]]
    for name in ("report.md", "report.html", "episodes.csv"):
        content = (tmp_path / name).read_bytes()
        (tmp_path / name).write_bytes(content + b" ")
        assert check()[0] == [(None, name, "other text", "the text of these results")]
        (tmp_path / name).write_bytes(content)
    path.write_text("{")
    assert describe(check_reports(tmp_path)[0])[0][1::2] == ("report.json", "a report")
    path.unlink()
    assert describe(check_reports(tmp_path)[0])[0][1::2] == ("report.json", "a report"), "the texts have none"
    assert check(episodes=[one])[1] == 1
    (tmp_path / "001.npz").write_bytes(b"no archive")
    assert [each[1] for each in check()[0]] == ["results"]
    (tmp_path / "001.npz").unlink()
    assert check() == ([(None, "001.npz", "no file", "a result of the report")], 0)


def test_stored_actions_are_played_until_the_next_different_one() -> None:
    actions = np.zeros((6, 9), dtype=np.float32)
    actions[2:, 0], actions[3:, 8] = 1.0, 0.5
    receiver = StoredActions(actions)
    for _ in range(2):
        played = [(*receiver.act({})[[0, 8]].tolist(), receiver.hold_time) for _ in range(3)]
        assert played == [(0.0, 0.0, pytest.approx(0.002)), (1.0, 0.0, pytest.approx(0.001)), (1.0, 0.5, np.inf)]
        receiver.reset()
    file = Path("000.npz")
    assert check_actions(file, actions.astype(float), 6).dtype == np.float32
    endless = np.full_like(actions, np.inf)
    for unfit, n_steps in ((actions, 5), (actions[:, :8], 6), (actions.astype(int), 6), (endless, 6)):
        with pytest.raises(ResultsError, match="action must be finite float32 of shape"):
            check_actions(file, unfit, n_steps)


@pytest.mark.slow
def test_what_was_compared_is_printed(folder: Path) -> None:
    path = folder / "config.yaml"
    path.write_text(path.read_text().replace(f"version: {handover_marl.__version__}", "version: 0.7.0"))
    # A copied result, of scene 24 by its name, is found.
    (folder / "003.npz").write_bytes((folder / "000.npz").read_bytes())
    before = {file.name: file.read_bytes() for file in folder.iterdir()}
    found = verify(folder, workers=1, progress=False)
    assert {file.name: file.read_bytes() for file in folder.iterdir()} == before
    assert (found.scenes, found.changed_scenes) == ((SCENE, 24), (24,))
    assert {each.key for each in found.differences if each.scene_id is None} == {"results"}, "no report or hash"


@pytest.mark.slow
@pytest.mark.parametrize("forgery", ACTION_FORGERIES)
def test_forged_actions_are_found(forgery: str, folder: Path, runner: EpisodeRunner) -> None:
    change_arrays(folder, ACTION_FORGERIES[forgery])
    assert check_episode(runner, folder, True, SceneTask(INDEX, SCENE))


@pytest.mark.slow
def test_a_changed_outcome_is_named(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    change_arrays(folder, replaced("result", np.int64(8)))
    assert main(["verify", str(folder), "--workers", "1", "--no-progress"]) == 1
    printed = capsys.readouterr().out
    assert f"| {SCENE} " in printed
    assert "timeout" in printed
    assert "Not equal: episodes 1 of 1," in printed
    rows = [line.split(" | ") for line in printed.splitlines() if line.startswith((f"| {SCENE} ", "| folder"))]
    assert rows[0][1].strip() == "outcome"
    assert sum("report.json" in row[1] for row in rows) == 1


@pytest.mark.slow
def test_values_of_a_giver_are_verified_with_its_code(tmp_path: Path) -> None:
    options = {**OPTIONS, "world_config": NOISY}
    evaluate_pair("hesitant", "hold", "s0", "val", scenes=[SCENE], out=tmp_path, **options)
    check = functools.partial(verify, tmp_path, workers=1, progress=False)
    assert check(world_config=NOISY).is_verified
    other = check(giver="replay", world_config=NOISY)
    assert {"giver", "giver_hash"} <= {each.key for each in other.differences if each.scene_id is None}
    assert "The giver's code, or the way in which it was named" in str(other)
    with pytest.raises(ResultsError, match="world_config"):
        check()


@pytest.mark.slow
def test_a_last_run_of_fewer_scenes(tmp_path: Path) -> None:
    options = {**OPTIONS, "world_config": NOISY, "out": tmp_path}
    evaluate_pair("replay", "hold", "s0", "val", scenes=[SCENE, 19], **options)
    evaluate_pair("replay", "hold", "s0", "val", scenes=[SCENE], **options)
    assert check_reports(tmp_path) == ([], 1)
    found = verify(tmp_path, workers=1, progress=False, world_config=NOISY)
    assert (found.is_verified, found.n_unreported, found.scenes) == (True, 1, (SCENE, 19))
    assert verify(tmp_path, workers=1, progress=False, world_config=NOISY, scenes=[19]).scenes == (19,)
    path = tmp_path / "config.yaml"
    text = path.read_text()
    for giver in ("wary", "learned:wary@1234"):
        path.write_text(text.replace("giver: replay", f"giver: {giver}"))
        with pytest.raises(OptionError, match=f"'{giver}', which is not registered; pass giver="):
            verify(tmp_path, workers=1, progress=False, world_config=NOISY)


@pytest.mark.slow
def test_another_seed_in_the_configuration_is_found(tmp_path: Path) -> None:
    evaluate_pair("replay", "hold", "s0", "val", scenes=[SCENE], out=tmp_path, world_config=NOISY, **OPTIONS)
    path = tmp_path / "config.yaml"
    path.write_text(path.read_text().replace("seed: '0'", "seed: '1'"))
    assert verify(tmp_path, workers=1, progress=False, world_config=NOISY).changed_scenes == (SCENE,)
