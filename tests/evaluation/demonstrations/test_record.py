"""Tests of recordings: what they hold, exact replay, resuming, workers, selection of episodes and refused options."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import handover_marl
from handover_marl import Demonstrations
from handover_marl.cli import main
from handover_marl.config import OFFICIAL_CONFIG, WorldConfig
from handover_marl.datasets import open_dataset
from handover_marl.episode.episode import Episode
from handover_marl.episode.giver_motion import NO_DEVIATION
from handover_marl.episode.loop import derive_seed
from handover_marl.episode.observations import select_receiver_observation
from handover_marl.errors import OptionError
from tests.evaluation.demonstrations.recording import HORIZON, OPTIONS, SCENES, SHORT, MovingReceiver, record
from tests.helpers.equality import read_files
from tests.helpers.short_episodes import shorten_episodes

pytestmark = pytest.mark.slow


def test_damaged_and_missing_episodes_are_simulated_again(out: Path, tmp_path: Path, played: list[int]) -> None:
    """Data that are simulated again in this process equal those of the workers."""
    copy = shutil.copytree(out, tmp_path / "copy")
    path, whole = copy / "demonstrations" / "072.npz", read_files(out / "demonstrations")
    assert sorted(whole) == ["000.npz", "072.npz", "metadata.json"]
    # The last file is an undamaged recording of another scene.
    for damage in (None, whole["072.npz"][:-100], whole["000.npz"]):
        path.unlink() if damage is None else path.write_bytes(damage)
        played.clear()
        record(copy, **OPTIONS)
        assert played == [105]
        assert read_files(copy / "demonstrations") == whole


def test_recording_does_not_change_the_results(tmp_path: Path) -> None:
    """Results equal those of an evaluation without recording, although frames are observed between decisions."""
    options: dict[str, Any] = {"scenes": [5], "physics": "fast", "giver": "noisy"}
    record(tmp_path / "recorded", obs_mode="state+pointcloud", fps=20, **options)
    options |= {"receiver": MovingReceiver, "split": "train", "dataset": "synthetic", "world_config": SHORT}
    handover_marl.evaluate_pair(out=tmp_path / "plain", workers=1, progress=False, **options)
    with np.load(tmp_path / "plain" / "000.npz") as plain, np.load(tmp_path / "recorded" / "000.npz") as recorded:
        assert sorted(plain) == sorted(recorded)
        for key in set(plain) - {"elapsed_time"}:
            np.testing.assert_array_equal(plain[key], recorded[key], err_msg=key)


def test_frames_are_those_of_the_nearest_step(tmp_path: Path) -> None:
    """Frames at 30 per second, which fall between physics steps, equal those of a recording of every step."""
    options: dict[str, Any] = {"giver": "noisy", "scenes": SCENES[:1]}
    (decisions,), (frames,), (every,) = (record(tmp_path / str(fps), fps=fps, **options) for fps in (None, 30, 1000))
    nearest = np.rint(np.arange(18) * 1000.0 / 30).astype(int)
    np.testing.assert_array_equal(frames.steps, [*nearest, HORIZON])
    np.testing.assert_array_equal(every.steps, np.arange(HORIZON + 1))
    for name, array in frames.observations.items():
        np.testing.assert_array_equal(array, every.observations[name][frames.steps], err_msg=name)
        np.testing.assert_array_equal(decisions.observations[name], every.observations[name][decisions.steps])
    # The receiver's actions hold until its next decision, and so do the giver's.
    np.testing.assert_array_equal(every.actions, np.repeat(decisions.actions, np.diff(decisions.steps), axis=0))
    np.testing.assert_array_equal(frames.actions, every.actions[nearest])
    for demonstration in (frames, every):
        np.testing.assert_array_equal(demonstration.giver_actions, decisions.giver_actions)
    held = every.hold_giver_actions()
    np.testing.assert_array_equal(held[decisions.giver_steps], decisions.giver_actions)
    assert len(np.unique(held, axis=0)) == len(np.unique(decisions.giver_actions, axis=0)) > 3
    assert (decisions.metadata, decisions.truncations[-1]) == (frames.metadata, frames.truncations[-1])


def check_replay(demonstrations: Demonstrations, config: WorldConfig, obs_mode: str = "state") -> None:
    """Check that the actions of both agents, at their recorded steps, reproduce all observations and the outcome."""
    for demonstration in demonstrations:
        metadata = demonstration.metadata
        episode = Episode(metadata["physics"], config)
        data = open_dataset(metadata["dataset"], robot=metadata["robot"])
        episode.reset(data.load_scene(metadata["scene_id"]))
        episode.seed_camera(derive_seed(metadata["seed"], "camera"))
        robot = dict(zip(demonstration.steps.tolist(), demonstration.actions, strict=False))
        giver = dict(zip(demonstration.giver_steps.tolist(), demonstration.giver_actions, strict=True))
        times = sorted({*robot, *giver, metadata["steps"]})
        number, action, deviation = 0, np.zeros(9, dtype=np.float32), NO_DEVIATION
        for now, then in zip(times, [*times[1:], metadata["steps"]], strict=True):
            if now in robot or now == metadata["steps"]:
                seen = select_receiver_observation(episode.observe(), episode.observe_camera(obs_mode), obs_mode)
                assert demonstrations.observation_space.contains(seen)
                for name, array in demonstration.observations.items():
                    np.testing.assert_array_equal(array[number], seen[name], err_msg=f"{name} {number}", strict=True)
                number, action = number + 1, robot.get(now, action)
            deviation = giver.get(now, deviation)
            episode.advance(action, then - now, deviation)
        assert number == len(demonstration) + 1
        assert (int(episode.status), episode.steps) == (metadata["status"], metadata["steps"])
        assert (-1 if episode.release_step is None else episode.release_step) == metadata["release_step"]
        episode.close()


def test_both_agents_and_the_camera_are_replayed(out: Path) -> None:
    demonstrations = Demonstrations(out)
    for demonstration in demonstrations:
        assert len(np.unique(demonstration.giver_actions, axis=0)) > 3
        assert set(demonstration.giver_steps) != set(demonstration.steps[:-1])
        # Decisions are recorded at the receiver's own intervals; actions of the giver add none.
        holds = np.diff(demonstration.steps)
        assert len(set(holds)) > 3
        assert all(50 <= hold < 150 for hold in holds[:-1])
        assert demonstration.truncations.tolist() == [False] * (len(holds) - 1) + [True]
        assert not demonstration.terminations.any()
    check_replay(demonstrations, SHORT, "state+pointcloud")


def test_only_successes_and_then_all(tmp_path: Path, played: list[int]) -> None:
    """Episodes that `keep` excluded are simulated again only if a later recording includes them."""
    options: dict[str, Any] = {"receiver": "yang2021:wait=0", "world_config": OFFICIAL_CONFIG, "scenes": [5, 10]}
    some = record(tmp_path / "out", keep="success", **options)
    (success,) = some
    assert played == [5, 10]
    assert (success.metadata["outcome"], success.metadata["status"]) == ("success", 1)
    assert success.metadata["release_step"] > 0
    assert success.rewards.tolist() == [0.0] * (len(success) - 1) + [1.0]
    assert success.terminations.tolist() == [False] * (len(success) - 1) + [True]
    assert not success.truncations.any()
    assert success.giver_actions.shape == (0, 8)
    check_replay(some, OFFICIAL_CONFIG)
    assert "Simulated: 2 (" in str(some)
    before = read_files(tmp_path / "out" / "demonstrations")
    record(tmp_path / "out", keep="success", **options)
    assert len(played) == 2, "what is not kept is not played again"
    assert read_files(tmp_path / "out" / "demonstrations") == before
    every = record(tmp_path / "out", **options)
    assert played == [5, 10, 10]
    assert sorted(metadata["outcome"] == "success" for metadata in every.read_metadata()) == [False, True]
    record(tmp_path / "out", keep="success", **options)
    assert read_files(tmp_path / "out" / "demonstrations") == before


@pytest.mark.parametrize(
    ("error", "match", "options"),
    [
        (OptionError, "need an output folder", {"out": None}),
        (OptionError, "split must be 'train', got 'val'", {"split": "val"}),
        (OptionError, "fps must be an integer from 1 to 1000, got 29.97", {"fps": 29.97}),
    ],
)
def test_impossible_recordings_are_refused(
    tmp_path: Path, error: type[Exception], match: str, options: dict[str, Any]
) -> None:
    with pytest.raises(error, match=match):
        record(**{"out": tmp_path / "out", **options})
    assert not (tmp_path / "out").exists()


def test_the_command(
    fake_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    shorten_episodes(monkeypatch, 1000)
    command = ["demonstrate", "--receiver", "hold", "--physics", "fast", "--scenes", "5", "--data-dir", str(fake_data)]
    command += ["--fps", "2", "--out", str(tmp_path / "out"), "--no-progress", "--workers", "1"]
    assert main(command) == 0
    printed = capsys.readouterr()
    assert "1 episodes of hold, giver replay, dexycb, s0 train, fast physics; demonstrations, 2 fps" in printed.out
    assert f"Report: {tmp_path / 'out' / 'report.html'}" in printed.out
    assert not printed.err
    assert len(Demonstrations(tmp_path / "out")[0]) == 2
