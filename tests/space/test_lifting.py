"""One picture as a place: the lifter's network, two layers as Gaussians, and `terrella space lift` with pictures of all kinds."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

import terrella
from terrella.cli import main
from terrella.core.errors import CheckpointError, TerrellaError
from terrella.learn.objectives.lifting import LayeredPictures, LiftingObjective
from terrella.learn.train_step import TrainStep
from terrella.space.camera import FAR_M, rotation
from terrella.space.kernels_numba import shapes as kernels
from terrella.space.kernels_numba.light import first_box
from terrella.space.lifting import layers as layers_module
from terrella.space.lifting.layers import PictureLayers, floor_height, layers_of, levelled, to_gaussians
from terrella.space.lifting.network import Lifter, LifterConfig, load_lifter, save_lifter
from terrella.space.lifting.prior import fitted_depth
from terrella.space.lifting.scenes import rotation_of
from terrella.space.raster import rasterise
from terrella.workflows.lift_space import doubts, expected_error, place_of
from terrella.workflows.splat_places import open_splat

TINY = LifterConfig(32, (8, 8, 16, 16))


def a_box_before_a_wall(height=48, width=64, pitch=-0.2) -> PictureLayers:
    """A red box 2 m away before a green wall 4 m away, over a grey floor 1.5 m below the camera."""
    focal, high = 0.5, 1.5
    blank = torch.zeros(height, width)
    layers = PictureLayers(torch.zeros(3, height, width), blank, blank, blank, blank, blank, focal, pitch, 0.0, high)
    way = torch.stack(torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij"), -1) + 0.5
    long = focal * max(height, width)
    local = torch.stack(
        [torch.ones(height, width), (width / 2 - way[..., 1]) / long, (height / 2 - way[..., 0]) / long], -1
    )
    world = local @ layers.turn.T
    wall = 4 / world[..., 0]
    floor = torch.where(world[..., 2] < 0, -high / world[..., 2], torch.inf)
    far = torch.minimum(wall, floor)
    near = 2 / world[..., 0]
    box = ((near * world[..., 1]).abs() < 0.5) & ((near * world[..., 2]).abs() < 0.4) & (near < far)
    colour = torch.where(
        box, torch.tensor([0.9, 0.1, 0.1])[:, None, None], torch.tensor([0.1, 0.8, 0.1])[:, None, None]
    )
    ground = (floor < wall) & ~box
    colour = torch.where(ground, torch.tensor([0.5, 0.5, 0.5])[:, None, None], colour)
    back = torch.where((floor < wall)[None], torch.full((3, 1, 1), 0.5), torch.tensor([0.1, 0.8, 0.1])[:, None, None])
    depth = torch.where(box, near, far)
    half = slice(None, None, 2)
    return replace(
        layers,
        rgb=colour,
        depth=depth,
        behind=far[half, half],
        hides=box[half, half].float(),
        behind_rgb=back[:, half, half],
    )


def test_rays_meet_boxes_as_those_of_layouts_do_and_round_shapes_where_they_are():
    rng = np.random.default_rng(0)
    low = rng.uniform(-3, 2, (12, 3))
    boxes = np.concatenate([low, low + rng.uniform(0.2, 2, (12, 3))], 1)
    shapes = np.zeros((12, 20), np.float32)
    shapes[:, 1:4], shapes[:, 4:7], shapes[:, 7] = (
        (boxes[:, :3] + boxes[:, 3:]) / 2,
        (boxes[:, 3:] - boxes[:, :3]) / 2,
        1,
    )
    bounds = np.array([[*s[1:4], np.linalg.norm(s[4:7]), k, k + 1] for k, s in enumerate(shapes)], np.float32)
    hits = 0
    for way in rng.normal(0, 1, (200, 3)) + [2, 0, 0]:
        expected, far, _ = first_box(-4.0, 0.1, 0.2, way[0], way[1], way[2], boxes, 1e9)
        which, near, *normal = kernels.trace(shapes, bounds, -4.0, 0.1, 0.2, way[0], way[1], way[2], 1e-4, 1e9)
        assert which == expected and (which < 0 or abs(near - far) < 1e-4 * far)
        hits += which >= 0
        assert which < 0 or abs(np.linalg.norm(normal) - 1) < 1e-5 and np.dot(normal, way) < 0
    assert hits > 20
    turned = shapes[:1].copy()  # a cube of 2 m, 5 m ahead
    turned[0, 1:4], turned[0, 4:7] = [5, 0, 0], 1
    around = np.array([[5, 0, 0, 2, 0, 1]], np.float32)
    for kind, angle, far in (
        (kernels.BOX, math.pi / 4, 5 - 2**0.5),
        (kernels.CYLINDER, 0, 4),
        (kernels.ELLIPSOID, 0, 4),
    ):
        turned[0, 0], turned[0, 7:9] = kind, [math.cos(angle), math.sin(angle)]
        assert kernels.trace(turned, around, 0.0, 1e-3, 1e-3, 1.0, 0.0, 0.0, 1e-4, 1e9)[1] == pytest.approx(
            far, abs=0.01
        )
    turned[0, 0] = kernels.CYLINDER
    which, far, *normal = kernels.trace(turned, around, 5.2, 0.1, 4.0, 0.0, 0.0, -1.0, 1e-4, 1e9)  # on its lid
    assert far == pytest.approx(3) and normal == pytest.approx([0, 0, 1])


def test_a_place_shows_its_picture_and_behind_the_box_what_was_not_seen():
    layers = a_box_before_a_wall()
    gaussians, seen = to_gaussians(layers)
    assert int(seen.sum()) == 48 * 64 and int((~seen).sum()) == int((layers.hides > 0).sum())
    drawn = rasterise(gaussians, layers.pose[None], layers.camera, (48, 64))
    assert float((drawn.rgb[0] - layers.rgb).abs().mean()) < 0.02
    assert float((drawn.depth[0] / drawn.alpha[0] / layers.depth - 1).abs().median()) < 0.02
    aside = layers.pose.clone()
    aside[1] += 0.4  # to the left: the wall left of the box shows more, right of it less
    both, one = (
        rasterise(to_gaussians(layers, two=two)[0], aside[None], layers.camera, (48, 64)) for two in (True, False)
    )
    holes = (one.alpha[0] < 0.3) & (both.alpha[0] > 0.7)
    assert int(holes.sum()) > 10 and float(both.rgb[0][1][holes].mean()) > 0.5  # green, or the grey floor


def test_the_frame_is_metric_with_the_floor_at_zero():
    layers = a_box_before_a_wall()
    assert floor_height(layers) == pytest.approx(1.5, rel=0.03)
    means = to_gaussians(layers)[0].means
    assert float(means[:, 2].min()) == pytest.approx(0, abs=0.03) and float(means[:, 0].max()) == pytest.approx(
        4, abs=0.05
    )
    turn = rotation(layers.pose)
    assert torch.allclose(turn, torch.from_numpy(rotation_of(0, -0.2, 0)).float(), atol=1e-5)
    assert floor_height(replace(layers, depth=torch.full((48, 64), 3.0), pitch=0.0)) is None  # a wall has no floor


def test_a_wrong_tilt_is_corrected_by_the_floor():
    layers = a_box_before_a_wall()
    level = levelled(replace(layers, pitch=-0.14, roll=0.05, height_m=1.0))
    assert level.pitch == pytest.approx(-0.2, abs=0.01) and level.roll == pytest.approx(0, abs=0.01)
    assert level.height_m == pytest.approx(1.5, rel=0.03)
    assert levelled(replace(layers, pitch=0.3)).pitch == 0.3  # too far off to be this floor


def test_quaternions_are_those_of_their_frames():
    frames = torch.linalg.qr(torch.randn(50, 3, 3, generator=torch.Generator().manual_seed(0)))[0]
    frames = frames * frames.det()[:, None, None]
    quats = layers_module._quaternions(frames)
    assert torch.allclose(rotation(torch.cat([torch.zeros(50, 3), quats], 1)), frames, atol=1e-5)


def test_bodies_stop_at_the_box_of_a_picture_and_stand_on_its_floor():
    world = place_of(a_box_before_a_wall(), "box", {})
    places = world.places[world.places[:, 3] > 0]
    assert len(places) > 8 and float(places[:, 0].max()) > 0.7  # from below the camera, where the floor is invented
    layers = a_box_before_a_wall()
    drawn = rasterise(world.gaussians, layers.pose[None], layers.camera, (48, 64))  # it does not cover the picture
    assert float((drawn.rgb[0] - layers.rgb).abs()[:, -6:].mean()) < 0.02
    state = world.start(1, terrella.make_rng(0))
    ahead = torch.zeros(1, 8, dtype=torch.int8)
    ahead[0, 0] = 1
    for step in range(60):
        state = world.imagine(state, ahead, terrella.make_rng(step))
    assert 1.2 < float(state["pose"][0, 0]) < 2.05 and float(state["pose"][0, 2]) == pytest.approx(1.5, abs=0.1)


@pytest.fixture(scope="module")
def lifter() -> Lifter:
    torch.manual_seed(0)
    return Lifter(TINY).eval()


@pytest.mark.parametrize("size", [(40, 60), (61, 33), (32, 128), (90, 90)])
def test_pictures_of_any_size_have_layers_and_mirrored_ones_mirrored_layers(lifter, size):
    picture = np.random.default_rng(0).integers(0, 255, (*size, 3), np.uint8)
    one, other = layers_of(picture, lifter), layers_of(np.ascontiguousarray(picture[:, ::-1]), lifter)
    assert one.depth.shape == size and one.behind.shape == (-(-size[0] // 2), -(-size[1] // 2)) == one.hides.shape
    assert bool(one.depth.isfinite().all()) and float((one.depth[::2, ::2] <= one.behind).float().mean()) == 1
    if size[1] % 32 == 0:
        assert torch.allclose(one.depth, other.depth.flip(-1), rtol=1e-3) and one.roll == pytest.approx(
            -other.roll, abs=1e-4
        )


def test_a_known_lens_and_height_are_kept(lifter):
    picture = np.random.default_rng(0).integers(0, 255, (32, 32, 3), np.uint8)
    free, wide = layers_of(picture, lifter), layers_of(picture, lifter, focal=0.4, height_m=3.0)
    assert wide.camera[0] == pytest.approx(0.4) and wide.height_m == 3.0
    ratio = wide.depth / free.depth
    assert float(ratio.std()) < 1e-3 * float(ratio.mean())


def test_weights_are_read_back_and_foreign_files_refused(lifter, tmp_path):
    save_lifter(lifter, tmp_path / "l.safetensors")
    picture = torch.rand(1, 3, 32, 32)
    again = load_lifter(tmp_path / "l.safetensors")
    assert torch.allclose(again(picture).near, lifter(picture).near, atol=0.02)
    (tmp_path / "other.safetensors").write_bytes(b"no weights")
    with pytest.raises(CheckpointError, match="no lifter"):
        load_lifter(tmp_path / "other.safetensors")


def test_the_error_to_expect_is_the_one_that_was_measured_with_the_weights(tmp_path):
    measured = load_lifter().measured
    assert set(measured) == {"rooms", "Doom's maps", "tables"} and 0.03 < measured["rooms"] < measured["tables"] < 1
    assert "28% of rooms" in expected_error({"rooms": 0.279}) and "may be anything" in expected_error({"rooms": 0.279})
    save_lifter(Lifter(TINY), tmp_path / "l.safetensors")
    assert "not measured" in expected_error(load_lifter(tmp_path / "l.safetensors").measured)


def test_lifted_depth_fills_what_stereo_leaves_open():
    layers = a_box_before_a_wall()
    truth, lifted = layers.depth, 0.4 * layers.depth * torch.linspace(0.9, 1.1, 64)
    sparse = torch.where(torch.rand(48, 64, generator=torch.Generator().manual_seed(0)) < 0.2, truth, FAR_M)
    sparse[:, :20] = 0.0
    fitted = fitted_depth(lifted, sparse)
    assert fitted is not None and float((fitted / truth - 1).abs().mean()) < 0.03
    assert fitted_depth(lifted, torch.zeros(48, 64)) is None
    noise = torch.rand(48, 64, generator=torch.Generator().manual_seed(1)) * 50 + 0.1
    assert fitted_depth(lifted, noise) is None  # it fits nowhere


def shard(file, seed=0, count=8):
    rng = np.random.default_rng(seed)
    depth = np.broadcast_to(rng.uniform(1, 5, (count, 1, 1)), (count, 64, 64)).astype(np.float16)
    rgb = np.broadcast_to((depth[..., None] * 40).astype(np.uint8), (count, 64, 64, 3))
    lens = np.tile(np.array([0.8, 0, 0, np.nan], np.float32), (count, 1))
    behind = (depth[:, ::2, ::2] * 1.5).astype(np.float16)
    np.savez(file, rgb=rgb, depth=depth, behind=behind, behind_rgb=rgb[:, ::2, ::2], lens=lens)


def step_at(number, share) -> TrainStep:
    return TrainStep(number, share, torch.device("cpu"), np.random.default_rng(number), terrella.make_rng(number))


def test_batches_are_coarse_at_first_and_a_step_lowers_the_errors(tmp_path):
    shard(tmp_path / "a.npz")
    pictures = LayeredPictures(tmp_path)
    early, late = pictures.batch(2, step_at(0, 0.0)), pictures.batch(2, step_at(0, 0.9))
    assert len(early["rgb"]) == 4 and max(early["rgb"].shape) == 32 and max(late["rgb"].shape) == 64
    assert early["behind"].shape[-1] * 2 == early["depth"].shape[-1] == early["rgb"].shape[-1]
    torch.manual_seed(0)
    objective = LiftingObjective(TINY, 1e-2)
    optimiser, values = objective.learners["lifter"].optimiser, []
    for number in range(6):
        (loss,) = objective.losses(early, step_at(number, 0.0))
        values.append(float(loss.value.detach()))
        optimiser.zero_grad()
        loss.value.backward()
        optimiser.step()
    assert values[-1] < 0.95 * values[0] and bool(loss.parts["height"].isfinite())  # no height is known


def picture_file(path, size=(96, 64), **save):
    x, y = np.meshgrid(np.linspace(0, 255, size[0]), np.linspace(0, 255, size[1]))
    Image.fromarray(np.stack([x, y, 255 - x], -1).astype(np.uint8)).save(path, **save)
    return path


def lifted(path, tmp_path, capsys, *more):
    code = main(["space", "lift", str(path), "--out", str(tmp_path / "place"), "--longest", "64", "--json", *more])
    text = capsys.readouterr()
    return code, json.loads(text.out[text.out.index("{") :]) if code == 0 else text.err


def test_a_picture_becomes_a_place_that_opens(tmp_path, capsys):
    code, facts = lifted(picture_file(tmp_path / "a.png"), tmp_path, capsys)
    assert code == 0 and facts["seen"] == 64 * 43 and facts["gaussians"] == facts["seen"] + facts["invented"]
    world = open_splat(str(tmp_path / "place"))
    assert world.card["picture"] == "a.png" and "floor at 0" in world.card["axes"]
    assert int((world.provenance == 1).sum()) == facts["seen"] and float(world.starts[0, 2]) == pytest.approx(
        facts["height_m"], abs=0.01
    )
    seen = world.render(world.start(1, terrella.make_rng(0)), ("rgb", "depth"))
    assert seen["rgb"].shape == (1, 172, 256, 3) and float((seen["depth"] > 0).float().mean()) > 0.9


def test_one_function_makes_places_of_all_sources(tmp_path):
    picture = picture_file(tmp_path / "a.png")
    facts = terrella.generate_place(
        tmp_path / "p", image=picture, config=terrella.LiftSpaceConfig(longest=64, eye=2.0)
    ).facts
    assert facts["height_m"] == 2.0 and float(open_splat(str(tmp_path / "p")).starts[0, 2]) == 2.0
    small = terrella.BuildSpaceConfig(gaussians=1000, size=(24, 32))
    assert terrella.generate_place(tmp_path / "t", text="a tiny room", config=small).facts["rooms"] == 1
    with pytest.raises(TerrellaError, match="give one of"):
        terrella.generate_place(tmp_path / "x", text="a room", image=picture)
    with pytest.raises(TerrellaError, match="got 0"):
        terrella.generate_place(tmp_path / "x")
    with pytest.raises(TerrellaError, match="pictures|sharp"):  # a fit needs several
        terrella.generate_place(tmp_path / "x", images=tmp_path)
    with pytest.raises(TerrellaError, match="LiftSpaceConfig"):
        terrella.generate_place(tmp_path / "x", image=picture, config=small)


def test_photographs_of_all_kinds(tmp_path, capsys):
    exif = Image.Exif()
    exif[274] = 6  # lies on its side
    turned = lifted(picture_file(tmp_path / "t.jpg", exif=exif), tmp_path, capsys)[1]
    assert turned["seen"] == 64 * 43
    world = open_splat(str(tmp_path / "place"))
    assert world.spec.cameras["rgb"].size[0] > world.spec.cameras["rgb"].size[1]
    clear = Image.fromarray(np.random.default_rng(0).integers(0, 255, (64, 64, 4), np.uint8), "RGBA")
    clear.save(tmp_path / "c.png")
    assert lifted(tmp_path / "c.png", tmp_path, capsys)[0] == 0
    frames = [Image.fromarray(np.full((64, 64), 60 * k, np.uint8)) for k in range(3)]
    frames[0].save(tmp_path / "g.gif", save_all=True, append_images=frames[1:])
    assert any("first of its 3 frames" in note for note in lifted(tmp_path / "g.gif", tmp_path, capsys)[1]["notes"])


def test_what_cannot_be_lifted_is_refused_in_one_sentence_and_nothing_is_written(tmp_path, capsys):
    (tmp_path / "text.png").write_text("no picture")
    (tmp_path / "many").mkdir()
    picture_file(tmp_path / "many" / "a.png")
    (tmp_path / "empty").mkdir()
    long = picture_file(tmp_path / "long.png", (1280, 64))
    cut_short, clear = picture_file(tmp_path / "cut.jpg"), tmp_path / "clear.png"
    cut_short.write_bytes(cut_short.read_bytes()[:-200])
    Image.new("RGBA", (64, 64)).save(clear)
    for path, words in (
        (tmp_path / "text.png", "cannot be read"),
        (tmp_path / "none.png", "does not exist; check the path"),
        (long, "20 times as wide as it is high"),
        (cut_short, "incomplete: the file ends"),
        (clear, "transparent throughout"),
        (tmp_path / "many", "terrella space fit"),
        (tmp_path / "empty", "a folder without pictures"),
    ):
        code, error = lifted(path, tmp_path, capsys)
        assert code != 0 and words in error and not (tmp_path / "place").exists()
    code, error = lifted(picture_file(tmp_path / "a.png"), tmp_path, capsys, "--fov", "200")
    assert code != 0 and "--fov" in error


def test_a_plain_wall_is_named_with_its_measured_reason():
    layers = a_box_before_a_wall()
    assert doubts(replace(layers, error=torch.full((48, 64), 0.1))) == []
    flat = replace(layers, depth=torch.full((48, 64), 2.0), error=torch.full((48, 64), 0.4))
    assert "1.00 times" in doubts(flat)[0] and "40%" in doubts(flat)[1]
    assert "contrast 0.000" in doubts(replace(flat, rgb=torch.full((3, 48, 64), 0.5)))[0]


def test_a_page_of_text_and_a_fisheye_are_named():
    page = torch.ones(3, 48, 64)
    page[:, 10:14:2, 5:60] = 0
    layers = replace(a_box_before_a_wall(), rgb=page, error=torch.full((48, 64), 0.1))
    assert doubts(layers)[0].startswith("96% of the picture is one colour")
    row, column = torch.meshgrid(torch.arange(48) - 24, torch.arange(64) - 32, indexing="ij")
    circle = torch.rand(3, 48, 64, generator=torch.Generator().manual_seed(0)) * (row**2 + column**2 < 24**2)
    assert "fisheye" in doubts(replace(layers, rgb=circle))[0]
    cut_out = replace(layers, rgb=circle, opaque=circle.amax(0) > 0)
    assert not any("fisheye" in one for one in doubts(cut_out))


def test_nothing_stands_where_a_picture_is_transparent(tmp_path, capsys):
    rgb = np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8)
    alpha = np.full((64, 64), 255, np.uint8)
    alpha[:, :16] = 0
    exif = Image.Exif()
    exif[274] = 6  # the transparent left comes to lie above
    Image.fromarray(np.dstack([rgb, alpha])).save(tmp_path / "cut.png", exif=exif)
    facts = lifted(tmp_path / "cut.png", tmp_path, capsys)[1]
    assert facts["seen"] == 48 * 64 and "25% of the picture is transparent: nothing stands there." in facts["notes"]
    world = open_splat(str(tmp_path / "place"))
    depth = world.render(world.start(1, terrella.make_rng(0)), ("depth",))["depth"][0]
    high = depth.shape[0]
    assert float((depth[: high // 5] > 0).float().mean()) < 0.05 < 0.9 < float((depth[high // 2 :] > 0).float().mean())


def test_dark_pictures_and_views_from_above_are_named():
    layers = replace(a_box_before_a_wall(), error=torch.full((48, 64), 0.1))
    assert "5% of white" in doubts(replace(layers, rgb=layers.rgb / layers.rgb.max() * 0.05))[0]
    assert "50 degrees down" in doubts(replace(layers, pitch=math.radians(-50)))[0]
    assert doubts(replace(layers, pitch=math.radians(-30))) == []
