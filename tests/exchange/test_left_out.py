"""Nothing is lost in silence: what a format has no place for is said by name, and what fails leaves nothing behind."""

from __future__ import annotations

import errno
import json
from dataclasses import replace

import numpy as np
import pytest

from terrella.cli import main
from terrella.core.errors import DatasetError
from terrella.data import Dataset, Readings, Sensor, Source, Take
from terrella.exchange import open_source, write_source
from terrella.exchange.browse import browse

CAMERA, SAID = "observation.images.front", "observation.said"
CALIBRATION = {"width": 64, "height": 32, "K": [9.0, 0, 32, 0, 9, 16, 0, 0, 1]}
SENSORS = [
    Sensor(CAMERA, "image", (32, 64, 3), "uint8", facts={"calibration": CALIBRATION}),
    Sensor("observation.state", "vector", (2,), names=("x", "y")),
    Sensor(SAID, "vector", (1,), "string"),
    Sensor("action", "vector", (1,)),
]
WORDS = ["go", "go", "stop", "stop", "ümlaut", ""]


def _talking(notes: tuple[str, ...] = ()) -> Source:
    """One take of six rows with a picture, numbers and a text."""
    time_s = np.arange(6) / 10
    values = {
        CAMERA: np.zeros((6, 32, 64, 3), np.uint8),
        "observation.state": np.zeros((6, 2), np.float32),
        SAID: np.array(WORDS, object)[:, None],
        "action": np.zeros((6, 1), np.float32),
    }
    readings = {name: Readings(time_s, it) for name, it in values.items()}
    language = [[0.0, "push"], [0.3, "pull"]]
    take = Take(readings, "push", 1_700_000_000 * 10**9, {"language": language, "weather": "rain"})
    return Source("talk", {sensor.name: sensor for sensor in SENSORS}, lambda: [take], 10.0, notes=notes)


LOST = {  # format -> what must be named
    "lerobot": ["weather"],
    "mcap": [SAID],
    "minari": [SAID, "changes of the instruction", "weather"],
    "robomimic": [SAID, "changes of the instruction", "weather", "wall-clock time"],
    "rollouts": [SAID, "changes of the instruction", "weather"],
    "videos": [SAID, "'action'", "the instruction", "wall-clock time", f"calibration of '{CAMERA}'", "weather"],
    "images": [SAID, "'action'", "the instruction", "wall-clock time", f"calibration of '{CAMERA}'", "weather"],
}


@pytest.mark.parametrize("to", LOST)
def test_every_format_says_what_it_has_no_place_for(tmp_path, to):
    name = {"mcap": "log", "robomimic": "set.hdf5"}.get(to, "set-v0")
    told = write_source(_talking(("the file was cut off at byte 9",)), tmp_path / name, to)
    assert told[0] == "the file was cut off at byte 9", "what was lost in reading is said whatever is written"
    for what in LOST[to]:
        assert any(what in sentence for sentence in told), what
    assert len(told) == len(set(told))
    found = open_source(tmp_path / name)
    (take,) = found.takes()
    assert len(next(iter(take.readings.values())).values) in (5, 6)


