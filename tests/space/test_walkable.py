"""Where a body can walk to: through doors and up steps, not through walls, over edges or under what is low."""

from __future__ import annotations

import torch

from terrella.space.occupancy import Occupancy, Walker
from terrella.space.solids import Solids
from terrella.space.walkable import CELL_M, walkable

FLOOR = [0.0, 0.0, -0.1, 8.0, 4.0, 0.0]
SIDES = [[-0.1, -0.1, 0, 0, 4.1, 3], [8, -0.1, 0, 8.1, 4.1, 3], [0, -0.1, 0, 8, 0, 3], [0, 4, 0, 8, 4.1, 3]]
WALL, WITH_DOOR = (
    [[4.0, 0, 0, 4.1, 4, 3]],
    [[4.0, 0, 0, 4.1, 1.5, 3], [4.0, 2.5, 0, 4.1, 4, 3], [4.0, 1.5, 2.1, 4.1, 2.5, 3]],
)
START, BODY = torch.tensor([[1.0, 2.0, 1.6]]), Walker()


def reached(boxes, most=1000):
    return walkable(Solids(torch.tensor([FLOOR, *SIDES, *boxes], dtype=torch.float32)), START, BODY, most)


def test_a_shut_wall_keeps_one_in_a_door_lets_one_through():
    assert reached(WALL)[:, 0].max() < 3.8
    found = reached(WITH_DOOR)
    assert found[:, 0].max() > 7 and len(found) == len(found[:, :2].unique(dim=0))
    assert (found[:, 2] - 1.6).abs().max() < 1e-4
    inside = (found[:, 0] > 3.75) & (found[:, 0] < 4.35)
    assert inside.any() and ((found[inside, 1] > 1.7) & (found[inside, 1] < 2.3)).all(), "through the door alone"
    apart = torch.cdist(found[:, :2], found[:, :2]) + 9 * torch.eye(len(found))
    assert (apart.amin(1) < CELL_M + 1e-3).all() and apart.min() > CELL_M - 1e-3


def test_steps_are_climbed_and_what_is_higher_or_has_no_floor_is_not():
    low, high = [[5.0, 0, 0, 8, 4, 0.4]], [[5.0, 0, 0, 8, 4, 0.8]]
    assert reached(low)[:, 2].max() > 1.95 and reached(high)[:, 0].max() < 5
    short = Solids(torch.tensor([[0.0, 0.0, -0.1, 3.0, 4.0, 0.0]]))
    found = walkable(short, START, BODY, 1000)
    assert len(found) > 20 and found[:, 0].max() < 3.2


def test_the_nearest_come_first_and_no_more_than_are_asked_for():
    found = reached(WITH_DOOR, most=9)
    assert len(found) == 9 and (found[:, :2] - START[:, :2]).norm(dim=1).max() < 1


def test_nothing_is_walkable_where_nobody_can_stand():
    walled = Solids(torch.tensor([FLOOR, [0.5, 1.5, 0, 1.5, 2.5, 3]], dtype=torch.float32))
    assert len(walkable(walled, START, BODY, 100)) == 0
    empty = Occupancy(torch.zeros(3), 0.1, torch.zeros(1, 1, 1, dtype=torch.bool), torch.zeros(1, 1, 1))
    assert len(walkable(empty, START, BODY, 100)) == 0
