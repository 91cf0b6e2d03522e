"""The bundled world islet: pictures alone, scrolls as it is told, recalls what left the picture, stands still unblurred."""

from __future__ import annotations

import pytest
import torch

import terrella
from terrella.core import World
from terrella.space.ground import window
from terrella.space.matching import scroll_index


@pytest.fixture(scope="module")
def world() -> World:
    return terrella.load("islet")


def walked(world: World, action: str, steps: int, batch: int = 8) -> list[torch.Tensor]:
    """Pictures uint8 [B, 3, H, W] of so many steps of one action."""
    rng, number = terrella.make_rng(0), world.spec.action_names.index(action)
    state, seen = world.start(batch, rng), []
    for _ in range(steps):
        state = world.imagine(state, torch.full((batch,), number), rng)
        seen.append(world.render(state, ("rgb",))["rgb"].permute(0, 3, 1, 2).contiguous())
    return seen


def test_it_is_a_world_of_pictures_and_says_how_it_is_played(world):
    spec = world.spec
    assert "pose" not in spec.channels and spec.channels["rgb"].shape == (80, 96, 3) and "mosaic" in spec.channels
    assert (
        spec.action_names == ("noop", "up", "down", "left", "right")
        and spec.keys
        and spec.card["game"] == "gym:Islet-v0"
    )


@pytest.mark.parametrize(
    "action, way",
    [
        ("right", (-2, 0)),
        pytest.param("down", (0, -2), marks=pytest.mark.exact),
        *(pytest.param(*other, marks=pytest.mark.slow) for other in (("left", (2, 0)), ("up", (0, 2)))),
    ],
)
def test_the_picture_scrolls_as_it_is_told(world, action, way):
    """More often than in any other way; at the border of the island, and against trees, it stands."""
    moves, seen = world.scene.moves, walked(world, action, 10)
    went = torch.stack([moves[scroll_index(one, other, moves)] for one, other in zip(seen, seen[1:])])
    moved = went[(went != 0).any(2)]
    assert len(moved) > 10 and (moved == torch.tensor(way)).all(1).float().mean() > 0.7


@pytest.mark.parametrize("action", ["up", pytest.param("left", marks=pytest.mark.slow)])
def test_a_walk_in_one_direction_stays_on_the_island(world, action):
    """After 30 steps it shows what the recordings saw there."""
    rng, number = terrella.make_rng(0), world.spec.action_names.index(action)
    state = world.start(2, rng)
    for _ in range(30):
        state = world.imagine(state, torch.full((2,), number), rng)
    scene, frame = world.scene, state["frames"][:, 0]
    there = window(scene.ground, state["place"], scene.config.size)
    same = ((there[:, :3].int() - frame.int()).abs().amax(1) <= 8)[:, ~scene.over]
    assert (same.float().mean(1) > 0.8).all()


@pytest.mark.slow
def test_standing_still_it_neither_fades_nor_blurs(world):
    seen = walked(world, "noop", 120, batch=2)
    first, last = (picture.float() for picture in (seen[0], seen[-1]))
    edges = [(picture[..., 1:] - picture[..., :-1]).abs().mean() for picture in (first, last)]
    assert abs(edges[1] / edges[0] - 1) < 0.15
    assert ((last.mean((2, 3)) - first.mean((2, 3))).abs() < 8).all()
