"""Preparation of LeRobot, which `make lerobot` installs."""

import functools
import os

import pytest


@functools.cache
def prepare_lerobot() -> None:
    """Skip tests without LeRobot; declare operators that torchvision's wheel lacks if PyTorch has no CUDA."""
    pytest.importorskip("lerobot")
    import torch

    assert os.environ.get("HF_HUB_OFFLINE"), "nothing is to be downloaded"
    if torch.version.cuda is None:
        for name in ("nms", "qnms"):
            torch.library.define(f"torchvision::{name}", "(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
