"""Doom: keys, pose and depth mean what the spec says that they mean."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from terrella.core import make_rng, rollout
from terrella.core.errors import ActionError, StaleStateError, TerrellaError

pytest.importorskip("vizdoom", reason="ViZDoom is not installed: pip install vizdoom")

from terrella.sim.doom import BUTTONS, CAMERA, Doom, DoomConfig


@pytest.fixture(scope="module")
def game():
    game = Doom()
    yield game
    game.close()


def press(*names: str) -> torch.Tensor:
    return torch.tensor([[float(button in names) for button in BUTTONS]])


def yaw(pose: torch.Tensor) -> float:
    """Radians about world z, from the quaternion w, x, y, z."""
    return float(2 * torch.atan2(pose[0, 6], pose[0, 3]))


def turned(before: torch.Tensor, after: torch.Tensor) -> float:
    return (yaw(after) - yaw(before) + np.pi) % (2 * np.pi) - np.pi


def held(game, seed: int, action: torch.Tensor, steps: int) -> tuple[torch.Tensor, torch.Tensor]:
    """The pose before and after `steps` steps of the same action, from the start of `seed`."""
    rng = make_rng(seed)
    rolled = rollout(game, game.start(1, rng), action.expand(steps, 1, 6), rng, ("pose",))
    return rolled.observations["pose"][0], rolled.observations["pose"][-1]


@pytest.mark.parametrize(("button", "sign"), [("TURN_LEFT", 1), ("TURN_RIGHT", -1)])
def test_turning_left_raises_yaw_and_right_lowers_it(game, button, sign):
    before, after = held(game, 0, press(button), 10)
    assert sign * turned(before, after) > np.deg2rad(5)
    assert torch.allclose(before[:, :3], after[:, :3], atol=1e-3)


@pytest.mark.parametrize(
    ("button", "axis"),
    [("MOVE_FORWARD", (1, 0)), ("MOVE_BACKWARD", (-1, 0)), ("MOVE_LEFT", (0, 1)), ("MOVE_RIGHT", (0, -1))],
)
def test_each_move_goes_along_its_axis_of_the_camera(game, button, axis):
    """Camera x forward, y left. From some start or other there is room to go."""
    moves = []
    for seed in range(6):
        before, after = held(game, seed, press(button), 6)
        step = (after - before)[0, :2].numpy()
        cos, sin = np.cos(yaw(before)), np.sin(yaw(before))
        moves.append((step[0] * cos + step[1] * sin, -step[0] * sin + step[1] * cos))
    farthest = max(moves, key=np.linalg.norm)
    assert np.linalg.norm(farthest) > 0.3
    assert np.dot(farthest, axis) / np.linalg.norm(farthest) > 0.95


def test_turning_left_moves_the_picture_right(game):
    rng = make_rng(0)
    state = game.start(1, rng)
    before = game.render(state, ("rgb",))["rgb"][0].float().mean(-1)
    for _ in range(3):
        state = game.imagine(state, press("TURN_LEFT"), rng)
    after = game.render(state, ("rgb",))["rgb"][0].float().mean(-1)
    errors = {}
    for shift in range(-30, 31):
        a, b = (before[:, : 128 - shift], after[:, shift:]) if shift >= 0 else (before[:, -shift:], after[:, :shift])
        errors[shift] = float((a - b).abs().mean())
    assert min(errors, key=errors.get) > 0


def test_depth_falls_as_fast_as_one_walks_towards_a_wall(game):
    """Depth in the middle of the picture, plus the way walked along the optical axis, is constant in front of a flat wall."""
    checked = 0
    for seed in range(12):
        rng = make_rng(seed)
        rolled = rollout(game, game.start(1, rng), press("MOVE_FORWARD").expand(8, 1, 6), rng, ("depth", "pose"))
        depth, pose = rolled.observations["depth"][:, 0], rolled.observations["pose"][:, 0]
        heading = torch.tensor([np.cos(yaw(pose[:1])), np.sin(yaw(pose[:1]))], dtype=torch.float32)
        walked = (pose[:, :2] - pose[0, :2]) @ heading
        middle = depth[:, 46:50, 62:66]
        flat = (middle.amax((1, 2)) - middle.amin((1, 2))).max() < 0.02  # a wall square to the view
        if flat and walked[-1] > 0.5:
            checked += 1
            assert torch.allclose(middle.mean((1, 2)) + walked, middle[0].mean(), atol=0.1)
    assert checked >= 1


def test_depth_and_pose_of_two_views_agree_on_one_world(game):
    """Points unprojected from one view, projected into another a few steps on, find the same depth for most of what both see."""
    rng = make_rng(3)
    actions = torch.cat([press("TURN_LEFT").expand(4, 1, 6), press("MOVE_FORWARD").expand(4, 1, 6)])
    rolled = rollout(game, game.start(1, rng), actions, rng, ("depth", "pose"))
    depth, pose = rolled.observations["depth"][:, 0].double(), rolled.observations["pose"][:, 0].double()
    height, width = depth.shape[1:]
    fx, fy, cx, cy = CAMERA
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    left = -((columns + 0.5) / width - cx) / fx
    up = -((rows + 0.5) / height - cy) / fy
    points = torch.stack([depth[0], depth[0] * left, depth[0] * up], -1).reshape(-1, 3)
    world = points @ rotation(pose[0]).T + pose[0, :3]
    local = (world - pose[-1, :3]) @ rotation(pose[-1])
    u = ((cx - fx * local[:, 1] / local[:, 0]) * width).floor().long()
    v = ((cy - fy * local[:, 2] / local[:, 0]) * height).floor().long()
    seen = (local[:, 0] > 0.1) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    found = depth[-1, v[seen], u[seen]]
    agrees = ((found - local[seen, 0]).abs() / local[seen, 0] < 0.05).double().mean()
    assert seen.double().mean() > 0.4 and agrees > 0.8


def rotation(pose: torch.Tensor) -> torch.Tensor:
    """R_world_cam of a pose that only turns about z."""
    angle = 2 * torch.atan2(pose[6], pose[3])
    cos, sin = torch.cos(angle), torch.sin(angle)
    return torch.stack([torch.stack([cos, -sin, 0 * cos]), torch.stack([sin, cos, 0 * cos]), torch.eye(3).double()[2]])


def test_the_same_seed_tells_the_same_story_and_another_another(game):
    def story(seed):
        rng = make_rng(seed)
        actions = torch.stack([game.spec.sample_action(1, rng) for _ in range(12)])
        return rollout(game, game.start(1, rng), actions, rng, tuple(game.spec.channels)).observations

    first, again, other = story(1), story(1), story(2)
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert not torch.equal(first["pose"], other["pose"])


def test_the_game_cannot_go_back_or_be_many(game):
    rng = make_rng(0)
    left = game.start(1, rng)
    game.imagine(left, press(), rng)
    with pytest.raises(StaleStateError):
        game.imagine(left, press(), rng)
    with pytest.raises(StaleStateError):
        game.render(left, ("rgb",))
    with pytest.raises(TerrellaError):
        game.start(2, rng)


def test_junk_does_not_move_the_game(game):
    rng = make_rng(0)
    state = game.start(1, rng)
    before = game.render(state, ("pose",))["pose"]
    for junk in (torch.zeros(1, 5), torch.full((1, 6), 0.5), torch.full((1, 6), float("nan"))):
        with pytest.raises(ActionError):
            game.imagine(state, junk, rng)
    assert torch.equal(before, game.render(state, ("pose",))["pose"])


def test_what_cannot_be_opened_is_refused_in_one_sentence():
    with pytest.raises(TerrellaError, match="no scenario 'no_such_map'; it has .*my_way_home"):
        Doom(DoomConfig(scenario="no_such_map"))
    with pytest.raises(TerrellaError, match="100x100"):
        Doom(DoomConfig(size=(100, 100)))


def test_nothing_is_left_in_the_working_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    world, rng = Doom(), make_rng(0)
    world.imagine(world.start(1, rng), press("MOVE_FORWARD"), rng)
    world.close()
    assert list(tmp_path.iterdir()) == []
