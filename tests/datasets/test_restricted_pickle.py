import pickle
from typing import Any

import pytest

from handover_marl.datasets.restricted_pickle import AllowedNames, PickledRecord, load_restricted
from handover_marl.errors import UnsafeFileError


class Record(PickledRecord):
    """Class that the pickles of these tests may create."""


NAMES: AllowedNames = {("m", "f"): lambda *arguments: list(arguments), ("m", "C"): Record}
F, C = b"cm\nf\n", b"cm\nC\n"


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_plain_values_come_back(protocol: int) -> None:
    value: Any = {"a": [1, -70000, 2**40, 1.5, True, False, None, "\xe4", (), (1,), (1, 2), (1, 2, 3), (1, 2, 3, 4)]}
    value[1] = value["a"]
    assert load_restricted(pickle.dumps(value, protocol=protocol), {}) == value


def test_functions_are_called_and_records_filled() -> None:
    assert load_restricted(F + b"(K\x01K\x02tR.", NAMES) == [1, 2]
    record = load_restricted(C + b")\x81}U\x09__class__Nsb.", NAMES)
    assert type(record) is Record
    assert record.state == {b"__class__": None}


@pytest.mark.parametrize("target", [F, C])
@pytest.mark.parametrize("state", [b"}U\x0c__defaults__K\x01s", b"N}U\x0c__defaults__K\x01s\x86"])
def test_allowed_names_cannot_be_changed(target: bytes, state: bytes) -> None:
    with pytest.raises(TypeError):
        load_restricted(target + state + b"b.", NAMES)


@pytest.mark.parametrize("data", [b"N" * 10_001 + b".", b"Np10000\n.", b"Nr\xff\xff\xff\x7f.", b"Np-1\n."])
def test_intricate_pickles_are_refused(data: bytes) -> None:
    with pytest.raises(pickle.UnpicklingError, match="intricate"):
        load_restricted(data, NAMES)


@pytest.mark.parametrize("data", [b"cm\ng\n.", b"cm.f\nf\n.", b"\x80\x04\x8c\x01m\x8c\x03f.x\x93.", b"cos\nsystem\n."])
def test_other_names_are_refused(data: bytes) -> None:
    with pytest.raises(UnsafeFileError, match=r"^asks for (m|os)"):
        load_restricted(data, NAMES)
