"""What a world remembers, on the wire and on the page: sent only when asked for, drawn only where a world has it."""

from __future__ import annotations

import time

import numpy as np
import pytest
import torch

from terrella.core import check_world
from terrella.core.errors import ProtocolError
from terrella.serve.chart import _imagined_share, has_known_share, map_kind, tint_invented
from terrella.serve.protocol import Show, parse_message
from terrella.serve.timeline import Timeline

from .mapped import SLOTS, Mapped
from .panorama import Panorama
from .test_page import open_page, picture, until  # noqa: F401  (a fixture)


def test_the_fake_keeps_the_contract():
    check_world(Mapped())


def test_show_is_read_and_junk_is_refused():
    assert parse_message('{"type": "show", "map": true, "invented": false}') == ("show", Show(True, False))
    for junk in ('{"type": "show"}', '{"type": "show", "map": 1, "invented": true}'):
        with pytest.raises(ProtocolError, match="true or false"):
            parse_message(junk)


def test_a_chart_tells_where_the_camera_and_the_keyframes_are():
    timeline = Timeline([Mapped()], seed=0)
    first = timeline.map_event()
    assert first["world"] == 0 and len(first["places"]) == 4 and first["known"] == 0.5 and len(first["camera"]) == 3
    timeline.step(["KeyW"])
    second = timeline.map_event()
    assert second["places"] == first["places"] and second["camera"][0] == pytest.approx(0.1)
    for _ in range(20):
        timeline.step(["ArrowLeft"])
    third = timeline.map_event()
    assert third["places"][4:] == [0.5, 0.0, 0.7, 2.0]
    assert third["camera"][2] != second["camera"][2]


def test_the_past_has_its_own_map():
    timeline = Timeline([Mapped()], seed=0)
    for _ in range(45):
        timeline.step([])
    assert len(timeline.map_event()["places"]) == 3 * 4
    timeline.stand_at(3)
    assert len(timeline.map_event()["places"]) == 4


def test_a_world_without_these_channels_has_no_map():
    assert not map_kind(Panorama().spec) and not has_known_share(Panorama().spec)
    timeline = Timeline([Panorama()], seed=0)
    assert timeline.map_event() is None and timeline.images(timeline.shown, invented=True) == timeline.shown.images


def test_of_two_worlds_the_dream_is_drawn():
    assert Timeline([Panorama(), Mapped()], seed=0).map_event()["world"] == 1


def test_what_is_known_keeps_its_colours_and_the_rest_turns_amber():
    rgb = torch.tensor([40, 90, 200], dtype=torch.uint8).expand(1, 4, 6, 3)
    known = torch.zeros(1, 4, 6)
    known[..., 3:] = 1
    out = tint_invented(rgb, known)
    assert torch.equal(out[..., 3:, :], rgb[..., 3:, :])
    red, _, blue = out[0, 0, 0].tolist()
    assert red > blue, "a blue wall turns amber"
    assert torch.equal(rgb[0, 0, 0], torch.tensor([40, 90, 200], dtype=torch.uint8)), "the picture itself is left alone"


def inside(page) -> np.ndarray:
    """The map's pixels [H, W, 3]."""
    size, data = page.evaluate("""() => {
      const shown = document.querySelector('#map canvas'), copy = document.createElement('canvas');
      [copy.width, copy.height] = [shown.width, shown.height];
      const context = copy.getContext('2d');
      context.drawImage(shown, 0, 0);
      return [[copy.height, copy.width], context.getImageData(0, 0, copy.width, copy.height).data];
    }""")
    return np.array(data, np.uint8).reshape(*size, 4)[..., :3]


@pytest.mark.slow
def test_the_map_shows_keyframes_by_kind_and_the_camera(serve_world, open_page):  # noqa: F811
    page = open_page(serve_world([Mapped(dt_s=1 / 100)]).url)
    until(page, f"terrella.map.shown && terrella.map.places === {SLOTS}")
    assert page.locator("#map-known").text_content() == "33% from memory + 17% invented earlier"
    assert page.locator("#map-kinds span").all_text_contents() == ["3 recorded", "3 observed", "2 imagined"]
    page.keyboard.down("KeyW")
    until(page, "terrella.map.path > 8 && terrella.map.camera[0] > 1")
    page.keyboard.up("KeyW")
    red, green, blue = np.moveaxis(inside(page).astype(int), -1, 0)  # of one moment: the camera moves on
    assert ((green > red + 15) & (green > blue)).sum() > 20, "observed"
    assert ((red > blue + 15) & (red > green)).sum() > 20, "imagined"
    assert (np.minimum(np.minimum(red, green), blue) > 200).sum() > 8, "the camera"
    box, screen = page.locator("#map").bounding_box(), page.locator("#deck").bounding_box()
    assert box["x"] + box["width"] <= 1280 and box["y"] + box["height"] <= screen["y"] + 1
    page.keyboard.press("KeyM")
    until(page, "!terrella.map.shown && document.getElementById('map').hidden")
    step = page.evaluate("terrella.map.step")
    later = page.evaluate("terrella.step") + 30
    until(page, f"terrella.step > {later}")
    assert page.evaluate("terrella.map.step") == step, "a hidden map is sent nothing"
    page.reload()
    until(page, "!!window.terrella && terrella.painted > 2")
    assert not page.evaluate("terrella.map.shown"), "and stays hidden"


