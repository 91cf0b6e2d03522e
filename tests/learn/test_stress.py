"""Stress: what drawing takes back of the weight on what changes is that which dreams of the recording come out best with."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from terrella.learn.objectives import stress
from terrella.learn.objectives.stress import POWERS, USUAL, balanced

SIZE = (4, 4)


def codec() -> Any:
    return SimpleNamespace(stress=torch.tensor(3.0))


class Drawn:
    """A world whose frames are off by how far its codec's stress is from `right`."""

    config = spec = None

    def __init__(self, codec, right: float):
        self.codec, self.right = codec, right

    def observe(self, seen, prior, rng):
        return 0

    def imagine(self, state, action, rng):
        return state + 1

    def render(self, state, channels):
        off = 10 * (self.codec.stress.log() - np.log(self.right)).abs() + 1
        return {"rgb": off.expand(stress.CLIPS, *SIZE, 3)}


def drawn(made: Any, right: float) -> Any:
    return Drawn(made, right)


def recording(rows: int) -> Any:
    still = torch.zeros(stress.CLIPS, 3, *SIZE, dtype=torch.uint8)
    return SimpleNamespace(
        usable=np.ones(rows, bool),
        start=np.zeros(rows, np.int64),
        cache=SimpleNamespace(action_valid=np.ones(rows, bool), done=None),
        evidence=lambda config, rows: {},
        played=lambda spec, rows: None,
        rgb=lambda rows: still,
    )


@pytest.mark.parametrize("power", POWERS)
def test_the_power_whose_dreams_come_nearest_is_found(power):
    made = codec()
    assert balanced(drawn(made, 9.0**power), made, recording(200), 9.0, 0) == power
    assert made.stress == pytest.approx(9.0**power)


def test_of_powers_that_are_alike_the_smallest_is_taken():
    made = codec()
    world = drawn(made, 9.0)
    world.render = lambda state, channels: {"rgb": torch.ones(stress.CLIPS, *SIZE, 3)}
    assert balanced(world, made, recording(200), 9.0, 0) == POWERS[0]


@pytest.mark.parametrize(("rows", "weight"), [(6, 9.0), (200, 1.0)])
def test_where_nothing_can_be_told_it_stays_as_it_is(rows, weight):
    made = codec()
    assert balanced(drawn(made, 1.0), made, recording(rows), weight, 0) == USUAL
    assert made.stress == 3
