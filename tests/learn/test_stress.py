"""Stress: what drawing takes back of the weight on what changes is that which dreams of the recording come out best with."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from terrella.learn.objectives import stress
from terrella.learn.objectives.stress import POWERS, USUAL, choose_stress

SIZE = (4, 4)
ROWS = 100  # of an episode


class World:
    """Its frames show the row that its state has come to, off by how far its codec's stress is from `right`."""

    config = spec = None

    def __init__(self, codec, right: float | None):
        self.codec, self.right = codec, right

    def observe(self, rows, prior, rng):
        assert prior is None or (prior == rows).all()
        return rows

    def imagine(self, state, action, rng):
        assert (action == state).all(), "the action that led from this row to the next"
        return state + 1

    def render(self, state, channels):
        off = 0.0 if self.right is None else 3 * float((self.codec.stress.log() - np.log(self.right)).abs())
        seen = torch.from_numpy(state % ROWS).float() + off
        return {"rgb": seen[:, None, None, None].expand(-1, *SIZE, 3)}


def made(right: float | None) -> Any:
    codec = SimpleNamespace(stress=torch.tensor(3.0))
    return World(codec, right), codec


def recording(episodes: int, rows: int = ROWS) -> Any:
    """Pictures of row t of an episode are of the brightness t."""
    count = episodes * rows
    return SimpleNamespace(
        usable=np.ones(count, bool),
        start=np.repeat(np.arange(episodes) * rows, rows),
        cache=SimpleNamespace(action_valid=np.ones(count, bool), done=None),
        evidence=lambda config, rows: rows,
        recorded_actions=lambda spec, rows: rows,
        rgb=lambda rows: torch.from_numpy(rows % ROWS).float()[:, None, None, None].expand(-1, 3, *SIZE),
    )


@pytest.mark.parametrize("power", POWERS)
def test_the_power_whose_dreams_come_nearest_is_found(power):
    world, codec = made(9.0**power)
    assert choose_stress(world, codec, recording(3), 9.0, 0) == power
    assert codec.stress == pytest.approx(9.0**power)


def test_of_powers_that_are_alike_the_smallest_is_taken():
    world, codec = made(None)
    assert choose_stress(world, codec, recording(3), 9.0, 0) == POWERS[0]


class Sleepy(World):
    """Its pictures change at every second step alone, but with the smallest stress, where they are `right` dB further off."""

    def render(self, state, channels):
        smallest = bool(self.codec.stress < 9.0 ** (POWERS[0] + 0.1))
        off = 10 * 10 ** ((self.right or 0) * smallest / 20) + (0 if smallest else 0.3) * torch.from_numpy(
            1 - state % 2 * 2
        )
        seen = torch.from_numpy(state % ROWS).float() + off
        return {"rgb": seen[:, None, None, None].expand(-1, *SIZE, 3)}


@pytest.mark.parametrize(("db", "power"), [(0.3, POWERS[0]), (0.8, POWERS[1])])
def test_half_a_decibel_is_not_worth_a_world_that_stands_still(db, power, monkeypatch):
    monkeypatch.setattr(stress, "CHANGED", 0.5)
    codec: Any = SimpleNamespace(stress=torch.tensor(3.0))
    world: Any = Sleepy(codec, db)
    assert choose_stress(world, codec, recording(3), 9.0, 0) == power


@pytest.mark.parametrize(("rows", "weight"), [(6, 9.0), (ROWS, 1.2)])
def test_where_nothing_can_be_told_it_is_the_usual_one(rows, weight):
    world, codec = made(1.0)
    assert choose_stress(world, codec, recording(3, rows), weight, 0) == USUAL
    assert codec.stress == pytest.approx(weight**USUAL)


def test_one_long_episode_among_short_ones_does_not_decide(monkeypatch):
    found = recording(20, 20)
    found.start = np.concatenate([np.repeat(np.arange(19) * 20, 20), np.full(41, 380)])
    found.usable, found.cache.action_valid = np.ones(421, bool), np.ones(421, bool)
    asked: list[np.ndarray] = []
    found.evidence = lambda config, rows: asked.append(rows) or rows
    monkeypatch.setattr(stress, "SHOWN", 4)
    world, codec = made(9.0)
    choose_stress(world, codec, found, 9.0, 0)
    assert len(np.unique(asked[0])) == stress.CLIPS and (asked[0] < 380).sum() > stress.CLIPS // 2
