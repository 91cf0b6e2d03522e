"""The explorer reaches every room, uses every button and the same seed walks the same way."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from gymnasium import spaces

from terrella.act import Explorer
from terrella.core import Camera, Spec, make_rng
from terrella.space.camera import planar_pose

from ..data.corridor import CELL_M, WALLS, Corridor


def _walk(seed: int, steps: int):
    world, rng = Corridor(), make_rng(seed)
    explorer = Explorer(world.spec)
    state, places, actions = world.start(1, rng), [], []
    memory = explorer.begin(1, rng)
    for _ in range(steps):
        action, memory = explorer.act(world.render(state, ("depth", "pose")), memory, rng)
        state = world.imagine(state, world.spec.check_action(action, 1), rng)
        places.append(state["where"][0, :2].numpy())
        actions.append(action[0].numpy())
    return np.stack(places), np.stack(actions)


@pytest.mark.slow
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


def test_it_fights_what_stands_in_sight_and_at_times_beside_the_mark():
    """A thing 3 m off, which the player may turn to and away from: where it is when the trigger is pressed."""
    legs = ("MOVE_FORWARD", "MOVE_BACKWARD", "MOVE_LEFT", "MOVE_RIGHT", "TURN_LEFT", "TURN_RIGHT", "ATTACK")
    seen = {name: spaces.Box(0, 100, (24, 64)) for name in ("depth", "things")} | {"pose": spaces.Box(-9, 9, (7,))}
    spec = Spec(
        "range",
        spaces.MultiBinary(7),
        seen,
        (),
        0.03,
        action_names=legs,
        cameras={"rgb": Camera((0.5, 0.8, 0.5, 0.5), (24, 64))},
    )
    bearing = -torch.atan(((torch.arange(64) + 0.5) / 64 - 0.5) / 0.5)
    explorer, rng, yaw, off = Explorer(spec), make_rng(0), torch.zeros(1), []
    memory = explorer.begin(1, rng)
    for _ in range(4000):
        there = (bearing + yaw).abs() < 0.1  # it stands along x
        depth = torch.where(there, 3.0, 8.0).expand(1, 24, 64)
        nothing = torch.zeros(1)
        pose = planar_pose(nothing, nothing, nothing, yaw)
        seen = {"depth": depth, "things": there.expand(1, 24, 64), "pose": pose}
        (action,), memory = explorer.act(seen, memory, rng)
        if action[6]:
            off.append(float(yaw))
        yaw = torch.atan2((yaw + 0.05 * (action[4] - action[5])).sin(), (yaw + 0.05 * (action[4] - action[5])).cos())
    off = np.abs(off)
    assert len(off) > 200 and off.max() < 0.7  # in sight, always
    assert 0.4 < (off < 0.2).mean() < 0.8
