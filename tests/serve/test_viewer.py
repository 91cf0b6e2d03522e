"""The server of a recording's page: what it answers, whom it refuses, and where alone it writes."""

from __future__ import annotations

import struct
import threading
import time

import httpx
import numpy as np
import pytest
import simplejpeg
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from terrella.core.errors import DatasetError
from terrella.data.source import Lazy, Readings, Source, Take
from terrella.exchange.browse import Browse
from terrella.serve import readings
from terrella.serve.viewer import view

from . import rig
from .viewed import asked

FRONT, LEFT, DEPTH, LIDAR, ACTION, STATE, REWARD, DONE, IMU = range(9)  # in the order of the page
WAYS = (
    "/about", "/episode/0", f"/times/0/{FRONT}", f"/series/0/{STATE}", f"/reading/0/{FRONT}/0", "/export",
)  # fmt: skip


def browse_of(folder, source=None, export=None) -> Browse:
    return Browse(source or rig.lively(), folder / "marks.json", export=export)


@pytest.fixture
def client(tmp_path):
    with asked(browse_of(tmp_path)) as client:
        yield client


def settled(client: httpx.Client) -> dict:
    end = time.monotonic() + 20
    while (status := client.get("/export").json())["state"] == "running":
        assert time.monotonic() < end, status
        time.sleep(0.01)
    return status


def test_about_lists_all(client):
    about = client.get("/about").json()
    assert [sensor["label"] for sensor in about["sensors"]] == [
        "front", "left", "depth", "lidar", "action", "state", "reward", "done", "imu",
    ]  # fmt: skip
    assert [episode["task"] for episode in about["episodes"]] == [*rig.TASKS, *rig.TASKS]
    assert about["bad"] == [] and about["export_to"] == ""
    assert about["sensors"][STATE]["pose"]["quaternion"] == [3, 4, 5, 6]
    facts, take = client.get("/episode/1").json(), list(rig.lively().takes())[1]
    assert facts["sensors"] == {name: {"count": len(own.time_s), "fault": ""} for name, own in take.readings.items()}
    assert facts["language"][0] == [0.0, "leave the corner"]


def test_readings_travel_unharmed(client):
    take = list(rig.lively().takes())[1]
    front = take.readings["observation.images.front"]
    answer = client.get(f"/reading/1/{FRONT}/40")
    assert answer.headers["content-type"] == "image/jpeg"
    seen = simplejpeg.decode_jpeg(answer.content, colorspace="RGB").astype(int)
    assert np.abs(seen - front.values[40]).mean() < 6
    assert simplejpeg.decode_jpeg_header(client.get(f"/reading/1/{FRONT}/40?across=32").content)[:2] == (24, 32)
    assert simplejpeg.decode_jpeg_header(client.get(f"/reading/1/{FRONT}/40?across=40").content)[:2] == (48, 64)

    content = client.get(f"/reading/1/{DEPTH}/7").content
    height, width, near, far = struct.unpack_from("<IIff", content)
    depth = np.frombuffer(content, "<f2", offset=16).reshape(height, width)
    truth = take.readings["observation.depth"].values[7]
    np.testing.assert_allclose(depth, truth, rtol=1e-3)
    assert np.isinf(depth).any() and 0 < near < far < 15

    content = client.get(f"/reading/1/{LIDAR}/3").content
    cloud = np.frombuffer(content, "<f4", offset=8).reshape(struct.unpack_from("<II", content))
    np.testing.assert_array_equal(cloud, take.readings["observation.points.lidar"].values[3])

    times = np.frombuffer(client.get(f"/times/1/{LEFT}").content, "<f8")
    np.testing.assert_array_equal(times, take.readings["observation.images.left"].time_s)


def unpack(content: bytes) -> tuple[int, int, np.ndarray, list[np.ndarray]]:
    mode, n, k, first = struct.unpack_from("<IIII", content)
    numbers = np.frombuffer(content, "<f8", offset=16)
    assert len(numbers) == n * (1 + k * (1 + mode))
    return mode, first, numbers[:n], list(numbers[n:].reshape(1 + mode, n, k))


def test_series_are_exact_where_they_fit(client):
    state = list(rig.lively().takes())[0].readings["observation.state"]
    mode, first, times, (values,) = unpack(client.get(f"/series/0/{STATE}").content)
    assert (mode, first) == (readings.EXACT, 0)
    np.testing.assert_array_equal(times, state.time_s)
    np.testing.assert_array_equal(values, np.asarray(state.values, np.float64))
    mode, first, times, (values,) = unpack(client.get(f"/series/0/{STATE}?from=1&to=2&buckets=64").content)
    assert mode == readings.EXACT and times[0] <= 1 and times[-1] >= 2
    np.testing.assert_array_equal(values, np.asarray(state.values, np.float64)[first : first + len(times)])
    mode, _, times, (low, high) = unpack(client.get(f"/series/0/{IMU}?buckets=32").content)
    assert mode == readings.ENVELOPE and len(times) <= 32 and (low <= high).all()
    _, _, flags, _ = unpack(client.get(f"/series/0/{DONE}?pick=1&buckets=4").content)
    assert len(flags) <= 8


