"""Beginning with a picture: what image files become, what is refused, and the page on which one is dropped."""

from __future__ import annotations

import io
import struct
import zlib
from dataclasses import replace

import numpy as np
import pytest
import torch
from gymnasium import spaces
from PIL import Image

from terrella.core import Spec
from terrella.core.errors import ObservationError, ProtocolError, ServeError
from terrella.serve.picture import MAX_DROPPED_PIXELS, picture_of, read_picture, uncertainty_levels
from terrella.serve.protocol import MAX_PICTURE, parse_message
from terrella.serve.timeline import Timeline

from .panorama import Panorama
from .test_page import open_page, until  # noqa: F401

SIZE = (48, 64)


class Gallery(Panorama):
    """A panorama that takes pictures, and doubts those that are red."""

    def __init__(self, **options):
        super().__init__(**options)
        channels = {**self.spec.channels, "uncertainty": spaces.Box(0, 1, (), np.float32)}
        self.spec = replace(self.spec, channels=channels, observes=("rgb",))

    def observe(self, observation, prior, rng):
        if "rgb" not in observation:
            raise ObservationError("a gallery needs rgb.")
        self.picture = observation["rgb"][0].repeat(1, 6, 1)
        red = float(observation["rgb"][..., 0].float().mean()) / 255
        state = self.start(1, rng)
        return state.replace(column=torch.zeros(1, dtype=torch.int64), x=torch.tensor([red]))

    def _channel(self, state, name):
        if name == "uncertainty":
            return (state["x"] * 0.1).float()
        return super()._channel(state, name)


