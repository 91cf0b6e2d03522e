"""Several cameras at once: a recording of three is learned as one wide picture, and the world shows three again that agree."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from gymnasium import spaces

from terrella.core import check_world, make_rng
from terrella.core.errors import ObservationError
from terrella.core.policy import Random
from terrella.core.spec import POSE, REWARD, Camera, Spec
from terrella.core.state import State
from terrella.data import Dataset, RecordOptions, record
from terrella.learn.recipes.video import TrainConfig, train_video
from terrella.learn.recording import Recording, joined_cameras
from terrella.library import load
from terrella.measure.overlap import disagreement, overlaps_of
from terrella.space.camera import rays, relative_pose, rotation
from terrella.space.overlap import Blend, MountedCamera
from terrella.worlds.frame_history import split_pictures
from terrella.worlds.parts import newest_frame

SIZE = (16, 24)
YAWS = {"rgb": 0.0, "rgb.left": math.radians(70), "rgb.right": -math.radians(70)}
FIELD = (0.5, 0.5, 0.5, 0.5)  # 90 degrees wide


def turned(heading: torch.Tensor) -> torch.Tensor:
    """Poses [B, 7] at the origin."""
    half, nothing = heading / 2, torch.zeros_like(heading)
    return torch.stack([nothing, nothing, nothing, half.cos(), nothing, nothing, half.sin()], -1).float()


class Carousel:
    """Three cameras on a disc that an action turns, in a round room of colours that change smoothly with the direction."""

    def __init__(self, turns: float = 0.3, rolls: float = 0.0):
        self.turns = turns  # radians of an action by which the disc turns
        self.rolls = rolls  # the part of its heading by which the left camera turns, too
        channels = {name: spaces.Box(0, 255, (*SIZE, 3), np.uint8) for name in YAWS}
        channels |= {name.replace("rgb", "pose"): POSE for name in YAWS} | {"reward": REWARD}
        cameras = {name: Camera(FIELD, SIZE, name.replace("rgb", "pose")) for name in YAWS}
        self.spec = Spec("carousel", spaces.Box(-1, 1, (1,), np.float32), channels, (), 0.1, cameras=cameras)

    def start(self, batch, rng):
        return State({"heading": 6 * torch.rand(batch, generator=rng)})

    def observe(self, observation, prior, rng):
        return prior

    def imagine(self, state, action, rng):
        return state.replace(heading=state["heading"] + self.turns * action[:, 0])

    def render(self, state, channels):
        shown = {}
        for name in channels:
            kind, _, suffix = name.partition(".")
            if kind == "reward":
                shown[name] = state["heading"].float()
                continue
            pose = turned(state["heading"] + YAWS[f"rgb.{suffix}" if suffix else "rgb"])
            pose = turned(state["heading"] * (1 + self.rolls)) if suffix == "left" and self.rolls else pose
            if kind == "pose":
                shown[name] = pose
                continue
            looks = rays(FIELD, *SIZE).flatten(0, 1) @ rotation(pose).mT
            angle = torch.atan2(looks[..., 1], looks[..., 0])
            waves = torch.stack([(times * angle).cos() for times in (1, 2, 3)], -1)
            shown[name] = (127 + 120 * waves).to(torch.uint8).view(-1, *SIZE, 3)
        return shown


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    out, world = tmp_path_factory.mktemp("ring") / "recording", Carousel()
    record(
        world,
        Random(world.spec, (2, 5)),
        out,
        160,
        make_rng(0),
        options=RecordOptions(pictures="png", max_episode_steps=40),
    )
    return out


def quiet(*_):
    pass


def test_pictures_lie_side_by_side_from_left_to_right(recorded):
    dataset = Dataset(recorded)
    names = joined_cameras(dataset)
    assert names == ("rgb.left", "rgb", "rgb.right")
    ring = Recording.open(dataset, None, quiet, joined=names)
    assert ring.rgb([3]).shape == (1, 3, 16, 72) and ring.ignored == ()
    alone = Recording.open(dataset, None, quiet, cameras=("rgb.left", "rgb.right"))
    assert torch.equal(ring.rgb([3])[..., 24:48], alone.rgb([3]))
    assert np.array_equal(ring.cache.rgb[3, :, 48:], alone.cache.arrays[dataset.feature("rgb.right")][3])
    yaws = [2 * math.atan2(lens.mount[6], lens.mount[3]) for lens in ring.lenses().values()]
    np.testing.assert_allclose(yaws, [YAWS[name] for name in names], atol=1e-5)


@pytest.mark.parametrize(
    "world", [Carousel(rolls=0.5), Carousel(turns=0.0)], ids=["one turns by itself", "all stand still"]
)
def test_cameras_that_no_body_carries_are_not_made_to_agree(world, tmp_path):
    state = world.start(1, make_rng(0))
    world.start = lambda batch, rng: state  # one place in all episodes
    options = RecordOptions(pictures="png", max_episode_steps=40)
    record(world, Random(world.spec, (2, 5)), tmp_path, 80, make_rng(0), options=options)
    dataset = Dataset(tmp_path)
    ring = Recording.open(dataset, None, quiet, joined=joined_cameras(dataset))
    assert len(ring.cameras) == 3 and ring.lenses() == {}


def test_a_world_of_three_cameras_is_learned_saved_and_plays(recorded, tmp_path):
    config = TrainConfig(steps=3, outcome_steps=2, uncertainty_frames=0, estimator_steps=0, batch=2, channels=(8, 8, 8))
    train_video(recorded, tmp_path, config, quiet)
    world = load(tmp_path)
    check_world(world)
    assert world.spec.observes == ("rgb.left", "rgb", "rgb.right") and world.spec.channels["rgb.left"].shape == (
        16,
        24,
        3,
    )
    assert world.outcome.config.side == 3 * 64, "its outcome sees each picture as large as that of a single camera"
    blend = world.generator.blend
    assert blend.own.shape == (16, 72) and (blend.own < 1).any(), "its drawn pictures are made to agree"
    given = {name: torch.full((1, *SIZE, 3), value, dtype=torch.uint8) for value, name in enumerate(world.cameras)}
    state = world.observe(given, None, make_rng(0))
    shown = world.render(state, ("rgb.right", "rgb"))
    assert (shown["rgb.right"] == 2).all() and (shown["rgb"] == 1).all() and newest_frame(state).shape == (1, 3, 16, 72)
    with pytest.raises(ObservationError, match=r"rgb\.left and rgb and rgb\.right"):
        world.observe({"rgb": given["rgb"]}, None, make_rng(0))
    assert len(overlaps_of(world.spec, world.cameras)) == 2, "left and right do not overlap"


def test_views_of_one_room_agree_where_they_overlap():
    world = Carousel()
    mounts = {name: Camera(FIELD, SIZE, None, tuple(turned(torch.tensor(yaw)).tolist())) for name, yaw in YAWS.items()}
    spec = Spec("ring", world.spec.action, world.spec.channels, (), 0.1, cameras=mounts)
    pairs = overlaps_of(spec, tuple(YAWS))
    assert {(pair.one, pair.other) for pair in pairs} == {("rgb", "rgb.left"), ("rgb", "rgb.right")}
    assert not overlaps_of(world.spec, tuple(YAWS)), "each is mounted on a body of its own"
    state = world.start(4, make_rng(0))
    seen = world.render(state, tuple(YAWS))
    for pair in pairs:
        share = pair.seen.float().mean()
        assert 0.1 < share < 0.35
        same = disagreement(seen[pair.one], seen[pair.other], pair)
        other = disagreement(seen[pair.one], seen[pair.other].roll(1, 0), pair)
        assert (same < 3).all() and other.mean() > 10 * same.mean()


def test_blended_pictures_agree_where_views_overlap_and_stay_elsewhere():
    mounts = {name: tuple(turned(torch.tensor(yaw)).tolist()) for name, yaw in YAWS.items()}
    names = ("rgb.left", "rgb", "rgb.right")
    blend = Blend([MountedCamera(FIELD, mounts[name]) for name in names], SIZE)
    colours = torch.nn.functional.interpolate(torch.rand(2, 3, 4, 18, generator=make_rng(0)), (16, 72), mode="bicubic")
    pictures, blended = 255 * colours, blend(255 * colours)
    assert (
        torch.equal(blended[..., blend.own == 1], pictures[..., blend.own == 1])
        and 0.2 < (blend.own < 1).float().mean() < 0.5
    )
    spec = Spec("ring", Carousel().spec.action, Carousel().spec.channels, (), 0.1, cameras={
        name: Camera(FIELD, SIZE, None, mounts[name]) for name in names
    })  # fmt: skip
    pairs = overlaps_of(spec, names)
    before, after = (
        torch.stack([disagreement(shown[pair.one], shown[pair.other], pair) for pair in pairs])
        for shown in (split_pictures(each.permute(0, 2, 3, 1), names) for each in (pictures, blended))
    )
    assert (after < 0.3 * before).all()
    noise = torch.randn(64, 3, 16, 72, generator=make_rng(1))
    shared = blend.noise(noise)
    assert (shared.std(0) > 0.5).all() and abs(float(shared.std()) - 1) < 0.02
    assert (shared != noise).any() and torch.isin(shared, noise).all()


def test_relative_poses_undo_the_body():
    body, camera = turned(torch.tensor(0.4)), turned(torch.tensor(1.1))
    body[:3], camera[:3] = torch.tensor([1.0, 2.0, 0.0]), torch.tensor([1.0, 3.0, 0.5])
    relative = relative_pose(body, camera)
    np.testing.assert_allclose(
        relative, [math.sin(0.4), math.cos(0.4), 0.5, math.cos(0.35), 0, 0, math.sin(0.35)], atol=1e-6
    )
