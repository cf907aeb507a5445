"""Tests of models made of raw DexYCB and MANO, which equal those of HandoverSim's scripts to the byte."""

import hashlib
import json
from pathlib import Path

import pytest
import yaml

from handover_marl.datasets.dexycb.assets import write_hand_assets, write_object_assets, write_table_assets
from handover_marl.datasets.dexycb.mano import SIDES, read_mano_model
from handover_marl.geometry.ycb import SUBJECTS


def first_betas(dex_ycb: Path, subject: str) -> list[float]:
    """Return the betas of a subject's first scene, which HandoverSim uses for both hands."""
    first = min((dex_ycb / subject).iterdir())
    calibration = yaml.safe_load((first / "meta.yml").read_text())["mano_calib"][0]
    betas: list[float] = yaml.safe_load((dex_ycb / f"calibration/mano_{calibration}/mano.yml").read_text())["betas"]
    return betas


@pytest.fixture(scope="module")
def written(raw_dexycb: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    assets = tmp_path_factory.mktemp("assets")
    models = raw_dexycb / "raw" / "mano_v1_2" / "models"
    for side in SIDES:
        model = read_mano_model(models / f"MANO_{side.upper()}.pkl", side)
        for subject in SUBJECTS:
            write_hand_assets(assets, subject, model, first_betas(raw_dexycb / "raw" / "dex-ycb", subject))
    write_object_assets(assets)
    write_table_assets(assets)
    return assets


def test_all_files_equal_to_the_byte(raw_dexycb: Path, written: Path) -> None:
    entries = json.loads((raw_dexycb / "expected" / "checksums.json").read_text())["assets"]
    expected = {name: entry["sha256"] for name, entry in entries.items()}
    found = {
        str(path.relative_to(written)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in written.rglob("*")
        if path.is_file()
    }
    assert len(expected) == 685
    assert sorted(found) == sorted(expected)
    assert [name for name in sorted(found) if found[name] != expected[name]] == []
    before = {path: path.stat().st_mtime_ns for path in written.rglob("*")}
    write_object_assets(written)
    write_table_assets(written)
    assert {path: path.stat().st_mtime_ns for path in written.rglob("*")} == before, "files that exist are kept"
