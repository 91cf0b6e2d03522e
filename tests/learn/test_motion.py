"""The motion model finds, from recorded poses alone, how a made-up player turns, glides and is stopped by walls."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from tests.learn.stopping import quiet

from terrella.core import make_rng
from terrella.learn.objectives.motion import learn_motion
from terrella.learn.recording import Recording
from terrella.learn.trainer import Run
from terrella.space.camera import planar_pose, rays, rotation, yaw
from terrella.space.floorplan import slide
from terrella.space.keyframes import Keyframes
from terrella.worlds.body import Motion, rotate
from terrella.worlds.config import MotionConfig

CAMERA, HALF_ROOM = (0.5, 0.8, 0.5, 0.5), 3.0
DRAG, THRUST, TURN, BODY, SHORT = 0.9, 0.01, 0.06, 0.35, 1 / 16
WALLS = torch.tensor([[3.0, 3, -3, 3], [-3, 3, -3, -3], [-3, -3, 3, -3], [3, -3, 3, 3], [0, 3, 0, 1.5]])


def keyframes() -> Keyframes:
    """What eight views from two places saw of the room and of the wall that stands into it."""
    poses = [
        planar_pose(*(torch.tensor([value]) for value in (x, -1.0, 1.3, turn * math.pi / 4)))
        for x in (-1.5, 1.5)
        for turn in range(8)
    ]
    pose = torch.cat(poses)
    depth = torch.stack([_depth(one) for one in pose])
    return Keyframes.of(torch.zeros(len(pose), 3, 48, 64, dtype=torch.uint8), depth, pose, CAMERA)


def _depth(pose: torch.Tensor) -> torch.Tensor:
    """Depth [48, 64] of upright walls without a top or a bottom."""
    beam = (rays(CAMERA, 48, 64).view(-1, 3) @ rotation(pose).T)[:, :2]
    ends = WALLS.view(-1, 2, 2) - pose[:2]
    along = ends[:, 1] - ends[:, 0]
    cross = beam[:, :1] * along[:, 1] - beam[:, 1:] * along[:, 0]
    ahead = (ends[:, 0, 0] * along[:, 1] - ends[:, 0, 1] * along[:, 0]) / cross
    share = (ends[:, 0, 0] * beam[:, 1:] - ends[:, 0, 1] * beam[:, :1]) / cross
    hit = (ahead > 0) & (share >= -1e-4) & (share <= 1 + 1e-4)
    return torch.where(hit, ahead, 60.0).amin(1).view(48, 64)


def walks(episodes: int = 90, length: int = 40) -> Recording:
    """Recorded poses of a player with the buttons forward, left and right."""
    rng, poses, actions = make_rng(0), [], []
    for _ in range(episodes):
        place, heading, speed = (
            torch.rand(1, 2, generator=rng) * 3 - torch.tensor([[1.5, 2.5]]),
            6 * torch.rand(1, generator=rng),
            torch.zeros(1, 2),
        )
        held = torch.zeros(3)
        for step in range(length):
            if step % 9 == 0:
                held = (torch.rand(3, generator=rng) < torch.tensor([0.7, 0.3, 0.3])).float()
            poses.append(planar_pose(place[:, 0], place[:, 1], torch.full((1,), 1.3), heading))
            actions.append(held)
            heading = heading + TURN * (held[1] - held[2])
            wish = DRAG * speed + rotate(torch.tensor([[THRUST, 0.0]]) * held[0], heading)
            moved, speed = slide(WALLS, place, wish, BODY, SHORT)
            place = place + moved
    total = episodes * length
    valid = np.arange(total) % length < length - 1
    cache = SimpleNamespace(
        pose=torch.cat(poses).numpy(),
        action=torch.stack(actions).numpy(),
        action_valid=valid,
        done=np.zeros(total, bool),
        length=total,
    )
    return Recording(cache, np.arange(total) // length * length, np.ones(total, bool))  # type: ignore[arg-type]


@pytest.mark.slow
def test_drag_thrust_turning_and_body_come_out_of_the_recording(tmp_path):
    torch.manual_seed(0)
    motion = Motion(MotionConfig(actions=3, history=2))
    found = learn_motion(Run(tmp_path, {}, quiet), motion, walks(), keyframes(), 600)
    assert found["body_m"] == pytest.approx(BODY, abs=0.01)
    assert found["short"] == SHORT
    assert found["motion_error_m"] < 0.02
    acts = torch.tensor([1.0, 1.0, 0.0]).expand(1, 3, 3)
    with torch.no_grad():
        heading, wish = motion(torch.tensor([0.5]), torch.tensor([[0.1, -0.1]]), acts)
        truth = DRAG * torch.tensor([[0.1, -0.1]]) + rotate(torch.tensor([[THRUST, 0.0]]), torch.tensor([0.5 + TURN]))
        assert heading.item() == pytest.approx(0.5 + TURN, abs=0.003)
        assert (wish - truth).abs().max() < 0.004
        assert motion.ends(torch.zeros(1, 2), torch.zeros(1, 3)).item() < -10, "nothing was seen to end"


def test_the_walls_of_the_made_up_room_are_where_it_has_them():
    memory = keyframes()
    assert yaw(memory.pose).unique().numel() >= 8
    walls = memory.walls[memory.walls[..., 0] < 1e5].view(-1, 2)
    near = torch.minimum((walls.abs().amax(1) - HALF_ROOM).abs(), walls[:, 0].abs())
    assert near.max() < 0.01
