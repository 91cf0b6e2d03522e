"""The real page in a real browser: it connects, obeys keys, rewinds, branches, records, and comes back after a drop."""

from __future__ import annotations

import io
import time
from typing import Any

import numpy as np
import pytest
from PIL import Image

from .panorama import PIXELS_PER_STEP, Panorama, SlowDream

# the picture as bytes: drawn to a canvas of its own, so that the page's is left alone
PICTURE = """index => {
  const shown = document.querySelectorAll('figure canvas')[index], copy = document.createElement('canvas');
  copy.width = shown.width; copy.height = shown.height;
  const context = copy.getContext('2d');
  context.drawImage(shown, 0, 0);
  return [copy.height, copy.width, terrella.step, context.getImageData(0, 0, copy.width, copy.height).data];
}"""


def until(page, expression: str, seconds: float = 30.0) -> None:
    """Polls from outside: the page's own policy forbids waiting by evaluated strings, and is in force here."""
    end = time.monotonic() + seconds
    while not page.evaluate(expression):
        assert time.monotonic() < end, f"it never came true: {expression}"
        time.sleep(0.02)


def picture(page, index: int = 0) -> tuple[int, np.ndarray]:
    height, width, step, data = page.evaluate(PICTURE, index)
    return step, np.array(data, np.uint8).reshape(height, width, 4)[..., :3]


def shift(before: np.ndarray, after: np.ndarray, most: int) -> int:
    """Columns by which the picture moved right (negative: left), by least difference."""
    before, after = before[6:].astype(float), after[6:].astype(float)
    width = before.shape[1]

    def difference(by: int) -> float:
        a, b = before[:, max(0, -by) : width - max(0, by)], after[:, max(0, by) : width - max(0, -by)]
        return float(np.abs(a - b).mean())

    return min(range(-most, most + 1), key=difference)


@pytest.fixture
def open_page(browser):
    """open_page(url) -> a page that has painted; fails at the end if a script threw or the policy was broken."""
    contexts, faults = [], []

    def opened(url: str, **options):
        contexts.append(browser.new_context(**{"viewport": {"width": 1280, "height": 800}, **options}))
        page = contexts[-1].new_page()
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.on("console", lambda message: faults.append(message.text) if "Content Security" in message.text else None)
        page.goto(url)
        until(page, "!!window.terrella && terrella.painted > 2")
        return page

    yield opened
    for context in contexts:
        context.close()
    assert not faults, faults


def turn(page, key: str, steps: int = 8) -> tuple[int, int]:
    """Holds `key` for about `steps` steps; the picture's shift, and the steps between the two pictures."""
    page.keyboard.press("KeyP")
    until(page, "terrella.state === 'paused'")
    then, before = picture(page)
    page.keyboard.down(key)  # pressing a key of the world also ends the pause
    until(page, f"terrella.step >= {then + steps}")
    page.keyboard.up(key)
    page.keyboard.press("KeyP")
    until(page, "terrella.state === 'paused'")
    time.sleep(0.1)
    now, after = picture(page)
    page.keyboard.press("KeyP")
    until(page, "terrella.state === 'playing'")
    return shift(before, after, 50), now - then


def test_the_picture_moves_against_the_turn(serve_world, open_page):
    page = open_page(serve_world([Panorama(size=(48, 128), dt_s=1 / 20)]).url)
    for key, sign in (("ArrowLeft", 1), ("ArrowRight", -1)):
        moved, steps = turn(page, key)
        assert 0 < sign * moved <= PIXELS_PER_STEP * steps, (key, moved, steps)
        assert sign * moved >= PIXELS_PER_STEP * 4
    until(page, "terrella.latencyCount >= 2")
    assert all(latency > 0 for latency in page.evaluate("terrella.latencies"))
    assert page.evaluate("terrella.fps") > 0


