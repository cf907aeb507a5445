"""Tests of the training of the segmentation network of `vision`."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from handover_marl import receivers
from tests.learning.training.scripts import script

pytest.importorskip("embreex", reason="needs the extra `vision`")


@pytest.mark.slow
def test_a_training_writes_weights_and_resumes_with_its_images(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    train = script("train_segmentation", monkeypatch)
    args = train.Args(dataset="synthetic", out=tmp_path, views=1, stride=180, updates=1, batch_size=2, workers=1)
    args = replace(args, point_updates=2, point_batch_size=2)
    path = train.main(args)
    written, images = path.read_bytes(), sorted(tmp_path.glob("views/*.npz"))
    with np.load(images[0]) as views:
        assert views["rgb"].shape == (1, 224, 224, 3)
    times = [image.stat().st_mtime_ns for image in images]
    monkeypatch.setattr(train, "SegmentationLearner", None)  # the network for pixels is not trained again
    assert train.main(replace(args, resume=True)).read_bytes() == written
    assert [image.stat().st_mtime_ns for image in images] == times
    assert receivers.make(f"vision:masks={path}").weights_hash != receivers.make("vision").weights_hash
