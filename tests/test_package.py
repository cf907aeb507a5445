import subprocess
import sys

import pytest

import handover_marl


def test_public_names_exist() -> None:
    for name in handover_marl.__all__:
        assert getattr(handover_marl, name) is not None
    with pytest.raises(AttributeError, match="nothing"):
        handover_marl.nothing  # noqa: B018


def test_import_is_light() -> None:
    heavy = "('torch', 'pybullet', 'scipy', 'stable_baselines3')"
    code = f"import sys, handover_marl; print([name for name in {heavy} if name in sys.modules])"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"
