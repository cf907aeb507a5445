"""Tests of PyTorch's settings in computations of the library."""

import contextlib
from typing import Any

import pytest

from handover_marl.geometry.arrays import use_default_torch_settings


def test_products_have_full_precision() -> None:
    """Few processors and all GPUs compute less precisely; the switches are the same on all."""
    torch = pytest.importorskip("torch", reason="needs the extra `train`")
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("medium")
    with use_default_torch_settings():
        switches: Any = torch.backends
        assert switches.mkldnn.matmul.fp32_precision == switches.cuda.matmul.fp32_precision == "ieee"
    assert torch.get_float32_matmul_precision() == "medium"
    with contextlib.suppress(ZeroDivisionError), use_default_torch_settings():
        _ = 1 / 0
    assert torch.get_float32_matmul_precision() == "medium"
    torch.set_float32_matmul_precision(before)
