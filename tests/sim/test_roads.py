"""A car on the roads of a town: lanes that lead on, traffic that minds, three cameras, and what ends a drive."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
import pytest
import torch

import terrella
from terrella.core import check_world, make_rng
from terrella.core.errors import TerrellaError
from terrella.sim.road_network import LANE_M, road_network

if find_spec("mujoco") is None:
    pytest.skip("mujoco is not installed: pip install 'terrella[mujoco]'", allow_module_level=True)


@pytest.fixture(scope="module")
def town():
    """A world without cameras."""
    return terrella.load("mujoco:car:road", cameras=(), threads=1)


def driven(world, name: str, batch: int, steps: int, seed: int = 0):
    """The state after a policy's steps from new episodes."""
    rng, policy = make_rng(seed), terrella.load_policy(name, world.spec)
    state, memory = world.start(batch, rng), policy.begin(batch, rng)
    for _ in range(steps):
        action, memory = policy.act(world.render(state, ("route", "gap")), memory, rng)
        state = world.imagine(state, action, rng)
    return state


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_lanes_lead_on_where_others_begin_and_never_end(seed):
    roads = road_network(seed)
    last, first = roads.points[:, -1], roads.points[:, 0]
    for following in roads.next_pieces.T:
        np.testing.assert_allclose(first[following], last, atol=1e-9)
        assert (np.sum(roads.headings[following, 0] * roads.headings[:, -1], 1) > 0.9).all()
    assert (np.unique(roads.next_pieces[: roads.lanes], axis=0).max() >= roads.lanes) and (roads.choices > 0).all()
    assert set(roads.next_pieces[roads.lanes :].ravel()) == set(range(roads.lanes)), "every lane is reached"
    middle = roads.nodes[roads.streets].mean(1)
    right = roads.points[: roads.lanes : 2].mean(1) - middle  # of each street's first lane
    np.testing.assert_allclose(np.linalg.norm(right, axis=1), LANE_M / 2)
    assert not np.array_equal(roads.nodes, road_network(seed + 1).nodes)


def test_the_contract_holds(town):
    assert "a_batch_equals_its_singles" in check_world(town, steps=2)
    assert town.spec.action_names == ("steer", "drive") and town.spec.action_units == ("rad", "m/s")
    other = terrella.load("mujoco:car:road:3", cameras=(), threads=1)
    assert other.fingerprint() != town.fingerprint()


def test_a_good_driver_gets_on_and_a_bad_one_does_not(town):
    good, bad = (driven(town, name, 4, 70) for name in ("driver", "driver:0"))
    assert not good["done"].any() and 4 < float(good["progress"].mean()) < 8
    assert bad["done"].any() and bad["progress"].mean() < 0.8 * good["progress"].mean()
    assert bool((bad["done"] == (bad["offroad"] | bad["collision"])).all())


def behind_a_car(world):
    """Two cars stand 0.9 m apart in a lane; the one that drives is the second, then the first."""
    state = world.start(2, make_rng(0))
    piece, along, seeds = state["piece"].clone(), state["along"].clone(), state["seed"]
    own = world.task.lanes.project(state["physics"][:, 1:3], piece[:, -1])[0]
    offset = torch.tensor([0.9, -0.9], dtype=torch.float64)
    piece[:, 0], along[:, 0] = piece[:, -1], own + offset
    assert (along[:, 0] > 0).all() and (along[:, 0] < world.task.lanes.lengths[piece[:, 0]]).all()
    return state.replace(piece=piece, along=along, pace=torch.zeros_like(state["pace"]), seed=seeds)


def test_who_looks_stops_before_what_stands_and_traffic_does(town):
    looking, blind = terrella.load_policy("driver", town.spec), terrella.load_policy("driver", town.spec)
    for policy, sees in ((looking, True), (blind, False)):
        state, rng = behind_a_car(town), make_rng(0)
        memory = policy.begin(2, rng)
        for _ in range(12):
            seen = town.render(state, ("route", "gap"))
            gap = seen["gap"] if sees else torch.full_like(seen["gap"], 2.0)
            action, memory = policy.act({"route": seen["route"], "gap": gap}, memory, rng)
            action[1] = 0  # waits for the car behind it
            state = town.imagine(state.replace(pace=state["pace"] * torch.tensor([[0.0], [1.0]])), action, rng)
        assert bool(state["collision"][0]) != sees
        assert not state["collision"][1] and state["pace"][1, 0] < 0.2


def test_a_car_that_leaves_the_road_is_done(town):
    rng = make_rng(0)
    state = town.start(2, rng)
    for _ in range(25):
        state = town.imagine(state, torch.tensor([[0.5, 2.5], [0.0, -1.0]]), rng)
    assert state["offroad"][0] and state["done"][0] and state["progress"][1] < 0


def test_the_route_is_ahead_in_the_lane(town):
    state = town.start(8, make_rng(0))
    seen = town.render(state, ("route", "lane", "speed", "observation"))
    np.testing.assert_allclose(seen["lane"], 0, atol=1e-5)
    np.testing.assert_allclose(seen["route"][:, 0], torch.tensor([[0.2, 0.0]]).expand(8, 2), atol=0.02)
    np.testing.assert_allclose(seen["observation"][:, 5:], seen["route"].flatten(1))


def test_three_cameras_see_the_sides():
    world = terrella.load("mujoco:car:road", threads=1)
    state = world.start(1, make_rng(0))
    try:
        seen = world.render(state, ("rgb", "rgb.left", "rgb.right", "pose", "pose.left", "pose.right"))
    except TerrellaError as error:
        pytest.skip(str(error))
    assert seen["rgb.left"].shape == (1, 48, 64, 3) and world.spec.cameras["rgb.left"].intrinsics[0] == pytest.approx(
        0.5
    )
    heading = [2 * torch.atan2(*seen[name][0, [6, 3]]).rad2deg() for name in ("pose", "pose.left", "pose.right")]
    turned = [float(one - heading[0] + 180) % 360 - 180 for one in heading[1:]]
    np.testing.assert_allclose(turned, [70, -70], atol=1.0)


def test_names_that_there_are_not(town):
    with pytest.raises(TerrellaError, match="did you mean 'road'.*road:SEED"):
        terrella.load("mujoco:car:raod")
    with pytest.raises(TerrellaError, match="none by name"):
        terrella.load("mujoco:arm:road")
    with pytest.raises(TerrellaError, match="quality from 0 to 1"):
        terrella.load_policy("driver:2", town.spec)
    with pytest.raises(TerrellaError, match="task road"):
        terrella.load_policy("driver", terrella.load("mujoco:arm", cameras=()).spec)
