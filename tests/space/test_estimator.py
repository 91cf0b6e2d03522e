"""An estimator: the shape and range of its answers, its mirror, its file; and places recognised in a room known exactly."""

from __future__ import annotations

import math

import pytest
import torch

from terrella.core import make_rng
from terrella.core.errors import CheckpointError
from terrella.space.camera import yaw
from terrella.space.estimator import Estimator, EstimatorConfig, load_estimator, normalise, save_estimator
from terrella.space.keyframes import Keyframes
from terrella.space.recognise import recognise, thumbnails

from .rooms import CAMERA, painted, pose_at, room_depth


@pytest.fixture
def estimator():
    torch.manual_seed(0)
    return Estimator(EstimatorConfig((48, 64), near_m=0.3, far_m=20.0)).eval().requires_grad_(False)


def pictures(count: int, height: int = 48, width: int = 64, seed: int = 0) -> torch.Tensor:
    return torch.randint(0, 256, (count, 3, height, width), generator=make_rng(seed), dtype=torch.uint8)


@pytest.mark.parametrize("shape", [(48, 64), (96, 128), (30, 70), (5, 4)])
def test_pictures_of_any_size_are_answered_at_their_own(estimator, shape):
    rgb = pictures(2, *shape)
    depth = estimator.depth(rgb)
    assert depth.shape == (2, *shape) and depth.dtype == torch.float32
    assert estimator.motion(rgb, rgb).shape == (2, 3) and estimator.strangeness(rgb).shape == (2,)


@pytest.mark.parametrize("value", [0, 255])
def test_depth_stays_within_the_range_of_the_recordings_whatever_is_shown(estimator, value):
    with torch.no_grad():
        for bias in (-1000.0, 1000.0):
            estimator.output.bias.fill_(bias)
            depth = estimator.depth(torch.full((1, 3, 48, 64), value, dtype=torch.uint8))
            assert torch.isfinite(depth).all() and depth.min() >= 0.3 and depth.max() <= 20.0


def test_exposure_and_white_balance_change_nothing(estimator):
    rgb = pictures(1).float() / 255
    plain = normalise(rgb)
    tinted = normalise(rgb * torch.tensor([0.9, 0.5, 0.7])[:, None, None] + 0.05)
    assert torch.allclose(plain, tinted, atol=0.12)


def test_a_depth_that_is_known_is_taken(estimator):
    first, second = pictures(1), pictures(1, seed=1)
    seen = estimator.motion(first, second)
    assert torch.allclose(estimator.motion(first, second, estimator.depth(first)), seen, atol=1e-3)


def test_motion_is_that_between_two_views_of_a_room(estimator):
    before, after = pose_at(0.0, 0.0, 0.5), pose_at(0.15, 0.08, 0.53)
    estimator.pace.copy_(torch.tensor([0.2, 0.1, 0.08]))
    pictures = [painted(pose, room_depth(pose, (96, 128))) for pose in (before, after)]
    found = estimator.motion(*pictures, room_depth(before, (96, 128)))
    assert torch.allclose(found[0], torch.tensor([0.170, -0.002, 0.03]), atol=0.02), found


def test_what_is_usual_is_learned(estimator):
    grey = (128 + 10 * torch.randn(300, 3, 48, 64, generator=make_rng(0))).clamp(0, 255).to(torch.uint8)
    estimator.learn_usual(estimator.looks(grey))
    strange = estimator.strangeness(grey)
    assert float((strange < 1).float().mean()) == pytest.approx(0.99, abs=0.01)
    assert float(estimator.strangeness(pictures(1))) > 1.5


def test_an_estimator_is_kept_in_half_precision_and_comes_back(estimator, tmp_path):
    estimator.learn_usual(estimator.looks(pictures(40)))
    save_estimator(estimator, tmp_path / "estimator.safetensors")
    again = load_estimator(tmp_path / "estimator.safetensors")
    rgb = pictures(1)
    assert again.config == estimator.config
    assert torch.allclose(again.depth(rgb).log(), estimator.depth(rgb).log(), atol=0.02)
    assert torch.allclose(again.strangeness(rgb), estimator.strangeness(rgb), rtol=0.02)


def test_what_is_no_estimator_is_refused(tmp_path):
    (tmp_path / "a.safetensors").write_bytes(b"nothing")
    for name in ("a.safetensors", "missing.safetensors"):
        with pytest.raises(CheckpointError, match="no estimator"):
            load_estimator(tmp_path / name)
    from terrella.core import State

    State({"a": torch.ones(1)}).save(tmp_path / "state.safetensors")
    with pytest.raises(CheckpointError, match="no estimator"):
        load_estimator(tmp_path / "state.safetensors")


@pytest.fixture(scope="module")
def room():
    """A room, seen from four places in eight directions."""
    places = [(x, y, h * math.pi / 4) for x in (-2.0, 1.0) for y in (-1.5, 2.0) for h in range(8)]
    pose = torch.cat([pose_at(*place) for place in places])
    depth = room_depth(pose)
    memory = Keyframes.of(painted(pose, depth), depth, pose, CAMERA)
    return memory, thumbnails(memory.rgb)


@pytest.mark.parametrize("place", [(-1.8, -1.2, 0.2), (1.2, 2.1, 2.2), (0.6, -1.6, -2.0)])
def test_a_picture_of_a_remembered_place_is_found_there(room, place):
    memory, small = room
    pose = pose_at(*place)
    found = recognise(painted(pose, room_depth(pose))[0], memory, small, CAMERA, 6)
    assert found is not None and found.likeness > 0.95 and found.known > 0.9
    assert float((found.pose[:2] - pose[0, :2]).norm()) < 0.25
    turned = yaw(found.pose) - yaw(pose[0])
    assert abs(float(torch.atan2(turned.sin(), turned.cos()))) < 0.06


def test_a_picture_of_elsewhere_is_like_nothing(room):
    memory, small = room
    found = recognise(pictures(1)[0], memory, small, CAMERA, 6)
    assert found is not None and found.likeness < 0.5 and found.edges < 0.3


def test_an_empty_memory_recognises_nothing(room):
    memory, small = room
    assert recognise(pictures(1)[0], memory.at(slice(0, 0)), small[:0], CAMERA, 6) is None