clocks = st.lists(st.floats(0, 100), min_size=1, max_size=80).map(sorted)


@given(clocks, st.integers(1, 12), st.integers(1, 3), st.data())
def test_an_envelope_hides_nothing(clock, buckets, columns, data):
    """Slow twin: every value lies between the least and the greatest of the bucket that holds its time."""
    time_s = np.array(clock)
    numbers = st.floats(-1e6, 1e6) | st.just(float("nan"))
    values = data.draw(arrays.arrays(np.float64, (len(clock), columns), elements=numbers))
    mode, first, starts, blocks = unpack(readings.series(time_s, values, -np.inf, np.inf, buckets))
    assert first == 0
    if mode == readings.EXACT:
        np.testing.assert_array_equal(starts, time_s)
        np.testing.assert_array_equal(blocks[0], values)
        return
    assert len(time_s) > 2 * buckets and 1 <= len(starts) <= buckets
    low, high = blocks
    for at, row in zip(time_s, values, strict=True):
        bucket = int(np.searchsorted(starts, at, "right")) - 1
        for column, value in enumerate(row):
            assert np.isnan(value) or low[bucket, column] <= value <= high[bucket, column]
    assert set(low[~np.isnan(low)]) | set(high[~np.isnan(high)]) <= set(values.ravel()), "no number is made up"


@given(arrays.arrays(np.float32, arrays.array_shapes(min_dims=2, max_dims=2), elements=st.floats(width=32)))
def test_any_depth_and_any_cloud_can_be_sent(value):
    span = readings.depth_span([value])
    assert np.isfinite(span).all() and span[0] < span[1]
    assert len(readings.depth(value, span)) == 16 + 2 * value.size
    n, k = struct.unpack_from("<II", readings.points(value))
    assert k == value.shape[1] and n <= len(value)


def test_large_ones_are_thinned():
    cloud = np.ones((1_000_000, 3), np.float32)
    assert struct.unpack_from("<I", readings.points(cloud))[0] <= readings.MOST_POINTS
    height, width = struct.unpack_from("<II", readings.depth(np.ones((1200, 1600), np.float32), (0.0, 1.0)))
    assert (height, width) == (300, 400)


@pytest.mark.parametrize(
    "path, status",
    [
        ("/episode/99", 422), ("/times/0/99", 422), (f"/reading/0/{FRONT}/999999", 422), (f"/reading/0/{STATE}/0", 422),
        (f"/series/0/{FRONT}", 422), (f"/series/0/{STATE}?from=soon", 422), (f"/series/0/{STATE}?buckets=nan", 422),
        ("/episode/-1", 404), ("/episode/x", 404), ("/reading/0/observation.state/0", 404), ("/view/../viewer.py", 404),
        ("/view/%2e%2e/%2e%2e/viewer.py", 404), ("/marks.json", 404), (f"/reading/{10**30}/0/0", 422),
    ],
)  # fmt: skip
def test_what_is_not_there_is_said(client, path, status):
    answer = client.get(path)
    assert answer.status_code == status and "Traceback" not in answer.text


@pytest.mark.parametrize("buckets", ["inf", "-inf", "1e300"])
def test_buckets_keep_to_their_limits(client, buckets):
    assert client.get(f"/series/0/{STATE}?buckets={buckets}").status_code == 200


def test_every_file_of_the_page_is_served_and_guarded(client):
    page = client.get("/").text
    assert "<script>" not in page and "style=" not in page, "the policy forbids both"
    for path in ("/", "/style.css", "/icon.svg", "/view/view.css", "/view/app.js", "/view/points.js"):
        answer = client.get(path)
        assert answer.status_code == 200 and "script-src 'self'" in answer.headers["content-security-policy"]


@pytest.mark.parametrize("headers", [{"host": "evil.example"}, {"origin": "http://evil.example"}, {"origin": "null"}])
def test_foreign_pages_are_refused(client, headers):
    for way in WAYS:
        assert client.get(way, headers=headers).status_code == 403
    assert client.post("/mark", json={"episode": 0, "bad": True}, headers=headers).status_code == 403
    assert client.post("/export", headers=headers).status_code == 403
    assert client.get("/about").json()["bad"] == []


