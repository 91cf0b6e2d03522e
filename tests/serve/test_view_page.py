"""The page of a recording in a real browser: it shows what was seen at the playhead, in step, and keeps its marks."""

from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image

from terrella.data.source import Lazy, Readings, Source, Take
from terrella.exchange.browse import Browse

from . import rig
from .test_page import until
from .viewed import viewed

READY = "!!window.viewer && viewer.state === 'open' && viewer.ready && viewer.painted > 0"

# a tile's picture: drawn to a canvas of its own, so that the page's is left alone
PIXELS = """kind => {
  const shown = document.querySelector(`figure[data-kind=${kind}] canvas`), copy = document.createElement('canvas');
  copy.width = shown.width; copy.height = shown.height;
  const context = copy.getContext('2d');
  context.drawImage(shown, 0, 0);
  return [copy.height, copy.width, context.getImageData(0, 0, copy.width, copy.height).data];
}"""


def pixels(page, kind: str) -> np.ndarray:
    height, width, data = page.evaluate(PIXELS, kind)
    return np.array(data, np.uint8).reshape(height, width, 4)[..., :3]


@pytest.fixture
def open_view(browser, tmp_path):
    """open_view(source, ...) -> its page, painted; fails at the end if a script threw or the policy was broken."""
    contexts, servers, faults = [], [], []

    def opened(source=None, *, export=None, export_to=None, hash="", ready=READY, size=(1280, 800), token=None):
        browse = Browse(source or rig.lively(), tmp_path / "marks.json", export=export)
        servers.append(viewed(browse, export_to=export_to, token=token))
        url = servers[-1].__enter__()
        contexts.append(browser.new_context(viewport={"width": size[0], "height": size[1]}))
        page = contexts[-1].new_page()
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.on("console", lambda message: faults.append(message.text) if "Content Security" in message.text else None)
        page.goto(url + hash)
        until(page, ready)
        return page

    yield opened
    for context in contexts:
        context.close()
    for server in servers:
        server.__exit__(None, None, None)
    assert not faults, faults


def due(take: Take, time_s: float) -> dict[str, int]:
    """Which reading of each picture, depth and cloud was the latest at a time."""
    shown = {"front": "images.front", "left": "images.left", "depth": "depth", "lidar": "points.lidar"}
    clocks = {label: take.readings[f"observation.{name}"].time_s for label, name in shown.items()}
    return {label: int(np.searchsorted(clock, time_s + 1e-9, "right")) - 1 for label, clock in clocks.items()}


def test_it_shows_what_was_seen_at_the_playhead(open_view):
    page, take = open_view(hash="#episode=1&time=2.5"), list(rig.lively().takes())[1]
    shown = page.evaluate("viewer.shown")
    assert page.evaluate("viewer.time") == 2.5 and shown == due(take, 2.5)
    truth = take.readings["observation.images.front"].values[shown["front"]]
    assert np.abs(pixels(page, "image").astype(int) - truth).mean() < 6
    depth = take.readings["observation.depth"].values[shown["depth"]]
    bright = pixels(page, "depth").astype(int).sum(-1)
    assert (bright[np.isinf(depth)] == 11 + 12 + 15).all(), "where nothing was hit, nothing is shown"
    assert np.corrcoef(bright[np.isfinite(depth)], depth[np.isfinite(depth)])[0, 1] < -0.8, "near is bright"
    for kind in ("points", "map"):
        assert pixels(page, kind).std() > 5
    assert page.locator("#task").text_content() == take.task
    assert page.locator("#spoken").text_content() == "keep left of the yellow pillar"
    forward = float(np.asarray(take.readings["action"].values)[75, 0])
    assert f"{forward:.3f} m/s" in page.locator(".legend button", has_text="forward").text_content()


def test_playing_keeps_all_in_step(open_view):
    page, take = open_view(), list(rig.lively().takes())[0]
    page.keyboard.press("Space")
    seen = 0
    for _ in range(200):
        time_s, playing, ready, shown = page.evaluate("[viewer.time, viewer.playing, viewer.ready, viewer.shown]")
        if not playing:
            break
        assert ready, "no frame of one camera without those of the others"
        for label, index in due(take, time_s).items():  # painted at this time, or at the one painted just before
            assert 0 <= index - shown[label] <= 1
        seen += time_s > 0
    assert seen > 10
    page.keyboard.press("End")
    until(page, "viewer.ready && !viewer.playing")
    page.keyboard.press("Space")  # from the end it begins anew
    until(page, "viewer.time > 0 && viewer.time < 2")
    page.keyboard.press("Space")
    until(page, "!viewer.playing")


