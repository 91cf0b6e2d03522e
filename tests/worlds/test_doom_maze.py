"""The bundled world does what it was learned to do: it obeys the keys, keeps to its walls, and remembers."""

from __future__ import annotations

import math

import pytest
import torch

import terrella
from terrella.core.errors import ObservationError
from terrella.space.camera import planar_pose, yaw

BUTTONS = ("MOVE_FORWARD", "MOVE_BACKWARD", "MOVE_LEFT", "MOVE_RIGHT", "TURN_LEFT", "TURN_RIGHT")


@pytest.fixture(scope="module")
def world():
    return terrella.load("doom-maze")


def hold(world, state, steps: int, *buttons: str):
    rng = terrella.make_rng(0)
    action = torch.tensor([[int(name in buttons) for name in BUTTONS]] * state.batch, dtype=torch.int8)
    for _ in range(steps):
        state = world.imagine(state, action, rng)
    return state


def turned_by(before, after) -> float:
    angle = yaw(after["pose"]) - yaw(before["pose"])
    return math.degrees(torch.atan2(angle.sin(), angle.cos()).item())


def middle_of_a_room(world):
    """A state in the room around (14.5, -5.5) m, looking along x."""
    start = world.start(1, terrella.make_rng(0))
    place = planar_pose(*(torch.tensor([value]) for value in (14.5, -5.5, float(start["pose"][0, 2]), 0.0)))
    return world.observe({"pose": place}, start, terrella.make_rng(0))


def test_turning_left_turns_left_and_the_picture_moves_right(world):
    state = middle_of_a_room(world)
    left, right = hold(world, state, 12, "TURN_LEFT"), hold(world, state, 12, "TURN_RIGHT")
    assert 25 < turned_by(state, left) < 45 and -45 < turned_by(state, right) < -25  # the game: 33.4 degrees
    one = hold(world, state, 2, "TURN_LEFT")
    row = slice(40, 60)
    before, after = (seen["rgb"][0, :, row].float().mean((0, 1)) for seen in (state, one))
    shifts = range(-12, 13)
    errors = [((after[16:-16] - before[16 - s : len(before) - 16 - s]) ** 2).mean() for s in shifts]
    assert shifts[int(torch.stack(errors).argmin())] > 0


def test_forward_walks_along_the_heading_and_a_wall_stops_it(world):
    state = middle_of_a_room(world)
    near = hold(world, state, 12, "MOVE_FORWARD")
    walked = near["pose"][0, :2] - state["pose"][0, :2]
    assert 0.5 < walked[0] < 2.5 and abs(walked[1]) < 0.1
    away = hold(world, state, 12, "MOVE_BACKWARD")
    assert (away["pose"][0, 0] - state["pose"][0, 0]) < -0.5
    corner = hold(world, hold(world, state, 8, "TURN_LEFT", "MOVE_LEFT"), 120, "MOVE_FORWARD", "MOVE_LEFT")
    still = hold(world, corner, 10, "MOVE_FORWARD", "MOVE_LEFT")
    assert (still["pose"][0, :2] - corner["pose"][0, :2]).norm() < 0.5


def test_a_turn_there_and_back_shows_the_same_room(world):
    state, rng = middle_of_a_room(world), terrella.make_rng(0)
    first = state["rgb"].float()
    seen = []
    for step in [*range(0, 181, 6), *range(180, -1, -6)]:
        place = planar_pose(*state["pose"][:, :3].unbind(-1), torch.tensor([math.radians(step)]))
        state = world.observe({"pose": place}, state, rng)
        seen.append(state["rgb"].float())
    psnr = [float(10 * torch.log10(255**2 / (frame - first).square().mean())) for frame in seen]
    assert min(psnr[10:50]) < 20, "on the way other walls are seen"
    assert psnr[-1] > 27


