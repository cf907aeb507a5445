import pickle
from typing import Any

import pytest

from handover_marl.datasets.restricted_pickle import (
    AllowedClass,
    AllowedFunction,
    AllowedNames,
    PickledRecord,
    load_restricted,
)
from handover_marl.errors import UnsafeFileError

NAMES: AllowedNames = {("m", "f"): AllowedFunction(lambda *arguments: list(arguments)), ("m", "C"): AllowedClass("C")}
F, C = b"cm\nf\n", b"cm\nC\n"


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_plain_values_come_back(protocol: int) -> None:
    value: Any = {"a": [1, -70000, 2**40, 1.5, True, False, None, "\xe4", (), (1,), (1, 2), (1, 2, 3), (1, 2, 3, 4)]}
    value[1] = value["a"]
    if protocol >= 3:
        value |= {b"bytes": b"x" * 300, "array": bytearray(b"x")} if protocol == 5 else {b"bytes": b"x"}
    assert load_restricted(pickle.dumps(value, protocol=protocol), {}) == value


def test_sets_become_lists() -> None:
    assert load_restricted(pickle.dumps([{1}, frozenset({2})], protocol=4), {}) == [[1], [2]]


def test_functions_are_called_and_records_filled() -> None:
    assert load_restricted(F + b"(K\x01K\x02tR.", NAMES) == [1, 2]
    assert load_restricted(b"\x80\x04\x8c\x01m\x8c\x01f\x93)R.", NAMES) == []
    record = load_restricted(C + b")\x81}U\x09__class__Nsb.", NAMES)
    assert isinstance(record, PickledRecord)
    assert (record.kind, record.state) == ("C", {b"__class__": None})


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (C + b")R.", "AllowedClass is called"),
        (F + b"]R.", "AllowedFunction is called"),
        (F + b")\x81.", "no class, or with arguments"),
        (C + b"K\x01\x85\x81.", "no class, or with arguments"),
        (C + b"}b.", "AllowedClass has no state"),
        (F + b"}b.", "AllowedFunction has no state"),
        (b"}}b.", "dict has no state"),
        (C + b")\x81Nb.", "the state of C is no dict"),
        (b"})K\x01s.", "a key is tuple"),
        (b"}NK\x01s.", "a key is NoneType"),
        (b"]K\x01K\x01s.", "entries are set in list"),
        (b"}(K\x01u.", "entries are set in dict"),
        (b"}K\x01a.", "elements are added to dict"),
        (b"K\x01K\x02\x93.", "a name is no text"),
        (b"\x8a\x09" + b"\xff" * 8 + b"\x7f.", "too large"),
        (b"K\x01\x86.", "lacks its operands"),
        (b"NN.", "one value"),
        (b"(N.", "one value"),
        (b"N" * 10_000 + b".", "intricate"),
        (b"Np10000\n.", "intricate"),
    ],
)
def test_damaged_pickles_are_refused(data: bytes, message: str) -> None:
    with pytest.raises(pickle.UnpicklingError, match=message):
        load_restricted(data, NAMES)


@pytest.mark.parametrize(
    "data", [b"cm\ng\n.", b"cm.f\nf\n.", b"\x80\x04\x8c\x01m\x8c\x03f.x\x93.", b"K\x012.", b"K\x010."]
)
def test_unknown_names_and_operations_are_unsafe(data: bytes) -> None:
    with pytest.raises(UnsafeFileError, match=r"^(asks for m|uses the operation)"):
        load_restricted(data, NAMES)
