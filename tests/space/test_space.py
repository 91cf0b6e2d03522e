"""Laws of the geometry: frames, patches against their slow twins, and memory that finds the keyframe that saw a place."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from terrella.space.camera import FAR_M, planar_pose, project, unproject, yaw
from terrella.space.floorplan import NOWHERE, floor_plan, slide, wall_segments
from terrella.space.keyframes import (
    Keyframes,
    doubled,
    gathered,
    look,
    look_and_carry,
    look_slowly,
    retrieve,
    retrieve_slowly,
)
from terrella.space.patches import patches, patches_slowly
from terrella.space.reproject import carry_unknown_slowly, fill_holes, warp

from .rooms import CAMERA, SIZE, cast, cast_slowly, painted, pose_at, room_depth


def keyframe(x: float, y: float, heading: float) -> Keyframes:
    pose = pose_at(x, y, heading)
    depth = room_depth(pose)
    return Keyframes.of(painted(pose, depth), depth, pose, CAMERA)


def test_the_camera_looks_along_its_heading_with_left_on_the_left():
    pose = pose_at(0, 0, math.pi / 2)
    assert yaw(pose).item() == pytest.approx(math.pi / 2)
    where, depth = project(torch.tensor([[[-1.0, 5.0, 2.3]]]), pose, CAMERA)  # ahead, a metre to the left, a metre up
    assert depth.item() == pytest.approx(5.0, abs=1e-5)
    assert where[0, 0, 0] < 0.5 and where[0, 0, 1] < 0.5


def test_project_undoes_unproject():
    pose = pose_at(0.5, -1, 0.7)
    depth = room_depth(pose)
    where, again = project(unproject(depth, pose, CAMERA).flatten(1, 2), pose, CAMERA)
    u = (torch.arange(SIZE[1]) + 0.5) / SIZE[1]
    assert torch.allclose(again.view(depth.shape), depth, atol=1e-4)
    assert torch.allclose(where.view(*SIZE, 2)[..., 0], u.expand(SIZE), atol=1e-4)


@pytest.mark.parametrize("stride", [1, 2, 8])
def test_the_compiled_patches_equal_their_slow_twin(stride):
    pose = torch.cat([pose_at(-1, 0, 0.2), pose_at(0.5, 2, 2.9)])
    depth = torch.cat([room_depth(one[None]) for one in pose])
    depth[:, 10:30, 20:36] = 1.5  # a pillar, with edges all around
    depth[:, 10:30, 36], depth[:, 10:30, 51] = 0.5, 0.5  # and columns on their own
    fast, slow = patches(depth, pose, CAMERA, stride), patches_slowly(depth, pose, CAMERA, stride)
    assert fast.shape == slow.shape and 0 < (slow[..., 3:] == 0).all(-1).float().mean() < 0.1
    assert ((fast - slow).abs().amax(-1) > 1e-3).float().mean() < 0.005


@pytest.mark.parametrize("stride", [2, 8])
def test_the_compiled_cast_equals_its_slow_twin(stride):
    seen = pose_at(-1, 0, 0.2)
    patch = patches(room_depth(seen), seen, CAMERA, stride)
    views = torch.cat([pose_at(0, 0.5, 0.6), pose_at(-2, 1, -0.4)])
    fast = cast(patch.expand(2, -1, -1), views, CAMERA, (24, 32))
    slow = cast_slowly(patch.expand(2, -1, -1), views, CAMERA, (24, 32))
    assert (fast < FAR_M).float().mean() > 0.2
    different = (fast - slow).abs() > 1e-3  # a ray through a patch's very rim may fall on either side of it
    assert different.float().mean() < 0.005


def test_a_view_from_the_keyframe_itself_is_exact():
    seen = pose_at(1, 1, 2.0)
    depth = room_depth(seen)
    again = cast(patches(depth, seen, CAMERA, 2), seen, CAMERA, SIZE)
    hit = again < FAR_M
    assert hit.float().mean() > 0.93
    assert ((again - depth).abs() / depth)[hit].median() < 1e-3


def test_a_wall_shows_nothing_from_behind():
    seen = pose_at(0, 0, 0.0)
    patch = patches(room_depth(seen), seen, CAMERA, 2)
    assert (cast(patch, pose_at(9, 0, math.pi), CAMERA, SIZE) == FAR_M).float().mean() > 0.9


def test_holes_are_filled_and_known_depth_is_kept():
    depth = torch.full((1, 32, 32), 3.0)
    depth[:, 8:12, 8:20] = FAR_M
    filled = fill_holes(depth)
    assert torch.allclose(filled, torch.full_like(filled, 3.0), atol=1e-3)


def test_warp_carries_colour_to_where_it_belongs_and_distrusts_other_surfaces():
    seen, view = pose_at(0, 0, 0.0), pose_at(0.5, 0.3, 0.2)
    depth, target = room_depth(seen), room_depth(view)
    rgb = painted(seen, depth).float() / 255
    colour, agreement, _ = warp(rgb[:, None], depth[:, None], seen[:, None], target, view, CAMERA)
    truth = painted(view, target).float() / 255
    trusted = agreement[0, 0] > 0.9
    assert trusted.float().mean() > 0.5
    assert (colour[0, 0] - truth[0]).abs().mean(0)[trusted].mean() < 0.02
    _, wrong, _ = warp(rgb[:, None], depth[:, None], seen[:, None], target * 0.5, view, CAMERA)
    assert wrong.mean() < 0.1


def four() -> Keyframes:
    return Keyframes.joined([keyframe(0, 0, 0.0), keyframe(1, -1, 0.4), keyframe(-2, 0, 0.5), keyframe(0, 2, -0.6)])


def as_kept(keys: Keyframes) -> Keyframes:
    """Keyframes as rows of an arena, of which the first is nothing."""
    whole = Keyframes.joined([keys.at([0]), keys])
    return Keyframes(**{**vars(whole), "fine": whole.fine[:, :0]})


VIEWS = torch.cat([pose_at(0.2, 0.1, 0.1), pose_at(-0.5, 0.6, 0.4), pose_at(0, 0, math.pi)])


@pytest.mark.parametrize("mine", [False, True])
def test_the_compiled_retrieval_equals_its_slow_twin(mine):
    shared, rows = four(), torch.tensor([[1, 2], [0, 3], [4, 0]])
    own = as_kept(shared) if mine else Keyframes.none(SIZE)
    rows = rows if mine else rows[:, :0]
    fast = retrieve(shared, VIEWS, CAMERA, SIZE, 3, own, rows)
    assert torch.equal(fast, retrieve_slowly(shared, VIEWS, CAMERA, SIZE, 3, own, rows))
    assert (fast[0] >= 0).sum() >= 2
    nothing = Keyframes.none(SIZE)
    alone = retrieve(nothing, VIEWS, CAMERA, SIZE, 3, as_kept(shared), torch.tensor([[1, 2], [0, 3], [4, 0]]))
    assert alone[2, 1:].tolist() == [-1, -1] and alone[1, 0] == 3


@pytest.mark.parametrize("lots", ["shared", "own", "both"])
def test_the_compiled_look_equals_its_slow_twin(lots):
    shared = Keyframes.none(SIZE) if lots == "own" else four()
    shared = Keyframes(**{**vars(shared), "rgb": doubled(shared.rgb)})
    own = as_kept(four()) if lots != "shared" else Keyframes.none(SIZE)
    picks = {"shared": [[0, 1, 3], [2, -1, -1]], "own": [[1, 2, 4], [3, -1, -1]], "both": [[0, 6, 3], [5, 1, -1]]}[lots]
    picks = torch.tensor([*picks, [-1, -1, -1]])
    shown = Keyframes.joined([keyframe(0.2, 0.1 * n, 0.1) for n in range(3)])
    last = shown.rgb, shown.depth, shown.pose
    fast, carried = look_and_carry(shared, picks, VIEWS, CAMERA, SIZE, 4, own, last)
    slow, merged = look_slowly(shared, picks, VIEWS, CAMERA, SIZE, 4, own, last)
    alone, none = look_slowly(shared, picks, VIEWS, CAMERA, SIZE, 4, own)
    assert none is None and all(torch.equal(part, vars(slow)[name]) for name, part in vars(alone).items())
    apart = carry_unknown_slowly(*last, slow.known, slow.depth, VIEWS, CAMERA)
    assert carried is not None and merged is not None and (apart[:, 3] > 0).float().mean() > 0.005
    torch.testing.assert_close(merged, apart, atol=1e-5, rtol=1e-4)
    assert float(torch.isclose(merged, carried, atol=1e-3).float().mean()) > 0.97, "where the views are alike"
    assert fast.trust[0, 1].max() > 0.3 and fast.known[2].max() == 0 and fast.trust[:, 3].max() == 0
    for name, far in (("trust", 1e-3), ("depth", 1e-2), ("known", 0.5)):
        assert ((vars(fast)[name] - vars(slow)[name]).abs() > far).float().mean() < 0.01, name
    certain = (fast.trust[:, 0] > 0.1) & (fast.trust[:, 0] - fast.trust[:, 1] > 1e-3)
    apart = (fast.rgb - slow.rgb).abs()[:, 0].amax(1)
    assert certain.float().mean() > 0.2 and (apart[certain] > 0.02).float().mean() < 0.01


def test_a_batch_of_looks_equals_its_singles():
    shared = four()
    picks = retrieve(shared, VIEWS, CAMERA, SIZE, 3)
    together = look(shared, picks, VIEWS, CAMERA, SIZE, 2)
    for n in range(len(VIEWS)):
        view = VIEWS[n : n + 1]
        assert torch.equal(retrieve(shared, view, CAMERA, SIZE, 3), picks[n : n + 1])
        alone = look(shared, picks[n : n + 1], view, CAMERA, SIZE, 2)
        assert all(torch.equal(part[0], vars(together)[name][n]) for name, part in vars(alone).items())


def test_memory_finds_the_keyframe_that_saw_the_place():
    memory = Keyframes.joined([keyframe(0, 0, math.pi), keyframe(0, 0, 0.0), keyframe(0, 0, math.pi / 2)])
    assert retrieve(memory, pose_at(0.3, 0, 0.1), CAMERA, SIZE, 2)[0, 0] == 1


def test_what_memory_knows_it_draws_and_what_it_does_not_it_says():
    memory = keyframe(0, 0, 0.0)
    near = pose_at(0.4, 0.2, 0.05)
    known = look(memory, torch.tensor([[0]]), near, CAMERA, SIZE, 2)
    truth = painted(near, room_depth(near)).float() / 255
    mask = known.known[0] > 0
    assert mask.float().mean() > 0.8
    assert (known.rgb[0, 0] - truth[0]).abs().mean(0)[mask].mean() < 0.03
    away, picks = gathered([None, memory], SIZE)
    assert look(away, picks, pose_at(0, 0, math.pi).expand(2, -1), CAMERA, SIZE, 2).known.mean() < 0.05


def looks_around(half: float, noise_m: float = 0.0):
    """Depth and pose of eight views from near the middle of a box room, with a little noise on where they stood."""
    rng = torch.Generator().manual_seed(0)
    turns = [turn * math.pi / 4 for turn in range(8)]
    pose = torch.cat([pose_at(0.3 * math.cos(turn), 0.2 * math.sin(turn), turn) for turn in turns])
    depth = torch.cat([room_depth(one[None], half=half) for one in pose])
    pose[:, :2] += noise_m * torch.randn(8, 2, generator=rng)
    return depth, pose


def square(half: float) -> torch.Tensor:
    """The four walls of a box room."""
    corners = torch.tensor([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]]) * half
    return torch.cat([corners, corners.roll(-1, 0)], 1)


def test_the_walls_of_a_room_are_found_where_they_are():
    depth, pose = looks_around(2.0)
    walls = wall_segments(depth, pose, CAMERA)
    real = walls[walls[..., 0] < NOWHERE]
    assert len(real) >= 8
    on_a_wall = (real.view(-1, 2, 2).abs() - 2.0).abs().amin(-1)
    assert on_a_wall.max() < 0.01, "both ends of every wall lie on a wall"
    whole = [seen for seen in real if (seen[:2] - seen[2:]).norm() > 1.5]
    assert whole, "a wall seen whole is one wall, not its columns"


def test_noisy_walls_are_brought_into_agreement_and_meet_in_corners():
    depth, pose = looks_around(2.0, noise_m=0.004)
    walls = wall_segments(depth, pose, CAMERA)
    raw = walls[walls[..., 0] < NOWHERE].view(-1, 2, 2)
    plan = floor_plan(walls, pose).view(-1, 2, 2)

    def off(ends: torch.Tensor) -> torch.Tensor:
        return (ends.abs() - 2.0).abs().amin(-1).mean()

    assert off(plan) < 0.8 * off(raw)
    corners = plan.abs().amin(-1) > 1.9
    assert corners.any() and (plan[corners].abs() - 2.0).abs().max() < 0.006
    assert floor_plan(walls[:0], pose[:0]).shape == (0, 4)


@given(
    st.lists(st.tuples(*[st.floats(-1.4, 1.4)] * 2, *[st.floats(-0.6, 0.6)] * 2), min_size=1, max_size=16),
    st.floats(0.2, 0.5),
)
def test_a_body_slides_along_the_walls_of_a_room(walks, half):
    places, wish = torch.tensor(walks, dtype=torch.float64).split(2, 1)
    room = 2.0 - half
    moved, left = slide(square(2.0), places, wish, half)
    assert torch.allclose(places + moved, (places + wish).clamp(-room, room), atol=1e-5)
    blocked = (places + wish).abs() > room + 1e-6
    assert left[blocked].abs().max() < 1e-9 if blocked.any() else torch.equal(left, wish)


def test_a_slanted_wall_turns_a_body_aside_and_a_corner_stops_it():
    slanted = torch.tensor([[-5.0, 6.0, 5.0, -4.0]])  # x + y = 1, at 45 degrees
    moved, _ = slide(slanted, torch.zeros(1, 2), torch.tensor([[0.4, 0.0]]), 0.4)
    end = moved[0].tolist()
    assert end[0] == pytest.approx(0.3, abs=1e-5) and end[1] == pytest.approx(-0.1, abs=1e-5)
    moved, left = slide(square(2.0), torch.tensor([[1.5, 1.5]]), torch.tensor([[0.3, 0.3]]), 0.5)
    assert moved.abs().max() < 1e-6 and left.abs().max() < 1e-9
    short, _ = slide(square(2.0), torch.tensor([[1.3, 0.0]]), torch.tensor([[0.4, 0.0]]), 0.5, short=0.25)
    assert short[0, 0].item() == pytest.approx(0.1, abs=1e-6)


@pytest.mark.parametrize("off", [-0.003, -0.0005, 0.0001, 0.001, 0.003])
def test_a_seam_in_a_wall_does_not_catch_a_body(off):
    """Two walls on one line, as two keyframes saw it, the second a little off it."""
    walls = torch.tensor([[-5.0, 1.0, 0.0, 1.0], [0.0, 1.0 + off, 5.0, 1.0 + off]])
    place, wish = torch.tensor([[-1.0, 0.45]]), torch.tensor([[0.1, 0.03]])
    for _ in range(25):
        moved, _ = slide(walls, place, wish, 0.5, 1 / 32)
        place = place + moved
    assert place[0, 0] == pytest.approx(1.5, abs=0.15) and place[0, 1] == pytest.approx(0.5, abs=0.006)


@pytest.mark.parametrize("degrees", [1, 5, 20, 60, 90])
@pytest.mark.parametrize("within", [0.0005, 0.001, 0.003])
def test_a_body_a_little_within_a_wall_goes_no_deeper(within, degrees):
    place, turn = torch.tensor([[0.0, 0.5 + within]]), math.radians(degrees)
    wish = 0.2 * torch.tensor([[math.cos(turn), math.sin(turn)]])
    for _ in range(10):
        moved, _ = slide(torch.tensor([[-9.0, 1.0, 9.0, 1.0]]), place, wish, 0.5)
        place = place + moved
    assert place[0, 1] <= 0.5 + within + 1e-4
    away, _ = slide(torch.tensor([[-9.0, 1.0, 9.0, 1.0]]), place, -wish, 0.5)
    assert torch.allclose(away, -wish, atol=1e-6), "and comes out as it likes"


def test_a_bridge_between_two_surfaces_is_no_surface():
    seen = pose_at(0, 0, 0.0)
    depth = torch.full((1, *SIZE), 8.0)
    depth[:, :, :21], depth[:, :, 21] = 2.0, 5.0  # one column that hangs between a near and a far wall
    beside = planar_pose(*(torch.tensor([value]) for value in (4.0, -2.0, 1.3, math.pi / 2)))
    ahead = cast(patches(depth, seen, CAMERA, 2), beside, CAMERA, SIZE)[0, :, 16:48]
    assert (ahead < FAR_M).float().mean() < 0.02, "from the side it would be a wall across the room"