def test_rewinding_takes_the_map_along(serve_world, open_page):  # noqa: F811
    page = open_page(serve_world([Mapped(dt_s=1 / 50)]).url)
    until(page, "terrella.map.places >= 5")
    page.keyboard.press("KeyP")
    until(page, "terrella.state === 'paused'")
    box = page.locator("#timeline").bounding_box()
    page.mouse.click(box["x"] + 3, box["y"] + box["height"] / 2)
    until(page, "terrella.state === 'rewound' && terrella.map.places === 1")


def test_inventions_can_be_tinted(serve_world, open_page):  # noqa: F811
    page = open_page(serve_world([Mapped()]).url)

    def colours() -> tuple[float, ...]:
        """Blue less red of the left half, which it invents, and of the right one."""
        _, seen = picture(page)
        half = seen.shape[1] // 2
        return tuple(
            float((part[..., 2].astype(int) - part[..., 0]).mean()) for part in (seen[:, :half], seen[:, half:])
        )

    before = colours()
    assert min(before) > 5, "a night sky is blue"
    page.click("#tint")
    end = time.monotonic() + 20
    while colours()[0] > 0:
        assert time.monotonic() < end
    assert colours()[1] > 5
    page.keyboard.press("KeyT")
    while colours()[0] < 5:
        assert time.monotonic() < end


def test_a_world_without_a_map_shows_no_button(serve_world, open_page):  # noqa: F811
    page = open_page(serve_world([Panorama()]).url)
    assert not page.locator("#map-open").is_visible() and not page.locator("#tint").is_visible()
    page.keyboard.press("KeyM")
    assert not page.evaluate("terrella.map.shown") and not page.locator("#map").is_visible()


def test_a_world_that_fails_to_tell_what_it_remembers_plays_on(serve_world, open_page, capsys):  # noqa: F811
    class Broken(Mapped):
        def _channel(self, state, name):
            if name == "places":
                raise RuntimeError("it forgot")
            return super()._channel(state, name)

    page = open_page(serve_world([Broken()]).url)
    step = page.evaluate("terrella.step")
    until(page, f"terrella.step > {step + 20}")
    assert page.evaluate("terrella.state") == "playing"
    assert "it forgot" in capsys.readouterr().err


@pytest.mark.parametrize("size", [(390, 844), pytest.param((844, 390), marks=pytest.mark.slow)])
def test_on_a_phone_it_is_closed_at_first_and_fits_when_opened(serve_world, open_page, size):  # noqa: F811
    phone = {"viewport": {"width": size[0], "height": size[1]}, "has_touch": True, "is_mobile": True}
    page = open_page(serve_world([Mapped(size=(96, 128))]).url, **phone)
    assert not page.evaluate("terrella.map.shown")
    page.click("#map-open")
    until(page, "terrella.map.shown && terrella.map.camera !== null")
    for name in ("#map", "#pause", "#clip", "#map-open", "#about"):
        box = page.locator(name).bounding_box()
        assert box["x"] >= 0 and box["y"] >= 0, name
        assert box["x"] + box["width"] <= size[0] and box["y"] + box["height"] <= size[1], name
    assert page.evaluate("document.documentElement.scrollWidth") <= size[0]


def test_memory_of_its_own_imagination_is_no_memory_of_the_world():
    """Six recorded views to the east and six imagined to the west, all of which look east."""
    held = torch.tensor([[x, 0.1 * at, 0.0, kind] for x, kind in ((8.0, 1.0), (-8.0, 3.0)) for at in range(6)])
    pose = lambda x: torch.tensor([x, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0])  # noqa: E731
    assert [_imagined_share(pose(x), held) for x in (8.0, -8.0)] == [0.0, 1.0]
    assert 0 < _imagined_share(pose(0.0), held) < 1 and _imagined_share(pose(0.0), held[:0]) == 0.0
    floor = torch.cat([held, torch.tensor([[-8.0, 0.0, 0.0, 4.0]] * 9)])
    assert _imagined_share(pose(-8.0), floor) == 1.0, "ground to stand on is no view"
