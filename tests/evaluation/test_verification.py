import functools
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import handover_marl
from handover_marl.cli import main
from handover_marl.config import ProtocolConfig, WorldConfig
from handover_marl.errors import OptionError, ResultsError
from handover_marl.evaluation.benchmark import benchmark, evaluate_pair
from handover_marl.evaluation.config import EvaluationConfig, resolve_config
from handover_marl.evaluation.episode_runner import EpisodeRunner, SceneTask
from handover_marl.evaluation.results import EpisodeResult, read_result
from handover_marl.evaluation.verification import (
    StoredActions,
    check_episode,
    check_reports,
    compare_results,
    verify,
)

SCENE, INDEX = 19, 2
OPTIONS: dict[str, Any] = {"dataset": "synthetic", "physics": "fast", "workers": 1, "progress": False}
#: World of short episodes whose initial joint positions depend on the seed.
NOISY = WorldConfig(protocol=ProtocolConfig(horizon_steps=300), initial_joint_noise=0.1)
Arrays = dict[str, Any]


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("original")
    benchmark("s0", "val", "yang2021", scenes=[SCENE], out=folder, **OPTIONS)
    return folder


@pytest.fixture
def folder(original: Path, tmp_path: Path) -> Path:
    return shutil.copytree(original, tmp_path / "copy")


@pytest.fixture(scope="module")
def runner() -> Iterator[EpisodeRunner]:
    config, _ = resolve_config(EvaluationConfig("s0", "val", (SCENE,), "synthetic", physics="fast", receiver="hold"))
    made = EpisodeRunner(config, parallelism="")
    yield made
    made.close()


@pytest.fixture(scope="module")
def simulated(original: Path, runner: EpisodeRunner) -> EpisodeResult:
    """Return the result of simulating the stored actions."""
    _, actions = read_result(original / "002.npz")
    return runner.run(SceneTask(INDEX, SCENE), StoredActions(actions))[0]


def change_arrays(folder: Path, change: Callable[[Arrays], object]) -> None:
    path = folder / "002.npz"
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
VALUE_FORGERIES: dict[str, Callable[[Arrays], object]] = {
    **{f"status {status}": replaced("result", np.int64(status)) for status in (2, 8)},
    "fewer steps": lambda arrays: arrays.update(elapsed_frame=arrays["elapsed_frame"] - 1),
    "no release": lambda arrays: arrays.pop("release_step"),
    "other scene": replaced("scene_id", 14),
    "other models": replaced("models", "MANO hands"),
    "other data": replaced("fingerprint", "0123456789abcdef"),
    "no fluency": lambda arrays: [arrays.pop(key) for key in list(arrays) if key.startswith("fluency_")],
    "longer path": lambda arrays: arrays.update(fluency_giver_path=arrays["fluency_giver_path"] * 1.001),
}


def edited(name: str, old: str, new: str) -> Callable[[Path], object]:
    return lambda folder: (folder / name).write_text((folder / name).read_text().replace(old, new))


REPORT_FORGERIES: dict[str, Callable[[Path], object]] = {
    "rate": edited("report.json", '"rate": 1.0', '"rate": 0.5'),
    "steps of an episode": edited("report.json", '"steps": ', '"steps": 1'),
    "no JSON": lambda folder: (folder / "report.json").write_text("{"),
    "an episode in CSV": edited("episodes.csv", "success", "contact"),
    "text": edited("report.md", "0.00", "0.01"),
    "text without a report": lambda folder: (folder / "report.json").unlink(),
    "web page": edited("report.html", "100.0", "99.0"),
}


@pytest.mark.slow
def test_what_was_compared_is_printed(folder: Path) -> None:
    before = {file.name: file.read_bytes() for file in folder.iterdir()}
    verification = verify(folder, workers=1, progress=False)
    text = str(verification)
    assert verification.is_verified, text
    assert verification.scenes == (SCENE,)
    assert "Verified: all 1 episodes are equal." in text
    assert "35 of 36 scenes of the split were not simulated." in text
    assert "Not compared" not in text
    assert {file.name: file.read_bytes() for file in folder.iterdir()} == before
    path = folder / "config.yaml"
    path.write_text(path.read_text().replace(f"version: {handover_marl.__version__}", "version: 0.7.0"))
    # A copied result, of scene 24 by its name, is found.
    (folder / "003.npz").write_bytes((folder / "002.npz").read_bytes())
    verification = verify(folder, workers=1, progress=False)
    assert "Not compared, because version 0.7.0 wrote them: reports and hashes." in str(verification)
    assert verification.changed_scenes == (24,)


@pytest.mark.slow
@pytest.mark.parametrize("forgery", ACTION_FORGERIES)
def test_forged_actions_are_found(forgery: str, folder: Path, runner: EpisodeRunner) -> None:
    change_arrays(folder, ACTION_FORGERIES[forgery])
    assert check_episode(runner, folder, True, SceneTask(INDEX, SCENE))


@pytest.mark.slow
def test_forged_values_are_found(folder: Path, simulated: EpisodeResult) -> None:
    path = folder / "002.npz"
    assert compare_results(read_result(path)[0], simulated, same_version=True) == []
    content = path.read_bytes()
    for name, forgery in VALUE_FORGERIES.items():
        path.write_bytes(content)
        change_arrays(folder, forgery)
        assert compare_results(read_result(path)[0], simulated, same_version=True), name


@pytest.mark.slow
@pytest.mark.parametrize("forgery", REPORT_FORGERIES)
def test_a_forged_report_is_found(forgery: str, folder: Path) -> None:
    assert check_reports(folder) == ([], 0)
    REPORT_FORGERIES[forgery](folder)
    assert check_reports(folder)[0]


@pytest.mark.slow
def test_a_changed_outcome_is_named(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    change_arrays(folder, replaced("result", np.int64(8)))
    assert main(["verify", str(folder), "--workers", "1", "--no-progress"]) == 1
    printed = capsys.readouterr().out
    assert f"| {SCENE} " in printed
    assert "timeout" in printed
    assert "Not equal: 1 of 1 episodes" in printed
    rows = [line.split(" | ") for line in printed.splitlines() if line.startswith(("| 19", "| folder"))]
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
    evaluate_pair("replay", "hold", "s0", "val", scenes=[9, SCENE], **options)
    evaluate_pair("replay", "hold", "s0", "val", scenes=[SCENE], **options)
    assert check_reports(tmp_path) == ([], 1)
    verification = verify(tmp_path, workers=1, progress=False, world_config=NOISY)
    assert verification.is_verified
    assert "1 results of the folder are not in its report" in str(verification)
    path = tmp_path / "config.yaml"
    path.write_text(path.read_text().replace("giver: replay", "giver: wary"))
    with pytest.raises(OptionError, match="'wary', which is not registered; pass giver="):
        verify(tmp_path, workers=1, progress=False, world_config=NOISY)


@pytest.mark.slow
def test_another_seed_in_the_configuration_is_found(tmp_path: Path) -> None:
    evaluate_pair("replay", "hold", "s0", "val", scenes=[SCENE], out=tmp_path, world_config=NOISY, **OPTIONS)
    path = tmp_path / "config.yaml"
    path.write_text(path.read_text().replace("seed: '0'", "seed: '1'"))
    assert verify(tmp_path, workers=1, progress=False, world_config=NOISY).changed_scenes == (SCENE,)
