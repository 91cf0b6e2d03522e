"""FrameRenderer drawn on the server: what the rasteriser draws, and a page that walks by them where there is no WebGL2."""

from __future__ import annotations

import io
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from terrella.core.errors import ServeError
from terrella.serve.place_frames import FrameRenderer
from terrella.serve.place_page import EditablePlace, build_place
from terrella.space.camera import planar_pose
from terrella.space.raster import rasterise
from terrella.workflows.splat_places import page_scene

from .test_place_page import opened, serving, until, world  # noqa: F401

VIEW = {"x": 1.5, "y": 2, "z": 1.4, "heading": 0.7, "pitch": 0, "wide": 0.8, "tall": 0.6, "width": 160, "height": 120}

WITHOUT = """const real = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind) { return kind === 'webgl2' ? null : real.call(this, kind); };"""
SPREAD = """() => { const { width, height } = terrella.drawing.canvas;
  const shades = terrella.drawing.context.getImageData(0, 0, width, height).data.filter((_, k) => k % 4 === 0);
  return Math.max(...shades) - Math.min(...shades); }"""


def view(**changed):
    return {name: str(value) for name, value in {**VIEW, **changed}.items()}


def picture(content: bytes) -> torch.Tensor:
    return torch.from_numpy(np.array(Image.open(io.BytesIO(content)))).float() / 255


def test_a_frame_is_what_the_rasteriser_draws_after_the_edits():
    place, edits = world(1500), []
    frames = FrameRenderer(place.gaussians, place.objects, lambda: edits)
    pose = planar_pose(*(torch.tensor([float(VIEW[name])]) for name in ("x", "y", "z", "heading")))
    truth = rasterise(place.gaussians, pose, (0.5 / 0.8, 0.5 / 0.6, 0.5, 0.5), (120, 160)).rgb[0].clamp(0, 1)
    assert (picture(frames.draw(view())).permute(2, 0, 1) - truth).abs().mean() < 0.03
    edits.append({"select": {"all": True}, "do": "recolour", "colour": [1, 0, 0]})
    assert picture(frames.draw(view()))[..., 0].mean() > 3 * picture(frames.draw(view()))[..., 1].mean()


@pytest.mark.slow
def test_what_lies_ahead_is_in_the_middle():
    ahead = torch.tensor([[math.cos(0.7) * math.cos(0.4), math.sin(0.7) * math.cos(0.4), math.sin(0.4)]])
    one = world(300).gaussians.at(torch.arange(1))
    frames = FrameRenderer(replace(one, means=torch.tensor([[1.5, 2.0, 1.4]]) + 2 * ahead), torch.zeros(1), list)
    light = picture(frames.draw(view(pitch=0.4))).sum(2)
    row, column = divmod(int(light.argmax()), 160)
    assert light.max() > 0.3 and abs(row - 59.5) < 5 and abs(column - 79.5) < 5


@pytest.mark.parametrize(
    "wrong", [{"x": "nan"}, {"wide": "0"}, {"x": "1e300"}, {"tall": "1e-300"}, {"width": "100000"}, {"height": "tall"}]
)
def test_other_views_are_refused(wrong):
    with pytest.raises(ServeError, match="reload"):
        FrameRenderer(world(300).gaussians, world(300).objects, list).draw(view(**wrong))


def test_without_webgl_the_server_draws_and_one_walks(serving, browser):  # noqa: F811
    url = serving(build_place(EditablePlace(page_scene(world(1500)), list, lambda text: None)))
    page = browser.new_page(viewport={"width": 320, "height": 240})
    page.add_init_script(WITHOUT)
    page.goto(url)
    until(page, "!!window.terrella && terrella.drawing.remote && terrella.drawing.count > 0")
    assert "server draws" in page.evaluate("document.getElementById('toast').textContent")
    assert page.evaluate(SPREAD) > 40
    before, frames = page.evaluate("[terrella.eye.place, terrella.drawing.count]")
    page.keyboard.down("KeyW")
    until(page, f"Math.hypot(terrella.eye.place[0] - {before[0]}, terrella.eye.place[1] - {before[1]}) > 0.3")
    page.keyboard.up("KeyW")
    until(page, f"terrella.drawing.count > {frames}")
    page.close()
