"""Folders of videos and images: true times, exact values where the format is exact, and clear words where it is not."""

from __future__ import annotations

from fractions import Fraction

import av
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image

from terrella.core.errors import DatasetError
from terrella.data.source import Readings, Sensor, Source, Take
from terrella.exchange.formats import images, rows, videos

RGB = "observation.images.rgb"


def coloured(number: int, height: int = 48, width: int = 64) -> np.ndarray:
    """A picture whose grey tells its number even after H.264."""
    found = np.full((height, width, 3), 20 + 7 * number % 220, np.uint8)
    found[: height // 4, : width // 4] = (255, 0, 0)
    return found


def source_of(takes: list[dict[str, tuple[list[float], np.ndarray]]], kinds=None, fps=None, **more) -> Source:
    first = takes[0]
    sensors = {}
    for name, (_, values) in first.items():
        kind = (kinds or {}).get(name, "image")
        sensors[name] = Sensor(name, kind, values.shape[1:], values.dtype.name)
    made = [Take({n: Readings(np.array(t, np.float64), v) for n, (t, v) in take.items()}) for take in takes]
    return Source("made", sensors, lambda: iter(made), fps, **more)


def times(count: int, fps: float = 10) -> list[float]:
    return [i / fps for i in range(count)]


def encode(path, ticks: list[int], codec="libx264", fmt=None, time_base=Fraction(1, 1000), size=(48, 64), options=None):
    with av.open(str(path), "w", format=fmt) as container:
        stream = container.add_stream(codec, rate=10, options=options or {})
        stream.height, stream.width = size
        stream.bit_rate = 4_000_000
        stream.pix_fmt = "yuv420p"
        stream.time_base = stream.codec_context.time_base = time_base
        for number, tick in enumerate(ticks):
            frame = av.VideoFrame.from_ndarray(coloured(number, *size), format="rgb24")
            frame.pts, frame.time_base = tick, time_base
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def number_of(picture: np.ndarray) -> int:
    return round((float(picture[-8:, -8:].mean()) - 20) / 7)


# -- videos


def test_times_of_variable_rate_are_the_files_own_and_b_frames_come_in_order(tmp_path):
    ticks = [0, 40, 75, 180, 181, 300, 420, 421, 500, 900, 1000, 1033]
    encode(tmp_path / "phone.mp4", ticks, options={"bf": "3", "g": "5", "b-pyramid": "normal"})
    source = videos.read(tmp_path)
    (take,) = source.takes()
    np.testing.assert_allclose(take.readings[RGB].time_s, np.array(ticks) / 1000, atol=1e-9)
    assert "action" not in source.sensors and source.fps is None
    assert source.sensors[RGB].shape == (48, 64, 3)
    assert [number_of(value) for value in take.readings[RGB].values] == list(range(12))


@pytest.mark.parametrize(
    ("name", "codec", "fmt"),
    [("a.mp4", "libx264", None), ("a.mkv", "libx264", None), ("a.webm", "libvpx", None), ("a.avi", "mpeg4", None),
     ("a.ts", "libx264", "mpegts"), ("a.gif", "gif", None), ("a.mpg", "mpeg2video", None)],
)  # fmt: skip
def test_random_access_gives_what_reading_in_order_gives(tmp_path, name, codec, fmt):
    if codec == "gif":
        frames = [Image.fromarray(coloured(i)) for i in range(30)]
        frames[0].save(tmp_path / name, save_all=True, append_images=frames[1:], duration=100)
    else:
        base = Fraction(1, 25) if codec == "mpeg2video" else Fraction(1, 10)
        encode(tmp_path / name, list(range(30)), codec, fmt, base, options={"g": "7"})
    (take,) = videos.read(tmp_path).takes()
    readings = take.readings[RGB]
    assert len(readings.time_s) == 30 and (np.diff(readings.time_s) > 0).all() and readings.time_s[0] == 0
    in_order = np.stack(list(readings.values))
    assert [number_of(value) for value in in_order] == list(range(30))
    (again,) = videos.read(tmp_path).takes()
    for i in np.random.default_rng(0).permutation(30)[:15].tolist() + [29, 29, 0, -1]:
        np.testing.assert_array_equal(again.readings[RGB].values[i], in_order[i])


def test_reading_in_order_opens_the_file_once_and_closes_it(tmp_path, monkeypatch):
    encode(tmp_path / "a.mp4", list(range(40)), time_base=Fraction(1, 10), options={"g": "4"})
    (take,) = videos.read(tmp_path).takes()
    begun = []
    original = videos._decoded
    monkeypatch.setattr(videos, "_decoded", lambda path, film, to: (begun.append(to), original(path, film, to))[1])
    values = take.readings[RGB].values
    for i in range(40):
        values[i], values[i]
    assert begun == [None]
    values[33], values[34], values[2]
    assert len(begun) == 3 and begun[1] is not None
    assert values[5] is not values[5]  # what a caller paints over does not come back painted


def test_a_phones_rotation_is_applied(tmp_path):
    encode(tmp_path / "a.mp4", [0, 1, 2], time_base=Fraction(1, 10))
    data = bytearray((tmp_path / "a.mp4").read_bytes())
    at = data.index(b"tkhd") + 4 + 40  # version and flags, times, …; then the matrix
    one = (1 << 16).to_bytes(4, "big")
    clockwise = [
        b"\0" * 4,
        one,
        b"\0" * 4,
        (-(1 << 16)).to_bytes(4, "big", signed=True),
        *[b"\0" * 4] * 4,
        b"\x40\0\0\0",
    ]
    data[at : at + 36] = b"".join(clockwise)
    (tmp_path / "a.mp4").write_bytes(data)
    source = videos.read(tmp_path)
    (take,) = source.takes()
    assert source.sensors[RGB].shape == (64, 48, 3)
    picture = take.readings[RGB].values[1]
    assert picture.shape == (64, 48, 3)
    assert picture[4, -4, 0] > 200 > 100 > picture[4, 4, 0]  # the red corner went from top left to top right


def test_sub_folders_are_takes_and_their_videos_cameras(tmp_path):
    for take, cameras in {"ep_10": ("front",), "ep_2": ("front", "wrist left")}.items():
        (tmp_path / take).mkdir()
        for camera in cameras:
            encode(tmp_path / take / f"{camera}.mp4", [0, 1, 2], time_base=Fraction(1, 10))
    (tmp_path / "notes.txt").write_text("no video")
    source = videos.read(tmp_path)
    assert set(source.sensors) == {"observation.images.front", "observation.images.wrist_left"}
    takes = list(source.takes())
    assert [take.facts["file"] for take in takes] == ["ep_2", "ep_10"]
    assert [len(take.readings) for take in takes] == [2, 1]


def test_lossy_videos_keep_cameras_in_step_and_say_what_is_left_out(tmp_path):
    data = np.stack([coloured(i) for i in range(9)])
    source = source_of(
        [{"observation.images.a": (times(9), data), "observation.images.b": ([t + 0.05 for t in times(9)], data),
          "action": (times(9), np.zeros((9, 2), np.float32))}], {"action": "vector"},
    )  # fmt: skip
    notes = videos.write(source, tmp_path / "out")
    assert len(notes) == 1 and "'action'" in notes[0]
    (take,) = videos.read(tmp_path / "out").takes()
    np.testing.assert_allclose(take.readings["observation.images.a"].time_s, times(9), atol=1e-6)
    np.testing.assert_allclose(take.readings["observation.images.b"].time_s, np.array(times(9)) + 0.05, atol=1e-6)
    assert [number_of(v) for v in take.readings["observation.images.b"].values] == list(range(9))


def test_bad_videos_are_named(tmp_path):
    with pytest.raises(DatasetError, match="no videos"):
        videos.read(tmp_path)
    with pytest.raises(DatasetError, match="not a folder"):
        videos.read(tmp_path / "none")
    encode(tmp_path / "b.mp4", list(range(30)), time_base=Fraction(1, 10))
    whole = (tmp_path / "b.mp4").read_bytes()
    for damaged in (b"", b"no video at all", whole[: len(whole) // 2], b"#EXTM3U\n#EXTINF:1,\nb.mp4\n"):
        (tmp_path / "b.mp4").write_bytes(damaged)
        with pytest.raises(DatasetError, match=r"b\.mp4"):
            list(videos.read(tmp_path).takes())
    (tmp_path / "b.mp4").write_bytes(whole)
    encode(tmp_path / "c.mp4", [0, 1], time_base=Fraction(1, 10), size=(32, 32))
    with pytest.raises(DatasetError, match=r"c\.mp4 is 32 x 32 where"):
        list(videos.read(tmp_path).takes())
    (tmp_path / "folder").mkdir()
    (tmp_path / "c.mp4").rename(tmp_path / "folder" / "c.mp4")
    with pytest.raises(DatasetError, match="next to folders"):
        videos.read(tmp_path)


def test_every_flipped_byte_is_an_error_or_a_picture_of_the_right_size(tmp_path):
    encode(tmp_path / "a.mp4", list(range(12)), time_base=Fraction(1, 10))
    whole = (tmp_path / "a.mp4").read_bytes()
    rng, errors = np.random.default_rng(1), 0
    for at in rng.integers(0, len(whole), 60).tolist():
        data = bytearray(whole)
        data[at] ^= 1 << int(rng.integers(8))
        (tmp_path / "a.mp4").write_bytes(data)
        try:
            source = videos.read(tmp_path)
            (take,) = source.takes()
            for value in take.readings[RGB].values:
                assert value.shape == source.sensors[RGB].shape
        except DatasetError:
            errors += 1
    assert 0 < errors < 60


def test_absurd_sizes_are_refused(tmp_path, monkeypatch):
    encode(tmp_path / "a.mp4", [0, 1], time_base=Fraction(1, 10))
    Image.new("RGB", (64, 48)).save(tmp_path / "a.png")
    monkeypatch.setattr(rows, "MAX_PIXELS", 1000)
    for read in (videos.read, lambda path: images.read(path, 10)):
        with pytest.raises(DatasetError, match="64 x 48"):
            read(tmp_path)


def test_what_cannot_be_a_video_is_said_and_nothing_is_left_behind(tmp_path):
    odd, even = np.zeros((2, 5, 4, 3), np.uint8), np.zeros((2, 4, 4, 3), np.uint8)
    with pytest.raises(DatasetError, match="even sizes"):
        videos.write(source_of([{RGB: (times(2), odd)}]), tmp_path / "out")
    with pytest.raises(DatasetError, match="within a microsecond"):
        videos.write(source_of([{RGB: ([0, 1e-7], even)}]), tmp_path / "out")
    with pytest.raises(DatasetError, match="ascending"):
        videos.write(source_of([{RGB: ([0, np.nan], even)}]), tmp_path / "out")
    with pytest.raises(DatasetError, match="no pictures"):
        vectors = {"action": (times(2), np.zeros((2, 1)))}
        videos.write(source_of([vectors], {"action": "vector"}), tmp_path / "out")
    assert list(tmp_path.iterdir()) == []
    videos.write(source_of([{RGB: (times(2), even)}]), tmp_path / "out")
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["take_0.mp4"]
    with pytest.raises(DatasetError, match="exists already"):
        videos.write(source_of([{RGB: (times(2), even)}]), tmp_path / "out")


# -- images


@settings(max_examples=12)
@given(
    data=hnp.arrays(np.uint8, st.tuples(st.integers(1, 12), st.integers(1, 9), st.integers(1, 9), st.just(3))),
    depth_mm=hnp.arrays(np.uint16, (4, 5)),
    plain=st.booleans(),
)
def test_images_are_exact(tmp_path_factory, data, depth_mm, plain):
    folder = tmp_path_factory.mktemp("i")
    depth_m = np.where(depth_mm > 0, depth_mm.astype(np.float32) / np.float32(1000), np.float32(np.inf))
    seen = {RGB: (times(len(data)), data)}
    if not plain:
        seen = {
            "observation.images.front": (times(len(data)), data),
            "observation.depth.front": (times(len(data)), np.stack([depth_m] * len(data))),
            "observation.depth": (times(len(data)), np.stack([depth_m] * len(data))),
        }
    kinds = {name: "depth" for name in seen if name.startswith("observation.depth")}
    assert images.write(source_of([seen, seen], kinds, fps=10), folder / "a") == []
    first = images.read(folder / "a", 10)
    images.write(first, folder / "b")
    for source in (first, images.read(folder / "b", 10)):
        assert set(source.sensors) == set(seen)
        takes = list(source.takes())
        assert len(takes) == 2
        for name, (time_s, values) in seen.items():
            assert source.sensors[name].kind == kinds.get(name, "image")
            found = takes[1].readings[name]
            np.testing.assert_array_equal(np.stack(list(found.values)), values)
            np.testing.assert_array_equal(found.time_s, time_s)


def test_images_are_sorted_naturally_turned_upright_and_made_rgb(tmp_path):
    for number in (1, 2, 10):
        picture = Image.fromarray(coloured(number))
        exif = Image.Exif()
        exif[0x0112] = 6  # hold the camera upright: turn clockwise to see
        picture.save(tmp_path / f"frame{number}.png", exif=exif)
    (tmp_path / "frame3.txt").write_text("not an image")
    source = images.read(tmp_path, 5)
    (take,) = source.takes()
    assert source.fps == 5 and source.sensors[RGB].shape == (64, 48, 3)
    values = list(take.readings[RGB].values)
    assert [number_of(value) for value in values] == [1, 2, 10]
    assert values[0][2, -2].tolist() == [255, 0, 0] != values[0][2, 2].tolist()
    for mode in ("L", "P", "RGBA", "1"):
        Image.fromarray(coloured(1)).convert(mode).save(tmp_path / "frame1.png")
        Image.fromarray(coloured(1)).convert(mode).rotate(90, expand=True).save(tmp_path / "frame1.png")
        (take,) = images.read(tmp_path, 5).takes()
        assert take.readings[RGB].values[0].shape == (64, 48, 3)


def test_mixed_sizes_and_kinds_are_named(tmp_path):
    Image.new("RGB", (8, 6)).save(tmp_path / "1.png")
    Image.new("RGB", (8, 7)).save(tmp_path / "2.png")
    with pytest.raises(DatasetError, match=r"2\.png is a picture of 8 x 7 where .* a picture of 8 x 6"):
        list(images.read(tmp_path, 5).takes())
    Image.fromarray(np.full((6, 8), 1500, np.uint16)).save(tmp_path / "2.png")
    with pytest.raises(DatasetError, match=r"2\.png is depth of 8 x 6"):
        list(images.read(tmp_path, 5).takes())
    (tmp_path / "1.png").unlink()
    (take,) = images.read(tmp_path, 5).takes()
    assert take.readings["observation.depth"].values[0][0, 0] == np.float32(1.5)


def test_bad_images_are_named(tmp_path):
    with pytest.raises(DatasetError, match="no images"):
        images.read(tmp_path, 5)
    with pytest.raises(DatasetError, match="fps"):
        images.read(tmp_path, float("nan"))
    Image.fromarray(coloured(1)).save(tmp_path / "1.png")
    whole = (tmp_path / "1.png").read_bytes()
    for damaged in (b"", b"no image", whole[:20]):
        (tmp_path / "1.png").write_bytes(damaged)
        with pytest.raises(DatasetError, match=r"1\.png"):
            list(images.read(tmp_path, 5).takes())
    (tmp_path / "1.png").write_bytes(whole[: len(whole) // 2])
    (take,) = images.read(tmp_path, 5).takes()
    with pytest.raises(DatasetError, match=r"1\.png is damaged"):
        take.readings[RGB].values[0]
    Image.new("1", (16_000, 6000)).save(tmp_path / "1.png")  # more than Pillow itself would open
    with pytest.raises(DatasetError, match=r"1\.png"):
        images.read(tmp_path, 5)


def test_depth_beyond_sixteen_bits_is_nothing(tmp_path):
    depth = np.array([[[0.0, 0.0004, 1.2344, 65.535, 65.6, np.inf, np.nan, -1.0]]], np.float32)
    source = source_of([{"observation.depth": ([0.0], depth)}], {"observation.depth": "depth"}, fps=1)
    notes = images.write(source, tmp_path / "d")
    assert len(notes) == 2 and "beyond 65.535 m" in notes[0] and "rounded to 1 mm" in notes[1]
    (take,) = images.read(tmp_path / "d", 1).takes()
    found = take.readings["observation.depth"].values[0][0]
    inf = np.inf
    np.testing.assert_array_equal(found, np.array([inf, inf, 1.234, 65.535, inf, inf, inf, inf], np.float32))