def test_arrows_step_from_frame_to_frame(open_view):
    page, take = open_view(hash="#time=1"), list(rig.lively().takes())[0]
    clock = take.readings["observation.images.front"].time_s
    assert page.evaluate("viewer.time") == 1
    for key, index in (("ArrowRight", 31), ("ArrowRight", 32), ("ArrowLeft", 31), ("Home", 0), ("ArrowLeft", 0)):
        page.keyboard.press(key)
        until(page, f"viewer.time === {clock[index]} && viewer.ready && viewer.shown.front === {index}")
    page.keyboard.press("Shift+ArrowRight")
    assert page.evaluate("viewer.time") == 1
    page.locator(".lane .head", has_text="imu").click()  # now they step by the readings of another sensor
    page.keyboard.press("ArrowRight")
    assert page.evaluate("viewer.time") == pytest.approx(1.005)


def test_dragging_scrubs_and_the_wheel_zooms(open_view):
    page = open_view()
    box = page.locator("#timeline canvas").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + box["width"] / 4, y)
    page.mouse.up()
    length = max(float(own.time_s[-1]) for own in next(iter(rig.lively().takes())).readings.values())
    assert page.evaluate("viewer.time") == pytest.approx(0.75 * length, rel=0.01)
    page.mouse.wheel(0, -600)
    until(page, f"viewer.range[1] - viewer.range[0] < {0.5 * length}")
    start, stop = page.evaluate("viewer.range")
    assert start < 0.75 * length < stop
    page.keyboard.press("0")
    assert page.evaluate("viewer.range") == [0, pytest.approx(length)]


def test_episodes_are_walked_filtered_and_jumped_to(open_view):
    page = open_view()
    for key, number in (("]", 1), ("]", 2), ("[", 1)):
        page.keyboard.press(key)
        until(page, f"viewer.episode === {number} && viewer.ready")
    page.fill("#filter", "red PILLAR")
    assert page.evaluate("viewer.listed") == [0, 2]
    page.keyboard.press("Enter")
    until(page, "viewer.episode === 0 && viewer.ready")
    page.keyboard.press("]")  # the next one of the list, which is filtered
    until(page, "viewer.episode === 2 && viewer.ready")
    page.fill("#filter", "3")
    page.locator(".episode").click()
    until(page, "viewer.episode === 3 && viewer.ready")
    page.fill("#filter", "nowhere")
    assert page.evaluate("viewer.listed") == [] and "No episode" in page.locator("#rows").text_content()


def test_marks_survive_a_reload_and_are_left_out_of_the_export(open_view, tmp_path):
    kept = []

    def export(path, keep, report):
        report(1, len(keep))
        kept.append((path, list(keep)))
        path.mkdir()

    page = open_view(export=export, export_to=tmp_path / "rig-good")
    page.keyboard.press("]")
    until(page, "viewer.episode === 1")
    page.keyboard.press("b")
    until(page, "viewer.bad.join() === '1'")
    page.reload()
    until(page, READY)
    assert page.evaluate("[viewer.episode, viewer.bad]") == [1, [1]], "and the episode is still the one that was open"
    assert page.locator("#mark").get_attribute("aria-pressed") == "true"
    page.route("**/mark?*", lambda route: route.abort())  # as where the server has stopped
    page.locator("#mark").click()
    until(page, "document.getElementById('toast').textContent.includes('server has stopped')")
    page.unroute("**/mark?*")
    page.click("[data-which=good]")
    assert page.evaluate("viewer.listed") == [0, 2, 3]
    page.click("#export")
    assert str(tmp_path / "rig-good") in page.locator("#export-words").text_content()
    page.click("#export-go")
    until(page, "document.getElementById('export-words').textContent.includes('3 episodes written')")
    assert kept == [(tmp_path / "rig-good", [0, 2, 3])]
    page.click("#export-go")
    until(page, "document.getElementById('export-words').textContent.includes('exists already')")


def test_lines_are_toggled_by_their_legend(open_view):
    page = open_view()
    canvas = "document.querySelectorAll('.lane')[5].querySelector('canvas').toDataURL()"  # after language and pictures
    until(page, "viewer.ready")
    before = page.evaluate(canvas)
    button = page.locator(".legend button", has_text="forward")
    button.click()
    assert button.get_attribute("aria-pressed") == "false"
    until(page, f"{canvas} !== {before!r}")