def test_keys_light_up_and_are_let_go_with_the_focus(serve_world, open_page):
    page = open_page(serve_world().url)
    assert page.locator("#keys kbd").count() == 6, "arrows that do the same as letters have no cap of their own"
    page.keyboard.down("KeyW")
    page.keyboard.down("ArrowLeft")
    until(page, "document.querySelectorAll('#keys .held').length === 2")
    assert page.evaluate("terrella.held") == ["KeyW", "ArrowLeft"]
    page.evaluate("window.dispatchEvent(new Event('blur'))")
    until(page, "document.querySelectorAll('#keys .held').length === 0")


PAD = """() => {
  window.pad = { axes: [0, 0, 0, 0], buttons: [], connected: true, mapping: 'standard', index: 0, id: 'a pad' };
  navigator.getGamepads = () => [window.pad];
  window.dispatchEvent(new Event('gamepadconnected'));
}"""


def test_a_gamepad_walks_with_the_left_stick_and_turns_with_the_right(serve_world, open_page):
    page = open_page(serve_world().url)
    page.evaluate(PAD)
    for axes, held in (([0, -1, 0, 0], ["KeyW"]), ([0, 0, 1, 0], ["ArrowRight"]), ([0, 0, -1, 0], ["ArrowLeft"])):
        page.evaluate("axes => { window.pad.axes = axes; }", axes)
        until(page, f"terrella.held.join() === '{','.join(held)}'")
    page.evaluate("() => { window.pad.connected = false; }")
    until(page, "terrella.held.length === 0")


def test_rewind_branch_and_back_to_now(serve_world, open_page):
    page = open_page(serve_world([Panorama(dt_s=1 / 40)]).url)
    until(page, "terrella.step > 60")
    page.keyboard.down("Backspace")
    until(page, "terrella.state === 'rewound' && terrella.newest - terrella.step > 20")
    page.keyboard.up("Backspace")
    time.sleep(0.2)
    newest, step = page.evaluate("[terrella.newest, terrella.step]")
    assert page.locator("#past").is_visible() and page.evaluate("terrella.newest") == newest
    page.click("#now")
    until(page, f"terrella.state === 'playing' && terrella.step > {newest}")

    box = page.locator("#timeline").bounding_box()
    page.mouse.click(box["x"] + box["width"] * 0.25, box["y"] + box["height"] / 2)
    until(page, "terrella.state === 'rewound' && terrella.step < terrella.newest / 2")
    newest, step, seq = page.evaluate("[terrella.newest, terrella.step, terrella.framesAfter(0).at(-1).seq]")
    page.keyboard.press("Enter")  # continue from here: what came later is forgotten
    until(page, f"terrella.state === 'playing' && terrella.framesAfter({seq}).length > 3")
    first = page.evaluate(f"terrella.framesAfter({seq})[0].step")
    assert step <= first < newest, "play went on from the moment shown"

    page.keyboard.down("Backspace")
    until(page, "terrella.state === 'rewound'")
    page.keyboard.up("Backspace")
    time.sleep(0.1)
    page.keyboard.down("KeyW")  # moving also continues from here
    until(page, "terrella.state === 'playing'")
    page.keyboard.up("KeyW")


def test_a_running_game_shows_why_it_does_not_rewind(serve_world, open_page):
    page = open_page(serve_world([Panorama(forkable=False)]).url)
    assert "running game" in page.locator("#rewind").get_attribute("title")
    assert page.locator("#rewind").get_attribute("aria-disabled") == "true"
    page.keyboard.press("Backspace")
    until(page, "document.getElementById('toast').textContent.includes('running game')")
    assert page.evaluate("terrella.state") == "playing"


def test_recording_and_a_clip(serve_world, open_page):
    server = serve_world()
    page = open_page(server.url)
    page.click("#record")
    until(page, "terrella.recording")
    step = page.evaluate("terrella.step")
    until(page, f"terrella.step > {step + 10}")
    page.click("#record")
    until(page, "!terrella.recording")
    until(page, "document.getElementById('toast').textContent.startsWith('Saved')")
    assert server.sinks[0].closed and len(server.sinks[0].rows) >= 8 and server.sinks[0].ends == 1
    with page.expect_download() as download:
        page.click("#clip")
    assert download.value.suggested_filename == "panorama.mp4"


