"""Tests of the import of raw DexYCB, which equals that of HandoverSim's own scripts bit for bit."""

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from handover_marl.datasets import OfficialDataset
from handover_marl.datasets.dexycb.importer import import_dexycb
from handover_marl.datasets.dexycb.mano import ManoModel, read_mano_model
from handover_marl.datasets.dexycb.scenes import (
    BetasBySubject,
    SequenceFolder,
    find_first_betas,
    find_sequences,
    import_scene,
)
from handover_marl.datasets.official import CACHE_FOLDER
from handover_marl.episode.episode import Episode
from handover_marl.geometry.ycb import SUBJECTS
from handover_marl.receivers import WAITING_JOINTS
from tests.evaluation import quick
from tests.helpers.equality import assert_equal


@pytest.fixture(scope="module")
def layout(raw_dexycb: Path) -> tuple[list[SequenceFolder], list[str]]:
    return find_sequences(raw_dexycb / "raw" / "dex-ycb")


@pytest.fixture(scope="module")
def first_betas(layout: tuple[list[SequenceFolder], list[str]]) -> BetasBySubject:
    return find_first_betas(layout[0])


@pytest.fixture(scope="module")
def models(raw_dexycb: Path) -> dict[str, ManoModel]:
    folder = raw_dexycb / "raw" / "mano_v1_2" / "models"
    return {side: read_mano_model(folder / f"MANO_{side.upper()}.pkl", side) for side in ("right", "left")}


@pytest.fixture(scope="module")
def checksums(raw_dexycb: Path) -> dict[str, Any]:
    scenes: dict[str, Any] = json.loads((raw_dexycb / "expected" / "checksums.json").read_text())["scenes"]
    return scenes


def described(cache: Path, scene_id: int) -> dict[str, Any]:
    """Return checksums, shapes and types of a scene's files, in the format of the expected checksums."""
    content: dict[str, Any] = {"meta": hashlib.sha256((cache / f"meta_{scene_id:03d}.json").read_bytes()).hexdigest()}
    with np.load(cache / f"pose_{scene_id:03d}.npz", allow_pickle=False) as archive:
        assert archive.files == ["pose_y", "pose_m"]
        for name in archive.files:
            array = archive[name]
            content[name] = {
                "shape": list(array.shape),
                "dtype": array.dtype.str,
                "sha256": hashlib.sha256(array.tobytes()).hexdigest(),
            }
    return content


def test_nothing_is_missing(layout: tuple[list[SequenceFolder], list[str]]) -> None:
    assert [sequence.scene_id for sequence in layout[0]] == list(range(1000))
    assert layout[1] == []


@pytest.mark.slow
@pytest.mark.parametrize("subject", range(len(SUBJECTS)))
def test_scenes_equal_the_original(
    subject: int,
    layout: tuple[list[SequenceFolder], list[str]],
    first_betas: BetasBySubject,
    models: dict[str, ManoModel],
    checksums: dict[str, Any],
    tmp_path: Path,
) -> None:
    sequences = [sequence for sequence in layout[0] if sequence.subject == SUBJECTS[subject]]
    assert len(sequences) == 100
    different = []
    # Every ninth scene is imported; those of the ten subjects together have all objects and trials.
    for sequence in sequences[subject % 9 :: 9]:
        import_scene(sequence, models, first_betas, tmp_path)
        if described(tmp_path / CACHE_FOLDER, sequence.scene_id) != checksums[f"{sequence.scene_id:03d}"]:
            different.append(sequence.scene_id)
    assert different == []


PLAYED = (5, 108, 146)


@pytest.fixture(scope="module")
def imported(raw_dexycb: Path, real_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a data folder that is imported from raw recordings and invented MANO files.

    The assets of the real data folder are its third-party files.
    """
    out = tmp_path_factory.mktemp("imported")
    found = import_dexycb(
        raw_dexycb / "raw" / "dex-ycb",
        raw_dexycb / "raw" / "mano_v1_2",
        out,
        third_party=real_data / "assets",
        scenes=PLAYED,
        workers=2,
        progress=False,
    )
    assert found.scenes == PLAYED
    assert len(found.hands) == 20
    assert (*found.faults, *found.missing_files, *found.stand_in_files) == (), str(found)
    return out


@pytest.mark.slow
@pytest.mark.parametrize("scene_id", PLAYED)
def test_a_hand_from_the_import_is_the_originals(
    imported: Path, several_objects: OfficialDataset, scene_id: int
) -> None:
    """Observations in imported scenes equal those in the folder of the original scripts bit for bit."""
    states = []
    for dataset in (OfficialDataset(imported), several_objects):
        episode = Episode("exact")
        episode.reset(dataset.load_scene(scene_id))
        episode.advance(np.array(WAITING_JOINTS, dtype=np.float32), 300)
        states.append(episode.observe())
        episode.close()
    assert_equal(*states)


@pytest.mark.slow
def test_imported_scenes_are_played(imported: Path) -> None:
    report = quick.run(imported, split="train", scenes=[5, 108])
    assert [episode.steps for episode in report.episodes] == [quick.HORIZON] * 2
    assert report.data_label == "DexYCB, 4 to 5 objects a scene, MANO hand"


@pytest.mark.slow
def test_models_equal_those_of_the_original_scripts_to_the_byte(imported: Path, raw_dexycb: Path) -> None:
    entries = json.loads((raw_dexycb / "expected" / "checksums.json").read_text())["assets"]
    assert len(entries) == 685
    sums = {name: hashlib.sha256((imported / "assets" / name).read_bytes()).hexdigest() for name in entries}
    assert sums == {name: entry["sha256"] for name, entry in entries.items()}