def test_a_broken_camera_says_so_and_the_rest_plays(open_view):
    whole = rig.lively(1)

    def torn(index):
        raise ValueError("no keyframe")

    def takes():
        for take in whole.takes():
            left, imu = (take.readings[f"observation.{name}"] for name in ("images.left", "imu"))
            broken = {
                "observation.images.left": Readings(left.time_s, Lazy(len(left.time_s), torn)),
                "observation.imu": Readings(imu.time_s[::-1], imu.values),
            }
            yield Take({**take.readings, **broken}, take.task)

    page = open_view(Source("torn", whole.sensors, takes), hash="#time=1")
    assert "no keyframe" in page.locator(".why").text_content()
    assert "fault" in page.locator(".lane .head", has_text="imu").text_content()
    page.keyboard.press("Space")
    until(page, "viewer.time > 1.3")
    page.keyboard.press("Space")


def test_strange_recordings_open(open_view):
    page = open_view(Source("none", {}, lambda: iter(())), ready="window.viewer?.state === 'empty'")
    assert "no episodes" in page.locator("#banner").text_content()
    one = Source("bare", rig.lively().sensors, lambda: iter([Take({})]))
    open_view(one, ready="window.viewer?.state === 'open'")
    page = open_view(token="sesame")
    page.goto(page.url.replace("sesame", "simsim"))
    until(page, "window.viewer?.state === 'refused'")
    assert "token" in page.locator("#banner").text_content()


def test_its_arithmetic_is_numpys(open_view):
    page = open_view()
    bits = np.arange(65536, dtype=np.uint16)
    found = page.evaluate(
        "async () => { const { fromHalf } = await import('/view/depth.js');"
        "return new Float64Array(65536).map((_, bits) => fromHalf(bits)); }"
    )
    np.testing.assert_array_equal(np.array(found), bits.view(np.float16).astype(float))
    rng = np.random.default_rng(0)
    clock = np.sort(np.round(rng.uniform(0, 10, 300), 1))
    asked = np.round(rng.uniform(-1, 11, 200), 1)
    found = page.evaluate(
        "async ([clock, asked]) => { const { indexAt } = await import('/view/library.js');"
        "return asked.map((time) => indexAt(clock, time)); }",
        [clock.tolist(), asked.tolist()],
    )
    assert found == (np.searchsorted(clock, asked, "right") - 1).tolist()
    yaw = rng.uniform(-3, 3, 50)
    turns = np.stack([np.cos(yaw / 2), np.zeros(50), np.zeros(50), np.sin(yaw / 2)], -1)
    found = page.evaluate(
        "async (turns) => { const { headingOf } = await import('/view/map.js');"
        "return turns.map((turn) => headingOf({ quaternion: [0, 1, 2, 3] }, turn)); }",
        turns.tolist(),
    )
    np.testing.assert_allclose(found, yaw, atol=1e-9)


@pytest.mark.parametrize(
    "size",
    [(1440, 900), pytest.param((1024, 700), marks=pytest.mark.slow), pytest.param((390, 844), marks=pytest.mark.slow)],
)
def test_it_fits_and_looks_like_something(open_view, tmp_path, size):
    page = open_view(size=size, hash="#episode=1&time=2.5")
    names = ["header", "#tiles", "#deck", "#play", "#mark", "#list", *(f"figure >> nth={at}" for at in range(5))]
    boxes = {name: page.locator(name).bounding_box() for name in names}
    for name, box in boxes.items():
        assert box["width"] > 20 and box["height"] > 20, name
        assert box["x"] >= 0 and box["y"] >= 0, name
        assert box["x"] + box["width"] <= size[0] + 1 and box["y"] + box["height"] <= size[1] + 1, name
    figures = [boxes[f"figure >> nth={at}"] for at in range(5)]
    for at, one in enumerate(figures):
        for other in figures[at + 1 :]:
            apart = one["x"] + one["width"] <= other["x"] or other["x"] + other["width"] <= one["x"]
            assert apart or one["y"] + one["height"] <= other["y"] or other["y"] + other["height"] <= one["y"]
    shot = np.asarray(Image.open(io.BytesIO(page.screenshot(path=tmp_path / "page.png"))).convert("RGB"))
    assert shot.shape[:2] == (size[1], size[0]) and shot.std() > 10