def test_without_its_recordings_it_remembers_what_it_was_shown_and_dreamt(world):
    """Out and back along a curve; with the last frame alone it does not find back."""
    shown = middle_of_a_room(world)
    seen = {name: shown[name] for name in ("depth", "pose")} | {"rgb": shown["rgb"].permute(0, 2, 3, 1)}
    start, likeness = seen["pose"][:, :3], {}
    for name, budget_mb in (("own", 16.0), ("last frame", 0.0)):
        alone, rng = world.without_memory().with_memory_budget(budget_mb), terrella.make_rng(0)
        state = alone.observe(seen, None, rng)
        far = None
        for step in [*range(1, 13), *range(11, -1, -1)]:
            x, y, z = (start + torch.tensor([[0.08 * step, 0.02 * step, 0.0]])).unbind(-1)
            state = alone.observe({"pose": planar_pose(x, y, z, torch.tensor([math.radians(7.5 * step)]))}, state, rng)
            far = state["rgb"] if step == 12 else far
        likeness[name] = [
            float(10 * torch.log10(255**2 / (frame.float() - shown["rgb"].float()).square().mean()))
            for frame in (state["rgb"], far)
        ]
    assert likeness["own"][0] > 27 and likeness["own"][1] < 20
    assert likeness["last frame"][0] < likeness["own"][0] - 6


def test_evidence_of_a_place_is_known_and_a_dream_elsewhere_is_not(world):
    state, rng = middle_of_a_room(world.without_memory()), terrella.make_rng(0)
    shown = world.render(state, ("rgb", "depth", "pose"))
    alone = world.without_memory()
    state = alone.observe(shown, None, rng)
    assert alone.render(state, ("known",))["known"].min() == 1
    turned = planar_pose(*shown["pose"][:, :3].unbind(-1), torch.tensor([math.pi]))
    away = alone.observe({"pose": turned}, state, rng)
    assert alone.render(away, ("known",))["known"].mean() < 0.1
    kinds = alone.render(away, ("places",))["places"][0, :, 3]
    assert kinds[kinds > 0].tolist() == [2, 3], "one observed, one dreamt"


def test_stories_in_a_batch_do_not_touch(world):
    state = middle_of_a_room(world).fork(2)
    action = torch.tensor([[0, 0, 0, 0, 1, 0], [0, 0, 0, 0, 0, 1]], dtype=torch.int8)
    both = world.imagine(state, action, terrella.make_rng(3))
    assert turned_by(state.at(0), both.at(0)) > 1 and turned_by(state.at(1), both.at(1)) < -1


def test_a_pose_that_is_not_a_number_is_refused(world):
    state = world.start(1, terrella.make_rng(0))
    with pytest.raises(ObservationError, match="finite"):
        world.observe({"pose": torch.full((1, 7), float("nan"))}, state, terrella.make_rng(0))


def test_evidence_that_agrees_with_the_dream_leaves_its_speed():
    world, rng = terrella.load("doom-maze"), terrella.make_rng(0)
    running = hold(world, middle_of_a_room(world), 8, "MOVE_FORWARD")
    told = world.observe({"pose": running["pose"]}, running, rng)
    assert torch.allclose(told["speed"], running["speed"], atol=1e-6) and told["speed"].norm() > 0.1
    beside = running["pose"].clone()
    beside[0, 0] += 0.05  # the truth is five centimetres farther on: so much faster it was
    faster = world.observe({"pose": beside}, running, rng)
    assert (faster["speed"] - running["speed"])[0].tolist() == pytest.approx([0.05, 0.0], abs=1e-5)


def test_a_story_among_known_walls_stays_in_the_map():
    """Runs against the walls around it for 200 steps."""
    world = terrella.load("doom-maze")
    state = middle_of_a_room(world)
    for press in range(10):
        state = hold(world, state, 20, "MOVE_FORWARD", *(("TURN_LEFT",) if press % 2 else ("MOVE_RIGHT",)))
        away = (world.memory.pose[:, :2] - state["pose"][0, :2]).norm(dim=-1).min()
        assert away < 1.5, "nobody has ever been so far from where it stands"


def test_a_story_that_is_over_stands_still(world):
    rng = terrella.make_rng(0)
    state = world.start(2, rng)
    over = state.replace(done=torch.tensor([True, False]), reward=torch.ones(2))
    after = world.imagine(over, world.spec.sample_action(2, rng), rng)
    before, stays = over.at(0), after.at(0)
    assert float(stays["reward"]) == 0
    for name in set(before) - {"reward"} - set(over.arenas):
        assert torch.equal(stays[name], before[name]), f"{name} moves on"
    assert not torch.equal(after["rgb"][1], over["rgb"][1]) or not torch.equal(after["pose"][1], over["pose"][1])
