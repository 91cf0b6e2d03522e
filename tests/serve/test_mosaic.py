"""The map of a flat world: what was seen so far, sent when somebody looks and something changed, shown when there is more to
see than the picture."""

from __future__ import annotations

import base64
import io
import json
import time

import numpy as np
import pytest
from PIL import Image
from websockets.sync.client import connect

from terrella.core import check_world
from terrella.serve.chart import FINEST, MOSAIC, PLACES, map_kind
from terrella.serve.timeline import Timeline

from .flat import Flat
from .mapped import Mapped
from .panorama import PIXELS_PER_STEP, Panorama
from .test_map import inside
from .test_page import open_page, until  # noqa: F401  (a fixture)

HEIGHT, WIDTH = 48, 64


def decoded(mosaic: dict) -> tuple[np.ndarray, np.ndarray]:
    """The image, and where something was seen."""
    image, mask = (Image.open(io.BytesIO(base64.b64decode(mosaic[name]))) for name in ("image", "mask"))
    return np.asarray(image.convert("RGB")), np.asarray(mask.convert("RGBA"))[..., 3] > 0


def test_the_fake_keeps_the_contract():
    check_world(Flat())


def test_the_kind_of_map_follows_from_the_channels():
    assert map_kind(Flat().spec) == MOSAIC and map_kind(Mapped().spec) == PLACES and map_kind(Panorama().spec) == ""
    assert Timeline([Panorama(), Flat()], seed=0).map_kind == MOSAIC and Timeline([Panorama()], seed=0).map_kind == ""


def test_at_first_it_is_the_picture():
    timeline = Timeline([Flat()], seed=0)
    mosaic = timeline.map_event()["mosaic"]
    assert mosaic["size"] == mosaic["view"] == (WIDTH, HEIGHT)
    image, seen = decoded(mosaic)
    shown = timeline.worlds[0].render(timeline.shown.states[0], ("rgb",))["rgb"][0].numpy()
    assert seen.all() and np.abs(image[6:].astype(int) - shown[6:]).mean() < 8


def test_what_was_seen_lies_where_it_was_and_the_rest_is_clear():
    timeline = Timeline([Flat()], seed=0)
    for _ in range(10):
        timeline.step(["ArrowRight"])
    mosaic, went = timeline.map_event()["mosaic"], 10 * PIXELS_PER_STEP
    assert mosaic["size"] == (WIDTH + 2 * went, HEIGHT), "its middle is the picture"
    image, seen = decoded(mosaic)
    assert image.shape[:2] == seen.shape == (HEIGHT, WIDTH + 2 * went)
    assert seen[:, : went + WIDTH].all() and not seen[:, went + WIDTH :].any()


def test_the_past_has_its_own_mosaic():
    timeline = Timeline([Flat()], seed=0)
    for _ in range(10):
        timeline.step(["ArrowRight"])
    timeline.stand_at(0)
    assert timeline.map_event()["mosaic"]["size"] == (WIDTH, HEIGHT)


def test_a_large_one_is_thinned():
    timeline = Timeline([Flat(size=(96, 400))], seed=0)
    for _ in range(150):
        timeline.step(["ArrowRight"])
    mosaic = timeline.map_event()["mosaic"]
    image, seen = decoded(mosaic)
    assert mosaic["size"][0] == 1000 and image.shape[1] == seen.shape[1] == 500 <= FINEST


def test_recordings_and_policies_do_without_it():
    seen, rows = [], []

    class Watching:
        def begin(self, batch, rng):
            return None

        def act(self, observation, memory, rng):
            seen.append(set(observation))
            return timeline.spec.sample_action(1, rng), None

    class Sink:
        def add(self, observation, action, reward, done):
            rows.append(set(observation))

        def end_episode(self): ...

        def close(self): ...

    timeline = Timeline([Flat()], 0, Sink, policy=Watching())
    timeline.record(True)
    for _ in range(3):
        timeline.step()
    timeline.record(False)
    assert rows and {"rgb", "pose"} == set.union(*rows) and "mosaic" not in set.union(*seen)


def test_it_opens_when_there_is_more_to_see_than_the_picture(serve_world, open_page):  # noqa: F811
    page = open_page(serve_world([Flat()]).url)
    until(page, "terrella.map.size !== null")
    assert not page.evaluate("terrella.map.shown") and not page.locator("#map-open").is_visible()
    assert not page.locator("#cameras button").count(), "it is no camera"
    page.keyboard.down("ArrowRight")
    until(page, "terrella.map.shown && terrella.map.size[0] > 120")
    page.keyboard.up("ArrowRight")
    time.sleep(0.6)  # it grows gently
    shown = inside(page).astype(int)
    height, width = shown.shape[:2]
    left, right = shown[height // 2, : width // 5], shown[height // 2, -width // 5 :]
    assert left.max() > 40 and right.max() < 25, "what was passed lies to the left, and nothing to the right"
    row = shown[height // 2].min(-1)
    assert (row[width // 5 : width // 2] > 150).any() and (row[width // 2 : -width // 5] > 150).any(), "a frame"
    assert page.locator("#map-known").text_content() == ""
    page.keyboard.press("KeyM")
    until(page, "!terrella.map.shown")
    assert page.locator("#map-open").is_visible()
    step = page.evaluate("terrella.map.step")
    later = page.evaluate("terrella.step") + 30
    until(page, f"terrella.step > {later}")
    assert page.evaluate("terrella.map.step") == step, "a hidden map is sent nothing"


def test_who_asks_sees_it_though_it_is_the_picture(serve_world, open_page):  # noqa: F811
    phone = {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True}
    page = open_page(serve_world([Flat()]).url, **phone)
    assert not page.evaluate("terrella.map.shown")
    page.click("#map-open")
    until(page, "terrella.map.shown && terrella.map.size !== null")
    assert page.locator("#map-known").text_content() == "Nothing else seen yet"
    box = page.locator("#map").bounding_box()
    assert box["x"] >= 0 and box["x"] + box["width"] <= 390 and box["height"] < 200


@pytest.mark.parametrize("still", [True, False])
def test_an_image_is_sent_again_only_where_it_changed(serve_world, still):
    with connect(serve_world([Flat()]).socket_url) as socket:
        socket.send(json.dumps({"type": "show", "map": True, "invented": False}))
        if not still:
            socket.send(json.dumps({"type": "controls", "id": 1, "t": 0, "held": ["ArrowRight"], "axes": []}))
        images, charts, end = 0, 0, time.monotonic() + 20
        while charts < 4 and time.monotonic() < end:
            data = socket.recv(20)
            if isinstance(data, bytes):
                socket.send(json.dumps({"type": "ack", "seq": int.from_bytes(data[4:8], "little")}))
            elif (body := json.loads(data))["type"] == "chart":
                charts, images = charts + 1, images + ("mosaic" in body)
    assert charts == 4 and (images == 1 if still else images > 2)
