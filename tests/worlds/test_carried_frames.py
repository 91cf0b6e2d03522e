"""What moves: carried by the last frames, never kept by memory."""

from __future__ import annotations

import torch
import torch.nn.functional as F

from terrella.core.world import make_rng
from terrella.space.camera import planar_pose
from terrella.space.keyframes import Keyframes, look, retrieve
from terrella.space.reproject import carry_things, carry_things_slowly
from terrella.worlds.carried_frames import Frame, carry_frames, static_depth

CAMERA, SIZE = (0.5, 0.8, 0.5, 0.5), (24, 32)


def at(*places: tuple[float, float, float]) -> torch.Tensor:
    """Level poses at (x, y) metres that look along a heading in radians."""
    x, y, heading = torch.tensor(places).unbind(1)
    return planar_pose(x, y, torch.ones(len(places)), heading)


def scene(thing_row: slice = slice(10, 16), thing_column: slice = slice(12, 18)) -> Frame:
    """A grey wall 6 m ahead and a red thing 3 m ahead, seen from the origin."""
    rgb, depth, things = torch.full((1, 3, *SIZE), 100), torch.full((1, *SIZE), 6.0), torch.zeros(1, *SIZE)
    rgb[:, :, thing_row, thing_column] = torch.tensor([250, 0, 0])[None, :, None, None]
    depth[:, thing_row, thing_column], things[:, thing_row, thing_column] = 3.0, 1.0
    return Frame(rgb.to(torch.uint8), depth, things, at((0.0, 0.0, 0.0)), torch.zeros_like(things, dtype=torch.bool))


def test_a_thing_is_carried_by_its_own_depth():
    """A step of 0.75 m to the left shifts the thing at 3 m by four pixels and the wall at 6 m by two; standing still, all
    stays."""
    frame = scene()
    here, aside = (carry_frames(frame, frame, at((0.0, y, 0.0)), CAMERA)[0] for y in (0.0, 0.75))
    assert torch.equal(here[5] > 0.5, frame.things[0] > 0.5)
    assert torch.allclose(here[:3], frame.rgb[0] / 255, atol=1e-3) and (here[3] == 1).all()
    columns = (aside[5, 12] > 0.5).nonzero()[:, 0]
    assert (columns.min(), columns.max()) == (16, 21)
    assert torch.allclose(aside[4, 12, 17:21], torch.tensor(3.0)) and (aside[0, 12, 17:21] > 0.9).all()
    assert (aside[6:9] - aside[:3]).abs().max() == 0  # both frames are the same one here


def test_what_was_hidden_behind_a_thing_is_not_trusted():
    carried = carry_frames(scene(), scene(), at((0.0, 0.75, 0.0)), CAMERA)[0]
    uncovered = carried[3, 12, 14:16]  # where the thing stood before the wall, and stands no more
    assert (uncovered < 0.5).all() and carried[3, 12, 2:10].min() > 0.9


def test_memory_keeps_the_wall_and_not_the_thing():
    """From the side, the keyframe's wall is known but for what the thing hid, and nothing 3 m ahead is recalled; without
    `still` there is."""
    frame, pose = scene(), at((0.0, 0.75, 0.0))
    found = {}
    for name, depth in (("kept", static_depth(frame.depth, frame.things)), ("all", frame.depth)):
        keys = Keyframes.of(frame.rgb, depth, frame.pose, CAMERA)
        found[name] = look(keys, retrieve(keys, pose, CAMERA, SIZE, 1), pose, CAMERA, SIZE, 1)
    kept = found["kept"]
    assert (kept.depth[0][kept.known[0] > 0] > 5.5).all() and kept.known[0].mean() > 0.5
    assert (kept.rgb[0, 0, 0] * kept.known[0]).max() < 0.6  # no red
    assert (found["all"].depth[0] < 4).any()


def test_a_keyframe_of_nothing_but_things_says_nothing():
    frame = scene(slice(0, 24), slice(0, 32))
    keys = Keyframes.of(frame.rgb, static_depth(frame.depth, frame.things), frame.pose, CAMERA)
    assert (keys.walls.abs() >= 1e5).all()
    assert look(keys, torch.tensor([[0]]), at((0.0, 0.3, 0.0)), CAMERA, SIZE, 1).known.sum() == 0


def test_a_thing_that_comes_nearer_grows_whole():
    """A step of 1 m towards a thing at 3 m, whose recorded depth is coarse: half as large again, without a hole."""
    frame = scene()
    rough = frame.depth + 0.3 * ((torch.arange(32) % 2) - 0.5) * frame.things  # as an 8-bit depth buffer has it
    frame = frame._replace(depth=rough)
    near = carry_frames(frame, frame, at((1.0, 0.0, 0.0)), CAMERA)[0, 5] > 0.5
    rows, columns = near.any(1).nonzero()[:, 0], near.any(0).nonzero()[:, 0]
    assert len(rows) in (9, 10, 11) and len(columns) in (9, 10, 11)
    assert near[rows.min() + 1 : rows.max(), columns.min() + 1 : columns.max()].all()


def test_a_frame_that_stands_still_is_carried_for_ever_as_it_is():
    frame = scene()
    for _ in range(20):
        carried = carry_frames(frame, frame, at((0.0, 0.0, 0.0)), CAMERA)
        rgb = (carried[:, :3] * 255).round().to(torch.uint8)
        frame = Frame(rgb, carried[:, 4], carried[:, 5], frame.pose, frame.covered)
    assert torch.equal(frame.rgb, scene().rgb) and torch.equal(frame.things, scene().things)


def test_the_kernel_carries_as_the_slow_way_does():
    """Rough frames of a slanted wall with things before it, some of them covered, seen from near where they were."""
    rng = make_rng(0)
    across = torch.linspace(3.0, 8.0, 32).expand(6, 24, 32)
    depth = across + 0.1 * torch.rand(across.shape, generator=rng)
    things = (F.avg_pool2d(torch.rand(depth.shape, generator=rng), 5, 1, 2) > 0.52).float()
    rgb = torch.randint(256, (6, 3, 24, 32), generator=rng, dtype=torch.uint8)
    pose, aside = at(*[(0.0, 0.0, 0.3)] * 6), at(*[(0.2 * n, -0.1 * n, 0.3 - 0.04 * n) for n in range(6)])
    covered = torch.rand(depth.shape, generator=rng) < 0.1
    frame = rgb, depth - 1.5 * things, things, covered, pose
    for seen_from in (pose, aside):
        quick, slow = carry_things(*frame, seen_from, CAMERA), carry_things_slowly(*frame, seen_from, CAMERA)
        assert ((quick - slow).abs() > 1e-3).float().mean() < 1e-3 and slow[:, 3].mean() > 0.4