def image(width: int = 200, height: int = 100, kind: str = "PNG", mode: str = "RGB", **options) -> bytes:
    """Left half blue, right half red."""
    pixels = np.zeros((height, width, 3), np.uint8)
    pixels[:, : width // 2, 2], pixels[:, width // 2 :, 0] = 255, 255
    out = io.BytesIO()
    Image.fromarray(pixels).convert(mode).save(out, kind, **options)
    return out.getvalue()


@pytest.mark.parametrize("kind", ["PNG", "JPEG", "WEBP", "GIF", "BMP", "TIFF"])
@pytest.mark.parametrize("shape", [(640, 480), (100, 400), (400, 100), (7, 5), (1, 1)])
def test_any_common_image_of_any_shape_becomes_a_frame(kind, shape):
    rgb = picture_of(image(shape[0], shape[1], kind), SIZE)
    assert rgb.shape == (*SIZE, 3) and rgb.dtype == torch.uint8
    if shape[0] > 50:
        assert rgb[24, 4, 2] > 150 and rgb[24, -4, 0] > 150, "the middle is kept"


@pytest.mark.parametrize("mode", ["L", "P", "RGBA", "LA", "CMYK", "1", "I;16"])
def test_any_kind_of_pixel_is_understood(mode):
    if mode == "CMYK":
        data = image(64, 48, "JPEG", mode)
    elif mode == "I;16":
        out = io.BytesIO()
        Image.fromarray(np.full((48, 64), 40000, np.uint16)).save(out, "PNG")
        data = out.getvalue()
    else:
        data = image(64, 48, "PNG", mode)
    rgb = picture_of(data, SIZE)
    assert rgb.shape == (*SIZE, 3)
    if mode == "I;16":
        assert abs(int(rgb[0, 0, 0]) - 155) <= 1


def test_a_photograph_stands_upright():
    exif = Image.Exif()
    exif[0x0112] = 6  # the camera was turned: what is on the left belongs on top
    rgb = picture_of(image(100, 200, "JPEG", exif=exif, quality=95), SIZE)
    assert rgb[4, 32, 2] > 150 and rgb[-4, 32, 0] > 150


def test_what_is_transparent_has_a_ground():
    pixels = np.zeros((48, 64, 4), np.uint8)
    out = io.BytesIO()
    Image.fromarray(pixels).save(out, "PNG")
    assert int(picture_of(out.getvalue(), SIZE).float().mean()) == 41


def bomb(width: int, height: int) -> bytes:
    """A PNG of a few bytes that promises many pixels."""

    def chunk(name: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    body = chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(bytes(1000))) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + body


@pytest.mark.parametrize(
    "data, words",
    [
        (b"", "no image"),
        (b"GIF89a", "no image|cannot be decoded"),
        (b"hello", "no image"),
        (image()[:200], "cannot be decoded"),
        (image(kind="JPEG")[:300], "cannot be decoded"),
        (bomb(60000, 60000), "too many pixels"),
        (bomb(3000, 3000), "too many pixels"),
        (b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n", "no image"),
        (b"<svg xmlns='http://www.w3.org/2000/svg'/>", "no image"),
    ],
)
def test_what_is_no_picture_is_refused_in_one_sentence(data, words):
    with pytest.raises(ServeError, match=words) as caught:
        picture_of(data, SIZE, MAX_DROPPED_PIXELS)
    assert str(caught.value).count(". ") == 0 and str(caught.value).endswith(".")


def test_files_that_cannot_be_read_are_refused(tmp_path):
    with pytest.raises(ServeError, match="is no file"):
        read_picture(tmp_path, SIZE)
    (tmp_path / "a.jpg").write_bytes(image(kind="JPEG"))
    assert read_picture(tmp_path / "a.jpg", SIZE).shape == (*SIZE, 3)


def test_bytes_from_a_page_are_pictures_and_bounded():
    assert parse_message(b"abc") == ("picture", b"abc")
    with pytest.raises(ProtocolError, match="bytes"):
        parse_message(bytes(MAX_PICTURE + 1))
    with pytest.raises(ProtocolError, match="bytes"):
        parse_message(b"")


def test_a_story_begins_with_a_picture_and_returns_to_it():
    timeline = Timeline([Gallery()], 0)
    before = timeline.shown.step
    moment = timeline.enter(image(64, 48))
    assert moment.step == before + 1 and timeline.notice == "", "half red is not strange"
    assert moment.uncertainty == pytest.approx(0.05, abs=0.005)
    timeline.enter(image(64, 48, "BMP"))
    again = timeline.restart(3)
    assert again.uncertainty == pytest.approx(0.05, abs=0.005), "the same picture"
    assert timeline.restart(4, same_picture=False).uncertainty == 0


def test_what_the_world_doubts_is_said():
    world = Gallery()
    world.spec = replace(world.spec, card={"uncertainty": {"sure": 0.01, "invents": 0.04}})
    assert uncertainty_levels(world.spec) == pytest.approx((0.01, 0.04, 0.1, 0.105))
    timeline = Timeline([world], 0, picture=picture_of(image(64, 48), SIZE))
    assert "unlike" in timeline.notice
    timeline.restart(0, same_picture=False)
    assert timeline.notice == ""


def test_a_picture_that_is_refused_leaves_the_story():
    timeline = Timeline([Gallery()], 0)
    shown = timeline.shown
    with pytest.raises(ServeError, match="no image"):
        timeline.enter(b"nothing")
    assert timeline.shown is shown
    plain = Timeline([Panorama()], 0)
    with pytest.raises(ServeError, match="takes no pictures"):
        plain.enter(image())
    assert plain.restart(1).step == 0, "it goes on without the picture"
    both = Timeline([Gallery(), Gallery()], 0)
    with pytest.raises(ServeError, match="compar"):
        both.enter(image())


def test_a_world_that_does_not_doubt_shows_no_bar():
    spec: Spec = Panorama().spec
    assert uncertainty_levels(spec) is None
    assert Timeline([Panorama()], 0).shown.uncertainty == -1


DROP = """([data, type]) => {
  const bytes = Uint8Array.from(atob(data), (letter) => letter.charCodeAt(0));
  const files = new DataTransfer();
  files.items.add(new File([bytes], 'a.png', { type }));
  window.dispatchEvent(new DragEvent('drop', { dataTransfer: files, bubbles: true, cancelable: true }));
}"""


def test_a_picture_dropped_on_the_page_is_stepped_into(serve_world, open_page):  # noqa: F811
    import base64

    world = Gallery()
    world.spec = replace(world.spec, card={"uncertainty": {"sure": 0.01, "invents": 0.04, "ceiling": 0.08}})
    page = open_page(serve_world([world]).url)
    assert page.evaluate("terrella.uncertaintyLevel") == "low"
    assert page.evaluate("document.getElementById('uncertainty').dataset.level") == "low"
    assert page.evaluate("document.getElementById('uncertainty').dataset.beyond") == "false"
    page.evaluate(DROP, [base64.b64encode(image(3000, 2000)).decode(), "image/png"])
    until(page, "terrella.uncertaintyLevel === 'high'")
    assert "unlike" in page.text_content("#toast")
    until(page, "document.getElementById('uncertainty').dataset.beyond === 'true'")  # a little later: the bar is eased
    middle = "(() => { const c = document.querySelector('figure canvas'); const d = c.getContext('2d').getImageData(4, 30, 1, 1).data; return [d[0], d[2]]; })()"  # noqa: E501
    red, blue = page.evaluate(middle)
    assert blue > 180 and red < 80
    page.evaluate(DROP, [base64.b64encode(b"no image at all").decode(), "image/png"])
    until(page, "document.getElementById('toast').textContent.includes('No picture')")
    assert page.evaluate("terrella.connected")


def test_a_page_says_that_a_world_is_played_longer_than_it_was_measured_to_be_trusted(serve_world, open_page):  # noqa: F811
    world = Gallery()
    world.spec = replace(world.spec, card={"trust_steps_measured": 3})
    page = open_page(serve_world([world]).url)
    until(page, "document.getElementById('uncertainty').dataset.beyond === 'true'")
    assert "was measured" in page.get_attribute("#uncertainty", "title")


def test_a_page_of_a_world_without_doubt_has_no_bar(serve_world, open_page):  # noqa: F811
    page = open_page(serve_world([Panorama()]).url)
    assert page.evaluate("document.getElementById('uncertainty').hidden")
    assert page.evaluate("terrella.uncertainty") == -1


@pytest.mark.parametrize("told", ["x", float("nan"), -1, None, [0.1]])
def test_a_strangers_card_does_not_set_the_bar(told):
    space = spaces.Box(0, 1, (), np.float32)
    spec = Spec("strange", spaces.Discrete(2), {"uncertainty": space}, (), 0.1, card={"uncertainty": {"sure": told}})
    assert uncertainty_levels(spec) == pytest.approx((0.02, 0.08, 0.1, 0.11))
