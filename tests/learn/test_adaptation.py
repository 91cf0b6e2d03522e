"""Adaptation: reversed gradients, and an encoder that reads where a spot is off pictures of two looks."""

from __future__ import annotations

import pytest
import torch

from terrella.learn.feeds import RandomBatches
from terrella.learn.objectives.adaptation import Adaptation, KeypointEncoder, LabelledPictures, _reversed
from terrella.learn.trainer import Run, Trainer


def spots(count: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Pictures of a white spot on black, and where it is."""
    at = torch.randint(4, 28, (count, 2), generator=torch.Generator().manual_seed(seed))
    shown = torch.zeros(count, 32, 32, 3, dtype=torch.uint8)
    for picture, (row, column) in zip(shown, at.tolist()):
        picture[row - 1 : row + 2, column - 1 : column + 2] = 255
    return shown, at.float()


def test_gradients_are_turned_round():
    x = torch.tensor([1.0, -2.0], requires_grad=True)
    found = _reversed(x, 0.5)
    assert torch.equal(found, x)
    (3 * found).sum().backward()
    assert x.grad is not None and x.grad.tolist() == [-1.5, -1.5]


@pytest.mark.slow
def test_an_encoder_reads_where_a_spot_is(tmp_path):
    shown, at = spots(256, 0)
    torch.manual_seed(0)
    encoder = KeypointEncoder(2)
    encoder.settle(at)
    feed = RandomBatches(LabelledPictures(shown, at, 255 - shown[:32]).batch)
    Trainer(Run(tmp_path, {}, lambda *_: None, 0), "encoder", feed, Adaptation(encoder), 150).train()
    others, truth = spots(64, 1)
    with torch.inference_mode():
        away = (encoder(others) - truth).norm(dim=1).mean()
    assert away < 0.3 * (truth - at.mean(0)).norm(dim=1).mean()
