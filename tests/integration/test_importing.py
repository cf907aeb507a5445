"""Raw DexYCB imported as HandoverSim's own scripts imported it, to the bit."""

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from handover_marl.datasets.importing.cache_writer import CACHE_FOLDER
from handover_marl.datasets.importing.mano_model import ManoModel, read_mano_model
from handover_marl.datasets.importing.raw_layout import RawLayout, find_sequences
from handover_marl.datasets.importing.scene_import import Betas, find_first_betas, import_scene
from handover_marl.models.ycb import SUBJECTS


@pytest.fixture(scope="module")
def layout(raw_dexycb: Path) -> RawLayout:
    return find_sequences(raw_dexycb / "raw" / "dex-ycb")


@pytest.fixture(scope="module")
def first_betas(layout: RawLayout) -> Betas:
    return find_first_betas(layout.sequences)


@pytest.fixture(scope="module")
def models(raw_dexycb: Path) -> dict[str, ManoModel]:
    folder = raw_dexycb / "raw" / "mano_v1_2" / "models"
    return {side: read_mano_model(folder / f"MANO_{side.upper()}.pkl", side) for side in ("right", "left")}


@pytest.fixture(scope="module")
def checksums(raw_dexycb: Path) -> dict[str, Any]:
    scenes: dict[str, Any] = json.loads((raw_dexycb / "expected" / "checksums.json").read_text())["scenes"]
    return scenes


def described(cache: Path, scene_id: int) -> dict[str, Any]:
    """A scene's files as the checksums describe them."""
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


def test_nothing_is_missing(layout: RawLayout) -> None:
    assert [sequence.scene_id for sequence in layout.sequences] == list(range(1000))
    assert layout.missing == layout.ignored == ()


@pytest.mark.slow
@pytest.mark.parametrize("subject", range(len(SUBJECTS)))
def test_scenes_equal_the_original(
    subject: int,
    layout: RawLayout,
    first_betas: Betas,
    models: dict[str, ManoModel],
    checksums: dict[str, Any],
    tmp_path: Path,
) -> None:
    sequences = [sequence for sequence in layout.sequences if sequence.subject == SUBJECTS[subject]]
    assert len(sequences) == 100
    different = []
    for sequence in sequences:
        import_scene(sequence, models, first_betas, tmp_path)
        if described(tmp_path / CACHE_FOLDER, sequence.scene_id) != checksums[f"{sequence.scene_id:03d}"]:
            different.append(sequence.scene_id)
    assert different == []
