"""Routes to a place: over known places round a wall, planned stretch by stretch, and a sentence where there is none."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from gymnasium import spaces

from terrella.act.planning import (
    Destination,
    FullyObserved,
    Navigator,
    Planner,
    SearchConfig,
    cost_discriminates,
    distance,
    distance_to,
    search_config_within,
)
from terrella.act.planning.routes import STRIDE_M, routes_to
from terrella.core import Spec, State, check_world
from terrella.core.errors import ContractError, ObservationError, PlanningError
from terrella.core.spec import POSE, WALKABLE
from terrella.core.world import make_rng

# A wall along x = 2 from y = -9 to y = 3, and places round its end.
KNOWN = np.array([[x, y, 0, 1] for x in range(5) for y in range(-1, 5) if x != 2 or y > 3], np.float64)


class Yard:
    """A body that goes 0.2 m a step to the sides, and a wall that stops it."""

    def __init__(self):
        self.spec = Spec(
            name="yard",
            action=spaces.Box(-1, 1, (2,), np.float32),
            channels={"pose": POSE, "places": spaces.Box(-np.inf, np.inf, (len(KNOWN) + 1, 4), np.float32)},
            observes=("pose",),
            dt_s=0.1,
        )

    def start(self, batch, rng):
        if batch < 1:
            raise ContractError("a yard holds one or more.")
        return State({"at": torch.zeros(batch, 2)})

    def observe(self, observation, prior, rng):
        if "pose" not in observation:
            raise ObservationError("a yard is told where one stands.")
        return State({"at": observation["pose"][:, :2]})

    def imagine(self, state, action, rng):
        before = state["at"]
        after = before + 0.2 * self.spec.check_action(action, state.batch)
        crossed = (before[:, 0] < 2) != (after[:, 0] < 2)
        return State({"at": torch.where((crossed & (after[:, 1] < 3))[:, None], before, after)})

    def render(self, state, channels):
        self.spec.check_channels(channels)
        zero = torch.zeros(state.batch, 1)
        shown = {"pose": lambda: torch.cat([state["at"], zero, zero + 1, zero, zero, zero], 1)}
        table = torch.cat([torch.from_numpy(KNOWN).float(), torch.zeros(1, 4)])
        shown["places"] = lambda: table.expand(state.batch, *table.shape)
        return {name: shown[name]() for name in channels}


def walk(place, steps=120, shown=("pose", "places")):
    world = FullyObserved(Yard())
    cost = distance_to(world, {"pose": torch.tensor([*place, *[torch.nan] * 5])})
    way = Navigator(Planner(world, cost, SearchConfig(samples=24, iterations=2, horizon=5)), place)
    rng = make_rng(0)
    state, memory, trace = world.start(1, rng), way.begin(1, rng), []
    for _ in range(steps):
        seen = world.render(state, (*world.spec.observes, *shown))
        trace.append(seen["pose"][0, :2].tolist())
        if math.dist(trace[-1], place) < 0.4:
            return trace
        action, memory = way.act(seen, memory, rng)
        state = world.imagine(state, action, rng)
    return trace


def test_the_yard_keeps_the_contract():
    check_world(Yard())


def test_ways_lead_round_the_wall_and_grow_shorter():
    goal = np.array([4.0, 0.0])
    ways = routes_to(goal, KNOWN)
    here = np.array([0.0, 0.0])
    target, left = ways.target(here, goal)
    assert target[1] > 0 and left > 2 * math.dist(here, goal), "not straight at the wall"
    for _ in range(40):
        if math.dist(here, goal) <= STRIDE_M:
            break
        target, further = ways.target(here, goal)
        assert further <= left + 1e-9 and not (here[0] < 2 < target[0] and target[1] < 3)
        here, left = target, further
    assert math.dist(here, goal) <= STRIDE_M


@pytest.mark.parametrize("shown", [("pose", "places"), ("pose",)], ids=["seen", "remembered"])
def test_a_walker_goes_round_a_wall_that_its_planner_does_not_see_past(shown):
    trace = walk((4.0, 0.0), shown=shown)
    assert math.dist(trace[-1], (4.0, 0.0)) < 0.4 and max(y for _, y in trace) > 2.9


def test_who_is_off_all_ways_goes_to_the_nearest_place_that_lies_on_one():
    alone = np.array([[-4.0, 0.0, 0, 1]])  # as the first place that a camera remembers of a room nobody was in
    target, left = routes_to(np.array([4.0, 0.0]), np.concatenate([KNOWN, alone])).target(
        alone[0, :2], np.array([4.0, 0.0])
    )
    assert target.tolist() == [0.0, 0.0] and math.isfinite(left)


def test_a_place_that_nobody_knows_is_refused_in_a_sentence():
    with pytest.raises(PlanningError, match="no route to that place is known"):
        walk((20.0, 20.0))
    assert not np.isfinite(routes_to(np.array([20.0, 20.0]), KNOWN).left_m).any()


def test_where_one_can_stand_ways_go_from_cell_to_cell_and_never_through_a_thin_wall():
    cells = np.array([[0.4 * x, 0.4 * y, 0, WALKABLE] for x in range(8) for y in range(8) if x not in (3, 4) or y == 7])
    cells[cells[:, 0] > 1.4, 0] -= 0.2  # as near to each other as bodies on both sides of a wall of ten centimetres are
    goal = cells[(cells[:, 0] > 1.4) & (cells[:, 1] == 0)][0, :2]
    ways = routes_to(goal, cells)
    here, trace = np.array([0.8, 0.0]), []
    assert math.dist(here, goal) < STRIDE_M
    while math.dist(here, goal) > 1e-6:
        target, left = ways.target(here, goal)
        assert left < 8 and math.dist(here, target) <= 0.9 + 1e-9
        here = target
        trace.append(target[1])
    assert max(trace) > 2.3, "round the end of the wall"


def test_a_place_that_could_not_be_walked_to_is_avoided():
    goal = np.array([4.0, 4.0])
    far = routes_to(goal, KNOWN, avoided=((1.0, 4.0),)).left_m - routes_to(goal, KNOWN).left_m
    assert (far >= -1e-9).all() and far.max() > 0.5


def test_a_search_is_paced_and_knows_whether_there_is_anything_to_plan_for():
    world = FullyObserved(Yard())
    state = world.start(1, make_rng(0))
    near = distance_to(world, {"pose": torch.tensor([1.0, 0.0, *[torch.nan] * 5])})
    config, fits = search_config_within(world, near, state, 1e4)
    assert fits and config.horizon == 16 and config.samples == 32
    config, fits = search_config_within(world, near, state, 1e-3)
    assert not fits and config.horizon == 4 and config.samples == 8
    assert cost_discriminates(world, near, state)
    same = distance_to(world, {"pose": torch.tensor([torch.nan, torch.nan, 0.0, *[torch.nan] * 4])})
    assert not cost_discriminates(world, same, state)


def test_both_quaternions_of_a_rotation_are_as_far_from_a_goal():
    def turned(heading, sign=1.0):
        return torch.tensor([[0.0, 0.0, 0.0, sign * math.cos(heading / 2), 0.0, 0.0, sign * math.sin(heading / 2)]])

    for heading in (2.0, 3.1, 3.3, 4.0):  # a barrier at half a turn would keep a planner from turning on
        for sign in (1, -1):
            away = float(distance(Yard().spec, {"pose": turned(3.0)}, {"pose": turned(heading, sign)}))
            assert away == pytest.approx(abs(math.sin((heading - 3.0) / 4)) * 2 / math.sqrt(7), abs=1e-3)


def test_a_destination_is_reached_near_it_and_facing_as_it_does():
    turned = lambda heading: [math.cos(heading / 2), 0.0, 0.0, math.sin(heading / 2)]  # noqa: E731
    goal = Destination(torch.tensor([1.0, 2.0, 0.0, *turned(3.1)]))
    poses = torch.tensor([[1.3, 2.0, 9.0, *turned(-3.1)], [1.3, 2.0, 0.0, *turned(0.0)], [1.3, 3.0, 0.0, *turned(3.1)]])
    away = goal.distance_m(poses)
    assert (away <= goal.near_m).tolist() == [True, False, False]
    assert float(away[0]) == pytest.approx(0.3) and float(away[2]) > 1
    nowhere = Destination(torch.tensor([1.0, 2.0, *[torch.nan] * 5]))
    assert nowhere.heading is None and (nowhere.distance_m(poses) <= 0.5).tolist() == [True, True, False]
