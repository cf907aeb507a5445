import contextlib
import os

# Tests run side by side, one per core; those of several worker processes name a number of workers. NumPy and
# PyTorch read their number of threads when they are imported.
for variable in ("LOKY_MAX_CPU_COUNT", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(variable, "1")
# Ray gives its workers a low priority by default, so that they would wait for the other tests.
os.environ.setdefault("RAY_worker_niceness", "0")

with contextlib.suppress(ImportError):
    import warp

    # Kernels are compiled in half the time.
    warp.config.optimization_level = 0

# ruff: noqa: E402
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

from handover_marl.datasets import DATA_DIR_VARIABLE, OfficialDataset
from tests.helpers.fake_layout import write_layout

# The time of an example depends on what else the machine does.
settings.register_profile("tests", deadline=None, max_examples=50)
settings.load_profile("tests")

#: Folder with recordings of the reference simulator (`scene*.npz`, `yang_s0_val.json`).
RECORDINGS_VARIABLE = "HANDOVER_MARL_RECORDINGS"

#: Folder in HandoverSim's layout with the scenes of several objects that `multi/*.npz` were recorded in.
SEVERAL_OBJECTS_VARIABLE = "HANDOVER_MARL_SEVERAL_OBJECTS"

#: Folder with a raw DexYCB, MANO and what HandoverSim's scripts made of them (`raw/`, `expected/checksums.json`).
RAW_DEXYCB_VARIABLE = "HANDOVER_MARL_RAW_DEXYCB"

#: Folders of the reference data by variable; None where a variable is not set.
REFERENCES = {
    variable: os.environ.get(variable)
    for variable in (DATA_DIR_VARIABLE, RECORDINGS_VARIABLE, SEVERAL_OBJECTS_VARIABLE, RAW_DEXYCB_VARIABLE)
}
RECORDINGS = REFERENCES[RECORDINGS_VARIABLE]


def require_reference(what: str, variable: str, content: str) -> Path:
    """Return the folder that an environment variable names; skip the test if it is not set."""
    folder = REFERENCES[variable]
    if not folder:
        pytest.skip(f"{what} MISSING: set {variable} to {content}")
    return Path(folder)


@pytest.fixture(autouse=True)
def _no_data_by_default(monkeypatch: pytest.MonkeyPatch) -> None:
    """Unset the variable of the data folder, so that no test depends on it."""
    monkeypatch.delenv(DATA_DIR_VARIABLE, raising=False)


@pytest.fixture(scope="session")
def fake_data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a small dataset in the official layout, which all tests share; do not write to it."""
    return write_layout(tmp_path_factory.mktemp("data") / "layout")


@pytest.fixture(scope="module")
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Let the tests of a module share a cache folder that is empty at first."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture
def own_data(tmp_path: Path) -> Path:
    """Return a copy of `fake_data` for one test, which may change it."""
    return write_layout(tmp_path / "layout")


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Return the folder with DexYCB in the official layout."""
    return require_reference("REAL DATA", DATA_DIR_VARIABLE, "a folder in HandoverSim's layout")


@pytest.fixture(scope="session")
def real_dataset(real_data: Path) -> OfficialDataset:
    return OfficialDataset(real_data)


@pytest.fixture(scope="session")
def several_objects() -> OfficialDataset:
    """Return the scenes with two to five objects in which the original simulator was recorded."""
    return OfficialDataset(require_reference("SCENES WITH SEVERAL OBJECTS", SEVERAL_OBJECTS_VARIABLE, "their folder"))


@pytest.fixture(scope="session")
def raw_dexycb() -> Path:
    """Return the folder of a raw DexYCB with MANO, and of the files that HandoverSim's scripts made of them."""
    return require_reference("RAW DEXYCB", RAW_DEXYCB_VARIABLE, "a folder with raw/ and expected/")


@pytest.fixture(scope="session")
def recordings(real_data: Path) -> Path:
    """Return the folder with recordings of the reference simulator."""
    return require_reference("REFERENCE RECORDINGS", RECORDINGS_VARIABLE, "their folder")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the files that have most slow tests, so that no core waits at the end."""
    n_slow = Counter(item.path for item in items if item.get_closest_marker("slow"))
    items.sort(key=lambda item: (-n_slow[item.path], item.path))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    missing = [variable for variable, folder in REFERENCES.items() if not folder]
    if missing:
        terminalreporter.write_sep("=", "NOT TESTED AGAINST THE REFERENCE", red=True, bold=True)
        terminalreporter.write_line(
            f"{' and '.join(missing)} not set: tests on real motion and on reference recordings were skipped."
        )
