"""The explorer reaches every room, uses every button and the same seed walks the same way."""

from __future__ import annotations

import numpy as np
import torch
from corridor import CELL_M, WALLS, Corridor
from gymnasium import spaces

from terrella.core import Spec, make_rng
from terrella.data import Explorer


def _walk(seed: int, steps: int):
    world, rng = Corridor(), make_rng(seed)
    explorer = Explorer(world.spec)
    state, places, actions = world.start(1, rng), [], []
    for step in range(steps):
        action = explorer(world.render(state, ("depth", "pose")), {"step": step}, rng)
        state = world.imagine(state, world.spec.check_action(action, 1), rng)
        places.append(state["where"][0, :2].numpy())
        actions.append(action[0].numpy())
    return np.stack(places), np.stack(actions)


def test_it_covers_a_maze_and_uses_every_button():
    visited, used = set(), np.zeros(6)
    for seed in range(6):
        places, actions = _walk(seed, 1000)
        visited |= {(int(y // CELL_M), int(x // CELL_M)) for x, y in places}
        used += actions.mean(0) / 6
    free = {(int(row), int(column)) for row, column in np.argwhere(~WALLS)}
    assert len(visited & free) >= 0.9 * len(free), sorted(free - visited)
    assert used.min() > 0.03, used


def test_actions_persist():
    _, actions = _walk(0, 1000)
    changes = (np.diff(actions, axis=0) != 0).any(1).mean()
    assert 0.03 < changes < 0.4


def test_the_same_seed_walks_the_same_way():
    one, two, other = _walk(1, 200), _walk(1, 200), _walk(2, 200)
    assert np.array_equal(one[1], two[1]) and np.array_equal(one[0], two[0])
    assert not np.array_equal(one[1], other[1])


def test_a_world_without_depth_gets_held_random_actions():
    spec = Spec("box", spaces.Box(-1, 1, (2,), np.float32), {"reward": spaces.Box(-1, 1, ())}, (), 0.1)
    explorer, rng = Explorer(spec), make_rng(0)
    actions = torch.cat([explorer({}, {"step": step}, rng) for step in range(300)])
    spec.check_action(actions, 300)
    runs = np.diff(np.flatnonzero((actions[1:] != actions[:-1]).any(1).numpy()))
    assert runs.min() >= 3 and runs.max() <= 40 and len(runs) > 5