@pytest.mark.parametrize("token", [None, ""])
def test_an_address_that_others_reach_gets_a_token(token, tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr("uvicorn.Server.run", lambda server, sockets: None)
    monkeypatch.setattr("terrella.serve.http_server.is_loopback", lambda host: False)
    monkeypatch.setattr("terrella.serve.http_server.page_address", lambda host, port, token: seen.append(token))
    view(browse_of(tmp_path), port=0, token=token)
    assert isinstance(seen[0], str) and len(seen[0]) > 16


def test_the_token_is_asked_of_everything(tmp_path):
    with asked(browse_of(tmp_path), host="0.0.0.0", token="sesame", export_to=tmp_path / "good") as client:
        for token in ("", "?token=simsim", "?token="):
            for way in WAYS:
                assert client.get(way + token).status_code == 403
            assert client.post(f"/mark{token}", json={"episode": 0, "bad": True}).status_code == 403
            assert client.post(f"/export{token}").status_code == 403
        for way in WAYS:
            assert client.get(f"{way}?token=sesame").status_code == 200
    assert not (tmp_path / "marks.json").exists()


def test_marks_are_kept(client, tmp_path):
    assert client.post("/mark", json={"episode": 2, "bad": True}).json() == {"bad": [2]}
    assert client.post("/mark", json={"episode": 0, "bad": True}).json() == {"bad": [0, 2]}
    assert client.post("/mark", json={"episode": 2, "bad": False}).json() == {"bad": [0]}
    assert browse_of(tmp_path).marks() == [0]
    assert client.get("/about").json()["bad"] == [0]


@pytest.mark.parametrize(
    "body", [b"", b"{", b"[]", b'{"episode": 0}', b'{"episode": "0", "bad": true}', b'{"episode": true, "bad": true}',
             b'{"episode": 0, "bad": 1}', b'{"episode": 99, "bad": true}', b'{"episode": 0, "bad": true}' + b" " * 5000,
             b"\xff\xfe", b"[" * 4000],
)  # fmt: skip
def test_bad_marks_are_refused(client, tmp_path, body):
    assert client.post("/mark", content=body).status_code == 422
    assert client.get("/mark").status_code == 405
    assert not (tmp_path / "marks.json").exists()


def test_export_writes_the_good_ones_where_the_server_said(tmp_path):
    calls = []

    def export(path, keep, report):
        report(0, len(keep))
        path.mkdir()
        (path / "episodes").write_text(str(keep))
        calls.append((path, keep))

    target = tmp_path / "small-good"
    with asked(browse_of(tmp_path, export=export), export_to=target) as client:
        assert client.get("/about").json()["export_to"] == str(target)
        client.post("/mark", json={"episode": 1, "bad": True})
        assert client.post("/export", json={"path": "/tmp/elsewhere"}).status_code == 200
        status = settled(client)
        assert status["state"] == "done" and "3 episodes" in status["text"]
        assert calls == [(target, [0, 2, 3])]
        again = client.post("/export")
        assert again.status_code == 422 and "exists already" in again.text
        for number in range(4):
            client.post("/mark", json={"episode": number, "bad": True})
        (target / "episodes").unlink()
        target.rmdir()
        assert "nothing to export" in client.post("/export").text
    assert len(calls) == 1


def test_an_export_that_left_something_out_says_so(tmp_path):
    browse = browse_of(tmp_path, export=lambda path, keep, report: ())
    browse.export = lambda path, keep, report: (2, ["take 1 was left out: it has 1 row"])
    with asked(browse, export_to=tmp_path / "good") as client:
        client.post("/export")
        text = settled(client)["text"]
    assert text.startswith("2 episodes written") and "of 4 marked good" in text and "take 1 was left out" in text


def test_an_export_that_fails_is_told(tmp_path):
    def full(path, keep, report):
        raise DatasetError("the disk is full; free some space.")

    with asked(browse_of(tmp_path, export=full), export_to=tmp_path / "good") as client:
        client.post("/export")
        assert settled(client) == {"state": "failed", "text": "the disk is full; free some space.", "done": 0, "of": 4}
    with asked(browse_of(tmp_path)) as client:
        assert "looking only" in client.post("/export").text


def test_an_export_ends_with_the_server_and_does_not_stop_the_page(tmp_path):
    begun, ended = threading.Event(), []

    def slow(path, keep, report):
        try:
            while True:
                report(1, len(keep))
                begun.set()
                time.sleep(0.005)
        finally:
            ended.append(path)

    with asked(browse_of(tmp_path, export=slow), export_to=tmp_path / "good") as client:
        client.post("/export")
        assert begun.wait(10)
        assert "under way" in client.post("/export").text
        assert client.get(f"/reading/0/{FRONT}/0").status_code == 200
    assert ended == [tmp_path / "good"]


def test_a_broken_camera_is_a_sentence_and_the_rest_goes_on(tmp_path):
    whole = rig.lively(1)

    def torn(index):
        raise ValueError("no keyframe")

    def takes():
        for take in whole.takes():
            times = take.readings["observation.images.left"].time_s
            yield Take({**take.readings, "observation.images.left": Readings(times, Lazy(len(times), torn))}, take.task)

    source = Source("torn", whole.sensors, takes)
    with asked(browse_of(tmp_path, source)) as client:
        answer = client.get(f"/reading/0/{LEFT}/3")
        assert answer.status_code == 422 and "no keyframe" in answer.text
        assert client.get(f"/reading/0/{FRONT}/3").status_code == 200
