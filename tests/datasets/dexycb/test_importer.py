"""Tests of the whole import, with one subject of a hundred short invented recordings."""

import shutil
from pathlib import Path

import pytest

from handover_marl.cli import main
from handover_marl.datasets import OfficialDataset
from handover_marl.datasets.dexycb.importer import import_dexycb
from handover_marl.datasets.official_files import list_required_files
from handover_marl.errors import DataNotFoundError, OptionError, ResultsError, SceneError, UnsafeFileError
from handover_marl.geometry.ycb import SUBJECTS
from tests.datasets.dexycb.mano_files import made_up_hand, official, write
from tests.datasets.dexycb.raw_files import RawScene, all_files, mano_file, write_yaml

SCENES = (300, 301, 399)


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with `dex-ycb/`, which has only the fourth subject, and with `mano/models/`."""
    folder = tmp_path_factory.mktemp("given")
    for rank in range(100):
        side = "left" if rank % 2 else "right"
        RawScene(subject=3, name=f"20200903_{100000 + rank}", side=side).write(folder / "dex-ycb")
    (folder / "mano/models").mkdir(parents=True)
    for side in ("RIGHT", "LEFT"):
        write(folder / "mano/models" / f"MANO_{side}.pkl", official(made_up_hand(len(side))))
    return folder


@pytest.mark.slow
def test_incomplete_data_keep_their_scene_numbers(given: Path, tmp_path: Path) -> None:
    found = import_dexycb(given / "dex-ycb", given / "mano", tmp_path, scenes=SCENES, workers=2, progress=False)
    assert found.scenes == SCENES
    assert found.hands == (f"{SUBJECTS[3]}_right", f"{SUBJECTS[3]}_left")
    assert len(found.faults) == 9, "subjects that are not there"
    assert set(found.missing_files) == set(list_required_files())
    assert not found.is_complete
    assert "assets-3rd-party" in str(found)
    dataset = OfficialDataset(tmp_path)
    info = dataset.load_info(301)
    assert (info.name, info.side, info.object_ids) == (f"{SUBJECTS[3]}/20200903_100001", "left", (5, 2))
    before = all_files(tmp_path)
    assert {"assets/table/table.urdf", "assets/003_cracker_box/model_normalized.urdf"} <= set(before)
    # A second import, with one process, restores removed files and changes no other.
    (tmp_path / "dex-ycb-cache/meta_301.json").unlink()
    shutil.rmtree(tmp_path / "assets" / f"{SUBJECTS[3]}_left")
    again = import_dexycb(given / "dex-ycb", given / "mano", tmp_path, scenes=SCENES, workers=1, progress=False)
    assert again.scenes == SCENES
    assert all_files(tmp_path) == before


def test_models_of_other_data_are_kept(given: Path, tmp_path: Path) -> None:
    options = {"scenes": (300,), "workers": 1, "progress": False}
    import_dexycb(given / "dex-ycb", given / "mano", tmp_path / "out", **options)  # type: ignore[arg-type]
    before = all_files(tmp_path / "out")
    raw = tmp_path / "dex-ycb"
    shutil.copytree(given / "dex-ycb", raw)
    for side in ("right", "left"):
        write_yaml(mano_file(raw, f"20200709_140042_{SUBJECTS[3][9:]}_{side}"), {"betas": [0.3] * 10})
    with pytest.raises(ResultsError, match="exists with other content"):
        import_dexycb(raw, given / "mano", tmp_path / "out", **options)  # type: ignore[arg-type]
    assert all_files(tmp_path / "out") == before


def test_invalid_arguments(given: Path, tmp_path: Path) -> None:
    raw, mano, out = given / "dex-ycb", given / "mano", tmp_path / "out"
    with pytest.raises(DataNotFoundError, match="no raw DexYCB folder"):
        import_dexycb(tmp_path, mano, out)
    with pytest.raises(DataNotFoundError, match=r"holds no MANO_RIGHT\.pkl"):
        import_dexycb(raw, tmp_path, out)
    with pytest.raises(SceneError, match="scene 1000 is not in DexYCB"):
        import_dexycb(raw, mano, out, scenes=[1000])
    with pytest.raises(OptionError, match=r"workers must be .* got 0"):
        import_dexycb(raw, mano, out, workers=0)
    with pytest.raises(SceneError, match="scenes must be scene numbers"):
        import_dexycb(raw, mano, out, scenes=[300.5])  # type: ignore[list-item]
    with pytest.raises(OptionError, match="dexycb must be a path"):
        import_dexycb("", mano, out)
    hostile = tmp_path / "mano"
    shutil.copytree(mano / "models", hostile)
    (hostile / "MANO_LEFT.pkl").write_bytes(b"cos\nsystem\n(S'touch /tmp/no'\ntR.")
    with pytest.raises(UnsafeFileError, match=r"MANO_LEFT\.pkl"):
        import_dexycb(raw, hostile, out)
    assert not out.exists()


def test_command(given: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folders = ["--dexycb", str(given / "dex-ycb"), "--mano", str(given / "mano"), "--out", str(tmp_path / "out")]
    assert main(["import", *folders, "--scenes", "300,301", "--workers", "1", "--no-progress"]) == 0
    assert "2 scenes, 2 hands" in capsys.readouterr().out
    assert main(["import", *folders, "--scenes", "999", "--workers", "1", "--no-progress"]) == 1
    assert "0 scenes" in capsys.readouterr().out
