"""Panoramas in and out: views cut and brought into agreement, closure, `space lift --panorama` and `space export --at`."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch
from PIL import Image

import terrella
from terrella.cli import main
from terrella.space.camera import FAR_M, directions
from terrella.space.lifting import panorama
from terrella.space.lifting.network import Lifter, LifterConfig
from terrella.space.lifting.panorama import (
    PanoramaLayers,
    cut,
    offsets,
    panorama_gaussians,
    panorama_layers,
    view_turns,
    wraps,
)  # fmt: skip
from terrella.space.raster import rasterise
from terrella.space.raster.move import quaternion_of
from terrella.worlds.splat import SplatWorld

SIZE = torch.tensor([3.0, 2.0, 1.2])  # half a room, in metres


def room(height=64) -> PanoramaLayers:
    """A room with smooth walls, seen from its middle."""
    ways = directions(height)
    distance = (SIZE / ways.abs().clamp_min(1e-6)).amin(-1)
    colours = (0.5 + 0.4 * torch.sin(2 * distance[..., None] * ways)).permute(2, 0, 1)
    half = distance[::2, ::2]
    return PanoramaLayers(
        colours, distance, 2 * half, 0 * half, colours[:, ::2, ::2], 0 * distance, 0 * distance.long(), 1.2
    )


def test_a_panorama_is_drawn_again_from_its_middle():
    layers = room()
    gaussians, seen = panorama_gaussians(layers)
    assert bool(seen.all()) and 0.5 < len(gaussians) / layers.distance.numel() < 0.85  # fewer at the poles
    drawn = rasterise(gaussians, torch.tensor([[0, 0, 1.2, 1, 0, 0, 0]]), None, (64, 128))
    assert float(drawn.alpha.min()) > 0.9
    assert -10 * math.log10(float((drawn.rgb[0] - layers.rgb).square().mean())) > 28
    assert float((drawn.depth[0] / drawn.alpha[0] / layers.distance - 1).abs().mean()) < 0.03
    assert float(gaussians.means[:, 2].min()) == pytest.approx(0, abs=0.02)


def test_views_of_a_panorama_are_those_of_a_camera_that_is_turned():
    layers = room(128)
    gaussians = panorama_gaussians(layers)[0]
    for turn in view_turns()[3::7]:
        pose = torch.cat([torch.tensor([0, 0, 1.2]), quaternion_of(turn)])
        drawn = rasterise(gaussians, pose[None], (0.5, 0.5, 0.5, 0.5), (48, 48)).rgb[0].permute(1, 2, 0)
        seen = torch.from_numpy(cut(layers.rgb, turn, 48)).float() / 255
        assert float((drawn - seen).abs().mean()) < 0.03


def test_views_of_other_scales_and_tilts_come_to_agree():
    layers = room(48)
    ways, turns = directions(48), view_turns()
    grids = torch.stack([panorama._where(ways, turn) for turn in turns])
    weights = (1 - grids.abs().amax(-1)).clamp_min(0)
    rng = torch.Generator().manual_seed(0)
    off = 0.3 * torch.randn(len(turns), generator=rng)[:, None, None] + 0.05 * grids[..., 0]
    logs = layers.distance.log() + off

    def apart(values):
        mean = (weights * values).sum(0) / weights.sum(0).clamp_min(1e-6)
        return float((weights * (values - mean).abs()).sum() / weights.sum())

    assert apart(logs + offsets(logs, weights, grids)) < 0.2 * apart(logs)


def test_a_network_lifts_a_panorama_all_around():
    torch.manual_seed(0)
    lifter = Lifter(LifterConfig(32, (8, 8, 16, 16))).eval()
    picture = (255 * room(64).rgb.permute(1, 2, 0)).byte().numpy()
    layers = panorama_layers(picture, lifter, height_m=1.7)
    assert layers.distance.shape == (64, 128) and layers.behind.shape == (32, 64) and layers.height_m == 1.7
    assert bool(((layers.distance > 0) & (layers.distance < FAR_M)).all())
    step = layers.distance.log().diff(dim=0).abs()
    assert float(step.max()) < 0.7 and float((layers.view >= 0).float().mean()) > 0.8


def test_panoramas_are_told_from_wide_pictures():
    picture = (255 * room(64).rgb.permute(1, 2, 0)).byte().numpy()
    assert wraps(picture) and not wraps(picture[:, :120])
    slope = np.broadcast_to(np.linspace(0, 255, 128)[None, :, None], (64, 128, 3)).astype(np.uint8)
    assert not wraps(slope)  # 2:1, but its edges do not meet


def test_a_wide_picture_that_could_be_a_panorama_is_said_to_be_none(tmp_path):
    slope = np.broadcast_to(np.linspace(0, 255, 128)[None, :, None], (64, 128, 3)).astype(np.uint8)
    Image.fromarray(slope).save(tmp_path / "a.png")
    small = terrella.LiftSpaceConfig(longest=64)
    facts = terrella.generate_place(tmp_path / "place", image=tmp_path / "a.png", config=small).facts
    assert "edges do not meet (--panorama" in facts["notes"][0]


@pytest.mark.exact
def test_panoramas_go_in_and_come_out(tmp_path, capsys):
    picture = (255 * room(160).rgb.permute(1, 2, 0)).byte().numpy()
    Image.fromarray(picture).save(tmp_path / "all.png")
    options = ["--out", str(tmp_path / "place"), "--longest", "128", "--eye", "1.6", "--json"]
    assert main(["space", "lift", str(tmp_path / "all.png"), *options]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["panorama"] and "2:1" in facts["notes"][0] and facts["height_m"] == 1.6
    world = terrella.load(tmp_path / "place")
    assert isinstance(world, SplatWorld) and len(world.starts) == 8 and world.card["panorama"] == "all.png"
    small = terrella.LiftSpaceConfig(longest=128)
    assert terrella.generate_place(tmp_path / "again", panorama=tmp_path / "all.png", config=small).facts["panorama"]
    file = str(tmp_path / "out.png")
    assert main(["space", "export", str(tmp_path / "place"), file, "--at", "0.1", "0", "1.5", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["pose"][:3] == [0.1, 0.0, 1.5]
    with Image.open(file) as opened:
        assert opened.size == (2048, 1024)
    assert main(["space", "export", str(tmp_path / "place"), str(tmp_path / "a.ply"), "--at", "0", "0", "1"]) != 0
    assert "--at is for .png" in capsys.readouterr().err


@pytest.mark.parametrize(
    "size, options, words",
    [
        ((300, 200), ["--panorama"], "300 x 200 pixels"),
        ((900, 300), ["--panorama"], "twice as wide as high"),
        ((128, 64), ["--panorama"], "256 wide"),
        ((512, 256), ["--panorama", "--fov", "90"], "leave one out"),
    ],
)
def test_what_is_no_panorama_is_refused(tmp_path, capsys, size, options, words):
    Image.new("RGB", size, "teal").save(tmp_path / "a.png")
    assert main(["space", "lift", str(tmp_path / "a.png"), "--out", str(tmp_path / "place"), *options]) != 0
    assert words in capsys.readouterr().err and not (tmp_path / "place").exists()