def test_what_an_mcap_file_loses_is_said_whatever_it_becomes(tmp_path, capsys):
    writer_of = pytest.importorskip("mcap.writer")
    with open(tmp_path / "log.mcap", "wb") as file:
        writer = writer_of.Writer(file, chunk_size=500)
        writer.start()
        schemas = {"foxglove.Log": "/rosout", "my.Labels": "/labels", "my.State": "/state", "my.Ros": "/scan"}
        channels = {}
        for name, topic in schemas.items():
            number = writer.register_schema(name, "jsonschema", b"{}")
            channels[topic] = writer.register_channel(topic, "cdr" if name == "my.Ros" else "json", number)
        writer.add_attachment(0, 0, "arm.urdf", "text/xml", b"<robot/>")
        for i in range(40):
            said = {"message": f"step {i}", "level": 2, "name": "arm"}
            for topic, fields in (
                ("/rosout", said),
                ("/labels", {"label": "cup"}),
                ("/state", {"x": i}),
                ("/scan", {}),
            ):
                writer.add_message(channels[topic], i * 10**8, json.dumps(fields).encode(), i * 10**8)
        writer.finish()
    whole = (tmp_path / "log.mcap").read_bytes()
    (tmp_path / "log.mcap").write_bytes(whole[: len(whole) * 2 // 3])
    for to in ("lerobot", "mcap", "rollouts"):
        out = tmp_path / f"out-{to}"
        assert main(["data", "convert", str(tmp_path / "log.mcap"), str(out), "--to", to, "--json"]) == 0
        told = " ".join(json.loads(capsys.readouterr().out)["left_out"])
        for what in ("cut off", "arm.urdf", "/labels", "/scan", "log texts", "/rosout"):
            assert what in told, (to, what)


def test_text_stays_text_in_lerobot_and_is_read_beside_the_pictures(tmp_path):
    write_source(_talking(), tmp_path / "one")
    write_source(open_source(tmp_path / "one"), tmp_path / "two")
    for root in (tmp_path / "one", tmp_path / "two"):
        (take,) = open_source(root).takes()
        assert [str(value[0]) for value in take.readings[SAID].values] == WORDS
        looked = browse(root)
        assert SAID not in [sensor["name"] for sensor in looked.about()["sensors"]]
        facts = looked.episode(0)
        texts = [text for _, text in facts["language"] if text.startswith("said")]
        assert texts == ["said: go", "said: stop", "said: ümlaut", "said: "] and SAID not in facts["sensors"]


def test_the_command_lists_what_was_left_out(tmp_path, capsys):
    write_source(_talking(), tmp_path / "one")
    assert main(["data", "convert", str(tmp_path / "one"), str(tmp_path / "films"), "--to", "videos", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert any(SAID in what for what in facts["left_out"]) and (tmp_path / "films" / "take_0").is_dir()
    assert main(["data", "convert", str(tmp_path / "one"), str(tmp_path / "more"), "--to", "rollouts"]) == 0
    assert f"left out or changed: '{SAID}'" in capsys.readouterr().out


@pytest.mark.parametrize("full", [errno.ENOSPC, errno.EIO])
def test_a_full_disk_leaves_nothing_and_says_so(tmp_path, monkeypatch, full):
    from terrella.data.writer import Writer

    put, put_so_far = Writer.put, []

    def fails(*given, **more):
        if put_so_far:
            raise OSError(full, "No space left on device" if full == errno.ENOSPC else "Input/output error")
        put_so_far.append(put(*given, **more))
        return put_so_far[-1]

    monkeypatch.setattr(Writer, "put", fails)
    source = _talking()
    twice = Source("twice", source.sensors, lambda: [*source.takes(), *source.takes()], 10.0)
    with pytest.raises(DatasetError) as raised:
        write_source(twice, tmp_path / "set")
    sentence = str(raised.value)
    assert "was not written" in sentence and "safe" not in sentence and str(tmp_path / "set") in sentence
    assert ("disk is full" in sentence) == (full == errno.ENOSPC)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("to", ["lerobot", "mcap", "minari", "robomimic", "rollouts", "videos", "images"])
def test_ctrl_c_leaves_nothing_and_says_so(tmp_path, monkeypatch, capsys, to):
    write_source(_talking(), tmp_path / "one")
    source = open_source(tmp_path / "one")

    def stopped():
        yield from source.takes()
        raise KeyboardInterrupt

    interrupted = Source(source.name, source.sensors, stopped, source.fps)
    monkeypatch.setattr("terrella.exchange.convert.open_source", lambda *given: interrupted)
    with pytest.raises(SystemExit) as ended:
        main(["data", "convert", "x", str(tmp_path / "set-v0"), "--to", to])
    assert ended.value.code == 130
    said = capsys.readouterr().err
    assert "nothing was written" in said and "is kept" not in said
    assert [path.name for path in tmp_path.iterdir()] == ["one"]


def test_the_viewer_shows_all_cameras_and_the_units_of_axes(tmp_path):
    cameras = [f"observation.images.{name}" for name in ("front", "wrist", "top")]
    sensors = [Sensor(name, "image", (16, 32, 3), "uint8") for name in cameras]
    sensors += [Sensor("observation.depth.wrist", "depth", (4, 8))]
    sensors += [Sensor("action", "vector", (2,), names=("lift", "grip"), units={"lift": "m", "grip": "N"})]
    time_s = np.arange(3) / 10
    values = {it.name: Readings(time_s, np.zeros((3, *it.shape), it.dtype)) for it in sensors}
    mount = {"intrinsics": [1, 1, 0.5, 0.5], "size": [16, 32], "pose": "pose", "mount": [0.1, 0, 0, 1, 0, 0, 0]}
    facts = {"world": {"cameras": {"rgb.wrist": mount}}}
    source = Source("arm", {it.name: it for it in sensors}, lambda: [Take(values)], 10.0, facts=facts)
    write_source(source, tmp_path / "arm")
    looked = browse(tmp_path / "arm")
    shown = {sensor["name"]: sensor for sensor in looked.about()["sensors"]}
    assert [name for name in shown if shown[name]["kind"] == "image"] == cameras
    assert shown["observation.depth.wrist"]["kind"] == "depth"
    assert shown["observation.images.wrist"]["camera"] == mount and shown[cameras[0]]["camera"] is None
    assert shown["action"]["names"] == ["lift", "grip"] and shown["action"]["units"] == ["m", "N"]
    for name in [*cameras, "observation.depth.wrist"]:
        assert looked.reading(0, name, 2).shape[:2] == tuple(shown[name]["shape"][:2])


def test_an_export_from_the_viewer_is_a_recording(tmp_path):
    write_source(_talking(), tmp_path / "one")
    calls = []
    browse(tmp_path / "one").export(tmp_path / "good", [0], lambda *done: None)
    assert Dataset(tmp_path / "good").length == 6
    browse(tmp_path / "one", carry=lambda *given: calls.append(given[:3]) or []).export(tmp_path / "bits", [0], print)
    assert calls == [(tmp_path / "one", tmp_path / "bits", [0])]


def test_an_export_counts_what_it_wrote_and_says_what_it_left_out(tmp_path):
    (whole,) = _talking().takes()
    single = Take({name: Readings(it.time_s[:1], it.values[:1]) for name, it in whole.readings.items()}, "one row")
    source = replace(_talking(), takes=lambda: [whole, whole, single])
    write_source(source, tmp_path / "log", "mcap")
    count, notes = browse(tmp_path / "log").export(tmp_path / "good", [1, 2], lambda *done: None)
    assert count == len(Dataset(tmp_path / "good").episodes) == 1
    assert any("was left out: it has 1 row" in note for note in notes)


@pytest.mark.parametrize(
    "value, words", [(80.0, ["beyond 65.535 m"]), (1.2344, ["rounded to 1 mm"]), (2.5, []), (np.inf, [])]
)
def test_what_depth_loses_in_lerobot_is_said(tmp_path, value, words):
    depth = Sensor("observation.depth", "depth", (4, 6))
    take = Take({depth.name: Readings(np.arange(3) / 10, np.full((3, 4, 6), value, np.float32))})
    notes = write_source(Source("deep", {depth.name: depth}, lambda: [take], 10.0), tmp_path / "set")
    assert len(notes) == len(words) and all(word in note for word, note in zip(words, notes))
