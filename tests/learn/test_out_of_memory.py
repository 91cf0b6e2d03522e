"""A device that runs out of memory halves the batch, says so, and nothing that was learned is lost."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from terrella.core.errors import TrainingError
from terrella.learn.recipes.video import _Training


def training(fits: int) -> tuple[_Training, list[str]]:
    """A training with batches of 8 on a device on which batches of `fits` fit."""
    lines: list[str] = []
    made = object.__new__(_Training)
    made.batch = 8

    def train(draw, paced):
        if made.trainer.feed > fits:
            raise torch.cuda.OutOfMemoryError("CUDA out of memory")
        made.trainer.facts["step"] += 1

    made.trainer = SimpleNamespace(feed=8, facts={"step": 5}, share=0.5, train=train)
    made.recipe = SimpleNamespace(feed=lambda batch: batch)
    made.run = SimpleNamespace(device=torch.device("cuda"), report=lambda done, of, line: lines.append(line))
    made.paced = None
    return made, lines


def test_the_batch_is_halved_until_it_fits_and_training_goes_on():
    made, lines = training(fits=2)
    made._train_within_memory()
    assert made.trainer.facts == {"step": 6, "batch": 2} and made.trainer.feed == 2
    assert lines == [f"cuda ran out of memory: the batch is halved to {half}, and training goes on" for half in (4, 2)]


def test_a_device_too_small_for_one_clip_is_refused_with_a_way_out():
    made, _ = training(fits=0)
    with pytest.raises(TrainingError, match="too little memory for one clip; train smaller pictures .*--device cpu"):
        made._train_within_memory()
