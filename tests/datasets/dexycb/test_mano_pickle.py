import copyreg
import pickletools
import random
import subprocess
import sys
import tracemalloc
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from handover_marl.datasets.dexycb.mano import read_mano_model
from handover_marl.datasets.dexycb.mano_pickle import read_mano_pickle
from handover_marl.errors import DataFormatError, UnsafeFileError
from tests.datasets.dexycb.hostile_pickles import DAMAGED, EXHAUSTING, HOSTILE, UNSAFE
from tests.datasets.dexycb.mano_files import made_up_hand, official, write
from tests.evaluation.deadline import ends_within

# Python warns when it decodes invalid escape sequences, which random texts may have.
pytestmark = pytest.mark.filterwarnings("ignore:invalid (escape|octal):DeprecationWarning")

WHOLE = official(made_up_hand())
FUZZING = settings(max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture])


def read(folder: Path, data: bytes) -> None:
    read_mano_model(write(folder / "MANO_RIGHT.pkl", data), "right")


@pytest.mark.parametrize("what", HOSTILE)
def test_hostile_files_are_refused_quickly_with_little_memory(
    tmp_path: Path, what: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    tracemalloc.start()
    try:
        with ends_within(20), pytest.raises(DataFormatError, match=r"MANO_RIGHT\.pkl.*mano_v1_2\.zip") as caught:
            read(tmp_path, HOSTILE[what])
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert most < 10 * len(HOSTILE[what]) + 5_000_000
    assert isinstance(caught.value, UnsafeFileError) == (what in UNSAFE)
    assert len(str(caught.value)) < 600 + len(str(tmp_path))
    assert [path.name for path in tmp_path.iterdir()] == ["MANO_RIGHT.pkl"]


def test_hostile_files_import_run_and_open_nothing(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-m", "tests.datasets.dexycb.hostile_pickles", str(tmp_path)],
        cwd=Path(__file__).parents[3],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_registered_extensions_are_refused(tmp_path: Path) -> None:
    copyreg.add_extension("os", "getcwd", 1)
    try:
        with pytest.raises(UnsafeFileError, match=r"asks for os\.getcwd"):
            read(tmp_path, HOSTILE["extension 1"])
    finally:
        copyreg.remove_extension("os", "getcwd", 1)


@pytest.mark.parametrize("what", ["os.system", "eval by its name on the stack"])
def test_requested_names_are_reported(tmp_path: Path, what: str) -> None:
    with pytest.raises(UnsafeFileError, match=r"asks for (os\.system|builtins\.eval) and may run foreign code"):
        read(tmp_path, HOSTILE[what])


def test_messages_are_printable(tmp_path: Path) -> None:
    with pytest.raises(UnsafeFileError) as caught:
        read(tmp_path, b"\x80\x04\x8c\x08\x1b[31mos\n\x8c\x06system\x93.")
    assert str(caught.value).isprintable()


def test_other_keys_are_not_checked(tmp_path: Path) -> None:
    path = write(tmp_path / "MANO_RIGHT.pkl", b"\x80\x02}(U\x01aK\x01U\x01bccollections\nOrderedDict\n)Ru.")
    assert read_mano_pickle(path, ()) == {}
    with pytest.raises(DataFormatError, match="a is no array"):
        read_mano_pickle(path, ("a",))


def test_huge_files_are_not_read(tmp_path: Path) -> None:
    path = write(tmp_path / "MANO_RIGHT.pkl", b"\x80\x02")
    with path.open("r+b") as stream:
        stream.truncate(1 << 40)
    with ends_within(5), pytest.raises(DataFormatError, match="larger than 20 MB"):
        read_mano_model(path, "right")


def tried(folder: Path, data: bytes) -> None:
    """Read a file that may be damaged, and fail on any error that is not the library's own."""
    try:
        with ends_within(20):
            read(folder, data)
    except DataFormatError as error:
        assert "MANO_RIGHT.pkl" in str(error)  # noqa: PT017


@FUZZING
@given(data=st.binary(max_size=400))
def test_random_bytes(tmp_path: Path, data: bytes) -> None:
    tried(tmp_path, data)
    tried(tmp_path, b"\x80\x02" + data + b".")


OPERATIONS = [operation.code.encode("latin1") for operation in pickletools.opcodes]
# The keys of a dict may not be tuples that double: hashing them takes longer than the age of the universe.
SHORT = (entry for what, entry in EXHAUSTING.items() if len(entry) < 1_000 and "double" not in what)
ENTRIES = [*UNSAFE.values(), *DAMAGED.values(), *SHORT]
PIECES = st.one_of(st.sampled_from(OPERATIONS), st.sampled_from(ENTRIES), st.binary(max_size=6))


@FUZZING
@given(pieces=st.lists(PIECES, max_size=40))
def test_random_operations(tmp_path: Path, pieces: list[bytes]) -> None:
    tried(tmp_path, b"\x80\x02}U\x07weights" + b"".join(pieces) + b"s.")


def places(data: bytes) -> list[int]:
    """Return the positions in a pickle of the first 40 bytes of every operation.

    These are the operations and their short arguments, but hardly any contents of arrays.
    """
    starts = [position for _, _, position in pickletools.genops(data) if position is not None]
    ends = [*starts[1:], len(data)]
    return [place for start, end in zip(starts, ends, strict=True) for place in range(start, min(end, start + 40))]


PLACES = places(WHOLE)


@FUZZING
@given(seed=st.integers(0, 2**32), count=st.sampled_from([1, 1, 1, 2, 8]))
def test_changed_bytes(tmp_path: Path, seed: int, count: int) -> None:
    rng, spoilt = random.Random(seed), bytearray(WHOLE)
    for place in rng.sample(PLACES, count):
        spoilt[place] = rng.randrange(256)
    tried(tmp_path, bytes(spoilt))


@FUZZING
@given(seed=st.integers(0, 2**32))
def test_pieces_removed_repeated_or_swapped(tmp_path: Path, seed: int) -> None:
    rng = random.Random(seed)
    a, b, c = sorted(rng.sample(PLACES, 3))
    tried(tmp_path, WHOLE[:a] + WHOLE[b:])
    tried(tmp_path, WHOLE[:b] + WHOLE[a:])
    tried(tmp_path, WHOLE[:a] + WHOLE[b:c] + WHOLE[a:b] + WHOLE[c:])


@FUZZING
@given(length=st.integers(0, len(WHOLE) - 1))
def test_truncated_files(tmp_path: Path, length: int) -> None:
    with pytest.raises(DataFormatError, match=r"MANO_RIGHT\.pkl.*Copy it again"):
        read(tmp_path, WHOLE[:length])