def test_seeds_and_restarts(serve_world, open_page):
    page = open_page(serve_world().url)
    until(page, "terrella.step > 20")
    page.fill("#seed", "77")
    page.press("#seed", "Enter")
    until(page, "terrella.seed === 77 && terrella.step < 20")
    page.click("#dice")
    until(page, "terrella.seed !== 77")
    page.fill("#seed", "-4")
    page.press("#seed", "Enter")
    until(page, "document.getElementById('toast').textContent.includes('whole number')")


def test_it_comes_back_after_the_socket_drops(serve_world, open_page):
    server = serve_world()
    page = open_page(server.url)
    until(page, "terrella.step > 10")
    page.evaluate("terrella.drop()")
    until(page, "terrella.state === 'reconnecting'")
    step, painted = page.evaluate("[terrella.step, terrella.painted]")
    until(page, f"terrella.connected && terrella.painted > {painted + 5}")
    assert page.evaluate("terrella.state") == "playing" and step < page.evaluate("terrella.step") < step + 200
    page.reload()
    until(page, "!!window.terrella && terrella.painted > 2")
    assert page.evaluate("terrella.step") > step, "a reloaded page goes on with its session"


def test_a_wrong_token_is_explained(serve_world, browser):
    url = serve_world(token="sesame").url.replace("sesame", "simsim")
    context = browser.new_context()
    page = context.new_page()
    page.goto(url)
    until(page, "!!window.terrella && terrella.state === 'refused'")
    assert "token" in page.locator("#banner-more").text_content()
    context.close()


def test_a_broken_world_offers_a_restart(serve_world, open_page, capsys):
    world: Any = Panorama()
    world.breaks_at = 12
    page = open_page(serve_world([world]).url)
    until(page, "terrella.state === 'failed'")
    assert "paint is wet" in page.locator("#banner-more").text_content()
    world.breaks_at = None
    page.click("#banner-button")
    until(page, "terrella.state === 'playing' && terrella.step > 20")
    capsys.readouterr()


def test_touch_moves_and_turns(serve_world, open_page):
    phone = {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True}
    page = open_page(serve_world().url, **phone)
    box = page.locator("#stick").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x, y - 60)
    until(page, "terrella.held.join() === 'KeyW'")
    page.mouse.up()
    until(page, "terrella.held.length === 0")
    box = page.locator("#turn").bounding_box()
    page.mouse.move(box["x"] + box["width"] - 10, box["y"] + box["height"] / 2)
    page.mouse.down()
    until(page, "terrella.held.join() === 'ArrowRight'")
    page.mouse.up()
    assert page.evaluate("document.documentElement.scrollWidth") <= 390


@pytest.mark.parametrize("size", [(1280, 800), pytest.param((390, 844), marks=pytest.mark.slow), (844, 390)])
def test_it_fits_and_looks_like_something(serve_world, open_page, tmp_path, size):
    pair = [Panorama(size=(96, 128), forkable=False), SlowDream(size=(96, 128))]
    page = open_page(serve_world(pair).url, viewport={"width": size[0], "height": size[1]})
    assert page.locator("figcaption").all_text_contents() == ["game", "dream"]
    for name in ("figure >> nth=0", "figure >> nth=1", "#deck", "header", "#pause", "#timeline"):
        box = page.locator(name).bounding_box()
        assert box["x"] >= 0 and box["y"] >= 0, name
        assert box["x"] + box["width"] <= size[0] + 1 and box["y"] + box["height"] <= size[1] + 1, name
    shot = np.asarray(Image.open(io.BytesIO(page.screenshot(path=tmp_path / "page.png"))).convert("RGB"))
    assert shot.shape[:2] == (size[1], size[0]) and shot.std() > 10
