"""Doom's task with instructions: rooms by their walls, starts, the teacher, the end, and settings that do not fit."""

import math

import numpy as np
import pytest
import torch

import terrella
from terrella.cli import main
from terrella.core.check import check_world
from terrella.core.errors import TerrellaError
from terrella.core.instruction import bytes_to_text
from terrella.core.world import make_rng

vizdoom = pytest.importorskip("vizdoom")

from terrella.sim.doom_rooms import HELD_OUT, NAMES, WORDINGS  # noqa: E402


@pytest.fixture(scope="module")
def world():
    world = terrella.load("doom:my_way_home:rooms")
    yield world
    world.close()


def text_of(world, state):
    return bytes_to_text(world.render(state, ("text",))["text"][0].numpy())


def walked(world, seed):
    """The last state of an episode of the teacher, its rewards and its steps."""
    state, rewards = world.start(1, make_rng(seed)), []
    while not rewards or (not rewards[-1] and len(rewards) < world.spec.max_episode_steps):
        action = world.render(state, ("expert",))["expert"].to(torch.int8)
        state = world.imagine(state, action, make_rng(0))
        rewards.append(float(world.render(state, ("reward",))["reward"]))
    return state, rewards


def test_rooms_are_named_by_the_texture_of_their_walls(world):
    assert sorted(world.rooms) == sorted(NAMES.values()) and len(set(world.rooms.values())) == 8
    routes = world._routes
    assert routes.sector_at(464, -464) == world.rooms["red"] and routes.sector_at(1040, -176) == world.rooms["green"]
    assert routes.sector_at(464, -320) not in world.rooms.values(), "a corridor"
    assert routes.sector_at(-1000, 0) == -1


def test_it_is_a_world_by_the_laws(world):
    check_world(world)


def test_episodes_start_in_another_room_and_anywhere(world):
    texts, places = set(), []
    for seed in range(12):
        state = world.start(1, make_rng(seed))
        seen = world.render(state, ("pose", "success", "reward", "done"))
        assert not (seen["success"] or seen["done"] or seen["reward"])
        x, y, yaw = world._doom.place()
        places.append((x, y, yaw))
        texts.add(text_of(world, state))
        room = next(name for name in world.rooms if f" {name} room" in text_of(world, state))
        start = world._routes.sector_at(x, y)
        assert start in world.rooms.values() and start != world.rooms[room]
    assert len(texts) > 6 and np.std(places, axis=0).min() > 0.5
    assert all(any(text == one.format(name) for one in WORDINGS for name in world.rooms) for text in texts)


@pytest.mark.parametrize("seed", range(4))
def test_the_teacher_walks_there(world, seed):
    state, rewards = walked(world, seed)
    seen = world.render(state, ("success", "done", "reward", "expert"))
    assert seen["success"] and seen["done"] and rewards == [0.0] * (len(rewards) - 1) + [1.0]
    assert not seen["expert"].any()
    still = world.imagine(state, torch.ones(1, 6, dtype=torch.int8), make_rng(0))
    assert not world.render(still, ("reward",))["reward"] and world.render(still, ("done",))["done"]


def test_the_way_leads_around_walls(world):
    """From the metal room the green one lies straight ahead, behind five walls."""
    routes, sector = world._routes, world.rooms["green"]
    aim = routes._point_ahead(240.0, -176.0, sector)
    assert aim[0] > 300 and abs(aim[1] + 176) < 16, "through the door"
    field = routes._field(sector)
    cell = routes._nearest_free(240.0, -176.0)
    assert math.isfinite(field[cell]) and field[cell] * 8 > 1.3 * (1040 - 240)


def test_wordings_that_training_never_sees_and_no_task_at_all():
    world = terrella.load("doom:my_way_home:rooms:unseen")
    assert text_of(world, world.start(1, make_rng(0))) in [one.format(name) for one in HELD_OUT for name in world.rooms]
    world.close()
    world = terrella.load("doom:my_way_home:rooms:free")
    state = world.start(1, make_rng(0))
    assert text_of(world, state) == "" and world.spec.max_episode_steps is None
    assert not world.render(state, ("expert",))["expert"].any()
    world.close()


def test_a_skill_at_which_the_player_cannot_be_placed_is_refused():
    with pytest.raises(TerrellaError, match="skill 5: the game does not let its player be placed; give 1 to 4"):
        terrella.load("doom:my_way_home:rooms", skill=5)


@pytest.mark.parametrize(
    "name, said",
    [
        ("doom:my_way_home:room", "there is no task 'room'; did you mean 'rooms'"),
        ("doom:basic:rooms", "basic has no rooms of different walls to name; my_way_home has eight"),
        ("doom:my_way_hom:rooms", "ViZDoom has no scenario 'my_way_hom'"),
    ],
)
def test_tasks_that_a_map_does_not_have_are_named(name, said, capsys):
    with pytest.raises(TerrellaError, match=said):
        terrella.load(name)


def test_the_task_of_another_world_is_refused(capsys, tmp_path):
    words = ["record", "world", "gym:CartPole-v1", "--task", "rooms", "--out", str(tmp_path / "r"), "--frames", "9"]
    assert main(words) == 2
    assert "--task is for the robots of MuJoCo and for maps of Doom" in capsys.readouterr().err
