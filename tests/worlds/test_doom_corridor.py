"""The bundled world of monsters: they stand where they wait, and who is shot at falls."""

from __future__ import annotations

from typing import Any

import pytest
import torch

import terrella
from terrella.core import chance, check_world, make_rng
from terrella.space.camera import planar_pose, yaw
from terrella.worlds.learned import LearnedWorld
from terrella.worlds.objects import LOOK, NUMBER, PLACE

STORIES, STEPS, TALL_M, LOW_M = 48, 80, 1.2, 0.75


@pytest.fixture(scope="module")
def world() -> LearnedWorld:
    found = terrella.load("doom-corridor")
    assert isinstance(found, LearnedWorld) and found.objects
    return found


def heights(world: Any, billboards: torch.Tensor) -> torch.Tensor:
    """How tall billboards [..., COLUMNS] are, in metres; nan where there is none."""
    look = billboards[..., LOOK].long()
    return torch.where(
        (billboards[..., NUMBER] > 0) & (look >= 0), world.objects.boxes[look.clamp_min(0), 3], torch.nan
    )


def test_it_keeps_the_contract_and_monsters_wait_in_it(world):
    assert "observes" in check_world(world) and {"objects", "instances", "health"} <= set(world.spec.channels)
    state = world.start(8, make_rng(0))
    assert ((heights(world, state["billboards"]) > TALL_M).sum(1) >= 2).all(), "two guards stand at the entrance"
    assert (state["instances"] > 0).flatten(1).any(1).float().mean() > 0.7


def test_the_guards_that_stories_begin_with_are_billboards_and_nothing_else(world):
    """The picture with which a story begins leaves no thing behind that no card covers: it would stand there for ever."""
    state = world.start(8, make_rng(0))
    things = state["things"] > 0.5
    assert things.any() and (things & (state["instances"] == 0)).float().mean() < 0.001


@pytest.mark.slow
def test_who_is_shot_at_falls_more_often_than_who_is_not(world):
    """Dreams of two seconds before each guard of the entrance: looking straight at it or 0.38 rad beside, with ATTACK held or
    not."""
    state = world.start(1, make_rng(0))
    objects, pose = world.objects, state["pose"][0]
    guards = state["billboards"][0][heights(world, state["billboards"][0]) > TALL_M]
    guards = guards[(guards[:, PLACE] - pose[:3])[:, :2].norm(dim=1) < 6.0]
    assert len(guards) == 2
    for guard in guards:
        apart = guard[PLACE] - pose[:3]
        fell = []
        for attack, beside in ((0.0, 0.0), (1.0, 0.0), (1.0, 0.38), (1.0, -0.38)):
            looks = planar_pose(pose[:1], pose[1:2], pose[2:3], torch.atan2(apart[1], apart[0])[None] + beside)
            looks = looks.expand(STORIES, 7)
            billboards, rng = objects.empty(STORIES), make_rng(1)
            billboards[:, 0] = guard
            acts = torch.zeros(STORIES, world.config.history, 7)
            acts[..., world.spec.action_names.index("ATTACK")] = attack
            low = torch.zeros(STORIES, dtype=torch.bool)
            for _ in range(STEPS):
                billboards = objects.act(
                    billboards,
                    torch.ones(STORIES, objects.config.rows, dtype=torch.bool),
                    looks,
                    acts,
                    chance.uniforms(chance.seeds(STORIES, rng), objects.draws),
                )
                low |= heights(world, billboards[:, 0]) < LOW_M
            fell.append(float(low.float().mean()))
        assert fell[1] > max(fell[0], *fell[2:]) + 0.3, fell


def test_a_guard_in_sight_does_something_and_the_place_stays_as_it_is(world):
    """In a second of standing before them the guards' pixels change in more than one step, and the rest hardly does."""
    rng, state = make_rng(0), world.start(2, make_rng(0))
    still, changed = torch.zeros(2, 7, dtype=torch.int8), []
    for _ in range(30):
        before, state = state, world.imagine(state, still, rng)
        off = (state["rgb"].float() - before["rgb"].float()).abs().mean(1)
        there = (state["instances"] > 0) | (before["instances"] > 0)
        changed.append((float(off[there].mean()), float(off[~there].mean())))
    things, rest = torch.tensor(changed).unbind(1)
    assert (things > 4).sum() >= 2 and rest.mean() < 0.5 * things.mean()


def test_shots_are_hits_and_fell_somebody_and_walking_is_neither(world):
    for attacks in (True, False):
        state, rng, hits, fallen = world.start(1, make_rng(0)), make_rng(0), 0, 0
        for _ in range(60):
            billboards = state["billboards"][0]
            standing = billboards[world.objects.solid[billboards[:, LOOK].long().clamp_min(0)] > 0]
            apart = standing[:, PLACE] - state["pose"][0, :3]
            nearest = apart[apart[:, :2].norm(dim=1).argmin()]
            turn = float(torch.atan2(nearest[1], nearest[0]) - yaw(state["pose"])[0])
            action = torch.zeros(1, 7, dtype=torch.int8)
            action[0, 0 if not attacks else 4 if turn > 0.06 else 5 if turn < -0.06 else 6] = 1
            state = world.imagine(state, action, rng)
            seen = world.render(state, ("hit", "fallen"))
            hits, fallen = hits + int(seen["hit"]), fallen + int(seen["fallen"])
        assert (hits >= fallen >= 1) if attacks else hits == fallen == 0
