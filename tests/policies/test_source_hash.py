import sys
from pathlib import Path
from types import ModuleType

import pytest

from handover_marl.policies.source_hash import source_hash
from handover_marl.receivers import Receiver


def test_stubs_that_only_look_like_packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stub = ModuleType("stub_package")
    stub.__path__ = 0  # type: ignore[assignment]
    monkeypatch.setitem(sys.modules, "stub_package", stub)
    (tmp_path / "with_a_stub.py").write_text(
        "from stub_package import part\n"
        "from handover_marl.receivers import Receiver\n"
        "class Mine(Receiver):\n    name = 'mine'\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    stub.part = None  # type: ignore[attr-defined]
    from with_a_stub import Mine  # type: ignore[import-not-found]

    assert issubclass(Mine, Receiver)
    assert len(source_hash(Mine)) == 8
