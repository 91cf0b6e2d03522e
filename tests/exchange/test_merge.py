"""Merging loses no named number, masks say exactly what is there, and the statistics are those of the valid rows."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from robots import arm, robot, rover

from terrella.core import files
from terrella.core.errors import DatasetError
from terrella.data import Dataset
from terrella.data.resample import resample
from terrella.data.source import Readings, Sensor, Source, Take
from terrella.exchange.merging.mapping import MergeRows, Number, Vector, affine
from terrella.exchange.merging.mapping_file import read_mapping, write_mapping
from terrella.exchange.merging.merge import letterbox, merge
from terrella.exchange.merging.propose import propose
from terrella.exchange.merging.report import MergeReport, Running
from terrella.exchange.merging.write import merge_into

VECTORS = {"action", "observation.state", "next.reward", "next.done"}


def stack(take: Take, name: str) -> np.ndarray:
    return np.stack([np.asarray(value) for value in take.readings[name].values])


def merged_takes(sources, mapping=None, report=None):
    mapping = mapping or propose(sources)
    source = merge(sources, mapping, report)
    takes = list(source.takes())
    for take in takes:  # whatever is merged has one form
        count = len(take.readings["embodiment"].time_s)
        assert list(take.readings) == list(source.sensors)
        for name, sensor in source.sensors.items():
            readings = take.readings[name]
            if sensor.kind == "points":
                assert all(scan.shape[1:] == sensor.shape[1:] for scan in readings.values)
                continue
            np.testing.assert_allclose(readings.time_s, np.arange(len(readings.time_s)) / mapping.rows.fps)
            assert len(readings.values) == len(readings.time_s) <= count
            assert len(readings.values) == count or name == "action" or name in ("next.reward", "next.done")
            for value in readings.values:
                assert value.dtype == sensor.dtype
                assert value.shape == sensor.shape
    return source, takes


@given(
    st.integers(0, 99),
    st.lists(st.integers(2, 12), min_size=1, max_size=3),
    st.booleans(),
    st.sampled_from([10, 24, 30, 29.97]),
)
@settings(max_examples=25)
def test_one_source_by_its_own_mapping_is_itself(seed, rows, terminal, fps):
    one = arm(fps=fps, rows=rows, seed=seed, terminal=terminal)
    source, takes = merged_takes({"A": one})
    assert source.fps == fps and source.robot == "arm" and source.facts["embodiments"] == [{"id": 0, "name": "arm"}]
    for name, sensor in one.sensors.items():
        new = source.sensors[name]
        assert (new.kind, new.shape, new.dtype) == (sensor.kind, sensor.shape, sensor.dtype)
        if name in ("action", "observation.state"):
            assert (new.names, dict(new.units), new.frame) == (sensor.names, dict(sensor.units), sensor.frame)
    assert len(takes) == len(rows)
    for take, old in zip(takes, one.takes()):
        assert (take.task, take.start_ns, take.facts["success"]) == (old.task, old.start_ns, True)
        for name in one.sensors:
            np.testing.assert_allclose(take.readings[name].time_s, old.readings[name].time_s, atol=1e-12)
            np.testing.assert_array_equal(stack(take, name), stack(old, name))
        count = len(old.readings["observation.state"].time_s)
        assert stack(take, "observation.state_mask").all() and stack(take, "observation.cameras_mask").all()
        acted = np.arange(count) < count - terminal
        for mask in ("action_mask", "next.reward_mask", "next.done_mask"):
            np.testing.assert_array_equal(stack(take, mask), np.repeat(acted[:, None], stack(take, mask).shape[1], 1))


@given(st.integers(0, 99), st.sampled_from(["rad", "deg"]), st.permutations(["A", "B", "C"]))
@settings(max_examples=15)
def test_every_named_number_is_kept_and_masks_are_the_presence(seed, unit, order):
    """At equal rates: unmapped through the mapping it is the original; what is masked is what is not there."""
    hand = Sensor("observation.state", "vector", (2,), "float64", ("elbow", "grip"), {"elbow": "turn"})
    t = np.arange(5) / 10
    grips = np.random.default_rng(seed).normal(size=(5, 2))
    all_ = {
        "A": arm(seed=seed, unit=unit, scale=30),
        "B": arm("other", seed=seed + 1, rows=(3,)),
        "C": robot("hand", [hand], [{"observation.state": (t, grips)}]),
    }
    sources = {path: all_[path] for path in order}
    mapping = propose(sources)
    source, takes = merged_takes(sources, mapping)
    old = [(it, number, take) for it in mapping.sources for number, take in enumerate(sources[it.path].takes())]
    assert len(takes) == len(old) == 4
    for take, (it, number, original) in zip(takes, old):
        assert (take.facts["source"], take.facts["take"], take.task) == (it.path, number, original.task)
        assert (stack(take, "embodiment") == mapping.embodiments.index(it.embodiment)).all()
        for name, dimensions in (("action", mapping.action), ("observation.state", mapping.state)):
            values, mask, places = (
                stack(take, name) if len(take.readings[name].values) else None,
                stack(take, f"{name}_mask"),
                list(dimensions),
            )
            expected = np.zeros(mask.shape, bool)
            for i, filled in enumerate(it.vectors[name].numbers if name in it.vectors else ()):
                truth, place = stack(original, name)[:, i], places.index(filled.to)
                scale, offset = affine(filled, dimensions[filled.to])
                np.testing.assert_allclose((values[: len(truth), place] - offset) / scale, truth, rtol=3e-7)
                expected[: len(truth), place] = True
            np.testing.assert_array_equal(mask, expected)
            assert values is None or not values[~mask[: len(values)]].any()
        cameras = list(mapping.cameras)
        seen = [camera in it.cameras.values() for camera in cameras]
        assert (stack(take, "observation.cameras_mask") == seen).all()
        for camera, there in zip(cameras, seen):
            assert stack(take, camera).any() == there
        assert stack(take, "next.reward_mask").any() == ("next.reward" in original.readings)


@given(st.integers(0, 99), st.permutations(["A", "B", "C"]))
@settings(max_examples=10)
def test_the_order_of_sources_only_permutes(seed, order):
    all_ = {"A": arm(seed=seed), "B": arm("other", seed=seed + 1, unit="deg"), "C": rover(seed=seed)}
    mapping = propose(all_)
    shuffled = replace(mapping, sources=tuple(next(s for s in mapping.sources if s.path == path) for path in order))
    one, other = MergeReport(), MergeReport()
    first = {(t.facts["source"], t.facts["take"]): t for t in merged_takes(all_, mapping, one)[1]}
    second = {(t.facts["source"], t.facts["take"]): t for t in merged_takes(all_, shuffled, other)[1]}
    assert first.keys() == second.keys() and [path for path, _ in second][::2] == list(order)
    for key, take in first.items():
        for name, readings in take.readings.items():
            if name != "embodiment":
                for a, b in zip(readings.values, second[key].readings[name].values, strict=True):
                    np.testing.assert_array_equal(a, b)
    by_name = [{it["name"]: {**it, "id": 0} for it in report.embodiments()} for report in (one, other)]
    assert by_name[0] == by_name[1]


@given(
    st.integers(0, 99), st.sampled_from([5, 7, 12.5, 20, 30, 60]), st.sampled_from(["previous", "nearest", "linear"])
)
@settings(max_examples=25)
def test_other_rates_keep_values_within_the_policy_and_returns_exactly(seed, fps, policy):
    one = arm(seed=seed, rows=(8, 15))
    mapping = propose({"A": one}, fps=fps)
    mapping = replace(mapping, rows=replace(mapping.rows, continuous=policy))
    source, takes = merged_takes({"A": one}, mapping)
    for take, old in zip(takes, one.takes()):
        rows = np.arange(len(take.readings["embodiment"].time_s)) / fps
        assert rows[-1] <= old.readings["action"].time_s[-1] + 0.1001 < rows[-1] + 1 / fps + 0.001
        truth, _ = resample(old.readings["observation.state"], one.sensors["observation.state"], rows, policy)
        np.testing.assert_array_equal(stack(take, "observation.state"), truth)
        acted = stack(take, "action_mask").all(1)
        np.testing.assert_array_equal(acted, rows < old.readings["action"].time_s[-1] + 0.1 - 1e-4)
        done = (10 * rows[acted] + 1e-3).astype(int)  # which action was being done
        np.testing.assert_array_equal(stack(take, "action"), stack(old, "action")[done])
        assert stack(take, "next.reward").sum() == stack(old, "next.reward").sum()
        assert stack(take, "next.done").sum() == 1 == stack(old, "next.done").sum()
        pictures, shown = stack(take, "observation.images.front"), stack(old, "observation.images.front")
        np.testing.assert_array_equal(pictures, shown[(10 * rows + 1e-3).astype(int)])


def test_clocks_of_their_own_become_rows():
    body = rover(seconds=2)
    mapping = propose({"A": body, "B": arm()}, fps=20)
    report = MergeReport()
    source, takes = merged_takes({"A": body, "B": arm()}, mapping, report)
    take, names = takes[0], list(mapping.state)
    rows = np.arange(41) / 20
    state = dict(zip(names, stack(take, "observation.state").T))
    np.testing.assert_allclose(state["x_m"], 2 * rows, atol=1e-6)
    np.testing.assert_allclose(state["qw"], np.cos(rows / 4), atol=1e-6)  # turned, not mixed
    np.testing.assert_allclose(state["qw"] ** 2 + state["qz"] ** 2, 1, atol=1e-6)
    np.testing.assert_allclose(state["imu.wz"], 90 * rows, atol=1e-3)
    assert mapping.state["imu.wz"].unit == "deg/s" and source.sensors["observation.state"].units["imu.ax"] == "g"
    scans, old = (
        take.readings["observation.points.rover.lidar"],
        next(iter(body.takes())).readings["observation.points.lidar"],
    )
    np.testing.assert_allclose(scans.time_s, old.time_s)  # scans keep their own clock
    for new, scan in zip(scans.values, old.values, strict=True):
        np.testing.assert_array_equal(new, scan)
    assert stack(take, "observation.points.rover.lidar_mask").all()
    assert len(takes[2].readings["observation.points.rover.lidar"].values) == 0
    assert not stack(takes[2], "observation.points.rover.lidar_mask").any()
    assert np.isinf(stack(takes[2], "observation.depth")).all() and np.isfinite(stack(take, "observation.depth")).all()
    counts = report.sources["A"].sensors
    assert (counts["observation.imu"].readings, counts["observation.imu"].rows) == (402, 82)
    assert counts["action"].rows_without == 2 and counts["observation.imu"].longest_gap_s == pytest.approx(0.01)


def test_late_sensors_and_silences():
    state = Sensor("observation.state", "vector", (1,), "float32", ("x",))
    camera = Sensor("observation.images.front", "image", (2, 2, 3), "uint8")
    t = np.r_[np.arange(10), np.arange(40, 50)] / 10  # three seconds of silence
    pictures = np.full((46, 2, 2, 3), 7, np.uint8)
    takes = [
        {"observation.state": (t, t[:, None]), "observation.images.front": (np.arange(4, 50) / 10, pictures)},
        {"observation.state": (t, t[:, None])},
        {},
        {"observation.state": (np.zeros(0), np.zeros((0, 1)))},
    ]
    report = MergeReport()
    source = {"A": robot("r", [state, camera], takes)}
    _, (take, blind) = merged_takes(source, report=report)
    rows = 0.4 + np.arange(46) / 10
    there = (rows < 0.901) | (rows > 3.999)
    np.testing.assert_array_equal(stack(take, "observation.state_mask")[:, 0], there)
    np.testing.assert_allclose(stack(take, "observation.state")[:, 0], np.where(there, rows, 0), atol=1e-6)
    assert take.start_ns == 400_000_000 and "action" not in take.readings
    assert not stack(blind, "observation.cameras_mask").any() and not stack(blind, "observation.images.front").any()
    count = report.sources["A"]
    assert count.late_s == pytest.approx(0.4) and count.takes == 2 and count.rows == 46 + 50
    assert (
        count.sensors["observation.state"].rows_without == 60
        and count.sensors["observation.images.front"].rows_without == 50
    )
    assert count.sensors["observation.state"].longest_gap_s == pytest.approx(3.1)
    assert len(count.skipped) == 2 and "take 2" in report.text()


def test_what_is_not_a_number_is_masked_and_counted():
    sensor = Sensor("observation.state", "vector", (2,), "float64", ("x", "y"))
    reward = Sensor("next.reward", "vector", (1,), "float32")
    values = np.array([[1, np.nan], [np.inf, 2], [1e300, 3], [4, 4]])
    t, report = np.arange(4) / 10, MergeReport()
    readings = {"observation.state": (t, values), "next.reward": (t, np.array([[1], [np.nan], [2], [3]], np.float32))}
    _, (take,) = merged_takes({"A": robot("r", [sensor, reward], [readings])}, report=report)
    assert stack(take, "observation.state").tolist() == [[1, 0], [0, 2], [0, 3], [4, 4]]
    assert stack(take, "observation.state_mask").tolist() == [[True, False], [False, True], [False, True], [True, True]]
    assert report.sources["A"].sensors["observation.state"].not_finite == 3
    assert stack(take, "next.reward")[:, 0].tolist() == [1, 0, 2, 3]
    assert stack(take, "next.reward_mask")[:, 0].tolist() == [True, False, True, True]
    json.dumps(report.to_json(), allow_nan=False)


def test_statistics_are_those_of_the_valid_rows():
    sources = {
        "A": arm(rows=(20, 30)),
        "B": arm(rows=(7,), seed=5),
        "C": arm("other", rows=(40,), unit="deg", scale=90),
    }
    sources["B"] = replace(sources["B"], name="again")
    report = MergeReport()
    _, takes = merged_takes(sources, report=report)
    assert report.complete
    first, second = report.embodiments()
    assert (first["name"], first["sources"], first["takes"], first["rows"]) == ("arm", ["A", "B"], 3, 57)
    assert (second["name"], second["id"], second["rows"]) == ("other", 1, 40)
    for facts, chosen in ((first, takes[:3]), (second, takes[3:])):
        for key in ("action", "observation.state"):
            values = np.concatenate([stack(take, key) for take in chosen])
            mask = np.concatenate([stack(take, f"{key}_mask")[: len(take.readings[key].values)] for take in chosen])
            assert mask.all()
            for place, number in enumerate(("shoulder", "elbow", "gripper")):
                column, found = values[:, place].astype(np.float64), facts["stats"][key][number]
                assert found["count"] == len(column) and (found["min"], found["max"]) == (column.min(), column.max())
                assert found["mean"] == pytest.approx(column.mean()) and found["std"] == pytest.approx(column.std())
                assert [found["q01"], found["q99"]] == pytest.approx(np.quantile(column, [0.01, 0.99]).tolist())
    view = first["cameras"]["observation.images.front"]
    assert view["calibration"] == {"K": [1, 2, 3]} and view["placed"] == {"height": 8, "width": 12, "top": 0, "left": 0}


@given(st.lists(st.integers(0, 30), min_size=1, max_size=8), st.integers(0, 1000))
def test_running_statistics_need_not_see_all_at_once(sizes, seed):
    rng = np.random.default_rng(seed)
    parts = [(rng.normal(size=(n, 3)) * 10 + 1e4, rng.random((n, 3)) < 0.6) for n in sizes]
    running = Running(["a", "b", "c"])
    for values, mask in parts:
        running.add(values.astype(np.float32), mask)
    values = np.concatenate([values for values, _ in parts]).astype(np.float32).astype(np.float64)
    mask = np.concatenate([mask for _, mask in parts])
    every = running.to_json()
    for place, name in enumerate("abc"):
        column = values[mask[:, place], place]
        assert (name in every) == bool(len(column))
        if found := every.get(name):
            assert found["count"] == len(column)
            truth = [column.min(), column.max(), column.mean(), column.std(), *np.quantile(column, [0.01, 0.99])]
            assert [found[key] for key in ("min", "max", "mean", "std", "q01", "q99")] == pytest.approx(truth, abs=1e-6)


@given(st.lists(st.integers(1, 40), min_size=1, max_size=20))
def test_quantiles_of_much_come_from_every_nth_value(sizes):
    import terrella.exchange.merging.report as module

    running, at, before = Running(["a"]), 0, module._SAMPLE
    module._SAMPLE = 16
    try:
        for size in sizes:
            running.add(np.arange(at, at + size, dtype=np.float32)[:, None], np.ones((size, 1), bool))
            at += size
    finally:
        module._SAMPLE = before
    kept, stride = running._samples["a"], running._strides["a"]
    assert kept.tolist() == list(range(0, at, stride)) and len(kept) <= 16 and (stride == 1 or len(kept) > 7)


def test_a_person_can_edit_the_mapping(tmp_path):
    sources = {"A": arm(), "B": arm("other", seed=3)}
    mapping = propose(sources)
    first = mapping.sources[0]
    numbers = list(first.vectors["observation.state"].numbers)
    numbers[0] = Number("shoulder", out="it is broken")
    numbers[2] = Number("gripper", "gripper", "0..1", scale=-1, offset=1)  # this one opens the other way
    first = replace(first, vectors={**first.vectors, "observation.state": Vector(tuple(numbers), "base")})
    first = replace(first, cameras={}, out={"observation.images.front": "it is dark"})
    write_mapping(replace(mapping, sources=(first, mapping.sources[1])), tmp_path / "m.toml")
    report = MergeReport()
    source, takes = merged_takes(sources, read_mapping(tmp_path / "m.toml"), report)
    old = stack(next(iter(sources["A"].takes())), "observation.state")
    assert stack(takes[0], "observation.state_mask").tolist() == [[False, True, True]] * 6
    np.testing.assert_array_equal(stack(takes[0], "observation.state")[:, 2], 1 - old[:, 2])
    assert not stack(takes[0], "observation.cameras_mask").any() and stack(takes[2], "observation.cameras_mask").all()
    text = report.text()
    assert "left out observation.state[0] shoulder: it is broken" in text and "it is dark" in text
    assert "shoulder" not in report.embodiments()[0]["stats"]["observation.state"]
    assert any("it is broken" in note for note in source.notes)


def test_deltas_are_pointed_out():
    report = MergeReport()
    sources = {"A": arm(fps=30), "B": arm("other", fps=10)}
    merged_takes(sources, report=report)
    assert "multiplied by 3" in report.text() and report.text().count("multiplied") == 1


def test_reading_anew_counts_anew_and_stopping_is_seen():
    report = MergeReport()
    source = merge({"A": arm()}, propose({"A": arm()}), report)
    next(iter(source.takes()))
    assert not report.complete and "incomplete" in report.text() and report.embodiments()[0]["rows"] == 6
    for _ in range(2):
        list(source.takes())
        assert report.complete and report.embodiments()[0]["rows"] == 15
        assert report.embodiments()[0]["stats"]["action"]["elbow"]["count"] == 13


@given(st.integers(1, 40), st.integers(1, 40), st.integers(1, 40), st.integers(1, 40), st.integers(0, 255))
def test_letterboxes_keep_aspect_and_brightness(height, width, to_height, to_width, grey):
    found = letterbox(np.full((height, width, 3), grey, np.uint8), to_height, to_width)
    assert found.shape == (to_height, to_width, 3) and set(np.unique(found)) <= {0, grey}
    depth = letterbox(np.full((height, width), 2.5, np.float32), to_height, to_width)
    inside = np.isfinite(depth)
    assert depth.dtype == np.float32 and (depth[inside] == 2.5).all() and inside.any()
    rows, columns = inside.any(1).sum(), inside.any(0).sum()
    assert rows == to_height or columns == to_width
    scale = min(to_height / height, to_width / width)
    assert abs(rows - max(1, height * scale)) <= 0.5 and abs(columns - max(1, width * scale)) <= 0.5
    assert inside.sum() == rows * columns
    if grey:
        np.testing.assert_array_equal(found[..., 0] == grey, inside)


def test_letterboxing_takes_the_mean_of_the_area():
    picture = np.random.default_rng(0).integers(0, 256, (8, 16, 3), dtype=np.uint8)
    found = letterbox(picture, 4, 4)
    mean = picture.reshape(2, 4, 4, 4, 3).mean((1, 3))
    np.testing.assert_allclose(found[1:3], mean, atol=1)  # Pillow rounds twice
    assert not found[[0, 3]].any()
    assert letterbox(picture, 8, 16) is picture
    np.testing.assert_array_equal(letterbox(picture, 16, 32), np.asarray(Image.fromarray(picture).resize((32, 16), 2)))


def test_broken_recordings_are_named_by_source_and_take():
    sources = {"A": arm()}
    mapping = propose(sources)

    def broken(name, time_s, values):
        def takes():
            first, second = arm().takes()
            yield first
            yield replace(second, readings={**second.readings, name: Readings(np.array(time_s, np.float64), values)})

        return {"A": replace(sources["A"], takes=takes)}

    for name, time_s, values, said in [
        ("action", [0.2, 0.1], np.zeros((2, 3)), "ascending"),
        ("observation.state", [0, 0.1], np.zeros((3, 3)), "3 readings at 2 times"),
        ("observation.state", [0, 0.1], np.zeros((2, 4)), "shape"),
        ("next.reward", [0], [["much"]], "shape"),
        ("next.done", [np.nan], [[True]], "finite"),
        ("observation.state", [1e18, 2e18], np.zeros((2, 3)), "mend its times"),
    ]:
        with pytest.raises(DatasetError, match=f"take 1 of A: .*{said}"):
            list(merge(broken(name, time_s, values), mapping).takes())
    pictures = merge(broken("observation.images.front", [0], [np.zeros((4, 4), np.uint8)]), mapping)
    with pytest.raises(DatasetError, match="not image"):
        stack(list(pictures.takes())[1], "observation.images.front")
    with pytest.raises(DatasetError, match="has the path 'A'"):
        merge({"B": arm()}, mapping)


def test_a_source_without_takes_and_robots_without_anything_in_common():
    plain = Sensor("observation.images.video", "image", (4, 4, 3), "uint8")
    video = robot(
        "video", [plain], [{"observation.images.video": (np.arange(3) / 10, np.ones((3, 4, 4, 3), np.uint8))}]
    )
    empty = Source("empty", arm().sensors, lambda: iter(()), fps=10, robot="empty")
    report = MergeReport()
    source, takes = merged_takes({"V": video, "E": empty}, report=report)
    (take,) = takes
    assert len(take.readings["action"].values) == 0 and not stack(take, "action_mask").any()
    assert not stack(take, "observation.state_mask").any() and source.robot == "several"
    assert [it["takes"] for it in report.embodiments()] == [1, 0] and report.embodiments()[0]["stats"]["action"] == {}


def test_rows_may_have_no_limit_to_a_gap():
    state = Sensor("observation.state", "vector", (1,), "float32", ("x",))
    source = {"A": robot("r", [state], [{"observation.state": (np.array([0, 9.0]), np.array([[0], [9]], np.float32))}])}
    mapping = replace(propose(source), rows=MergeRows(1.0, max_gap_s=None))
    _, (take,) = merged_takes(source, mapping)
    assert stack(take, "observation.state")[:, 0].tolist() == list(range(10))


def test_the_mapping_says_what_the_numbers_are():
    """A unit in a name, and names that a person gave: angles that wrap and quaternions are not mixed as lines."""
    state = Sensor("observation.state", "vector", (1,), "float32", ("yaw_deg",))
    turn = Sensor("observation.turn", "vector", (4,), "float32")
    t = np.array([0, 0.1])
    half = np.sqrt(0.5)
    readings = {
        "observation.state": (t, np.array([[179], [-179]])),
        "observation.turn": (t, np.array([[1, 0, 0, 0], [half, half, 0, 0]])),
    }
    source = {"A": robot("r", [state, turn], [readings])}
    mapping = propose(source, fps=20)
    named = tuple(
        replace(n, name=name)
        for n, name in zip(mapping.sources[0].vectors["observation.turn"].numbers, ("qw", "qx", "qy", "qz"))
    )
    vectors = {**mapping.sources[0].vectors, "observation.turn": Vector(named)}
    _, (take,) = merged_takes(source, replace(mapping, sources=(replace(mapping.sources[0], vectors=vectors),)))
    yaw, *rotation = stack(take, "observation.state")[1]
    assert yaw in (179, -179)
    np.testing.assert_allclose(rotation, [np.cos(np.pi / 8), np.sin(np.pi / 8), 0, 0], atol=1e-6)


def test_points_begin_with_the_newest_at_the_first_row():
    lidar = Sensor("observation.points", "points", (0, 3), rate_hz=4)
    state = Sensor("observation.state", "vector", (1,), "float32", ("x",))
    scans = [np.full((i, 3), i, np.float32) for i in range(6)]
    readings = {
        "observation.points": (np.arange(6) / 4, scans),
        "observation.state": (0.6 + np.arange(5) / 10, np.zeros((5, 1))),
    }
    _, (take,) = merged_takes({"A": robot("r", [lidar, state], [readings])})
    found = take.readings["observation.points"]
    np.testing.assert_allclose(found.time_s, [0, 0.15, 0.4, 0.65])  # 0.5 s is before the first row, at 0.6 s
    assert [len(scan) for scan in found.values] == [2, 3, 4, 5]


def test_wide_vectors_are_kept_whole():
    skin = Sensor("observation.skin", "vector", (100,), "float32")
    grid = Sensor("observation.grid", "vector", (2, 3), "float32")
    label = Sensor("observation.label", "vector", (1,), "string")
    t, rng = np.arange(4) / 10, np.random.default_rng(0)
    felt, seen = rng.normal(size=(4, 100)).astype(np.float32), rng.normal(size=(4, 2, 3)).astype(np.float32)
    felt[2, 7] = np.nan
    readings = {"observation.skin": (t, felt), "observation.grid": (t, seen), "observation.label": (t, [["a"]] * 4)}
    report = MergeReport()
    sources = {"A": robot("soft hand", [skin, grid, label], [readings]), "B": arm()}
    _, takes = merged_takes(sources, report=report)
    kept = stack(takes[0], "observation.soft_hand.skin")
    np.testing.assert_array_equal(kept[[0, 1, 3]], felt[[0, 1, 3]])
    assert not kept[2].any() and stack(takes[0], "observation.soft_hand.skin_mask")[:, 0].tolist() == [
        True,
        True,
        False,
        True,
    ]
    np.testing.assert_array_equal(stack(takes[0], "observation.soft_hand.grid"), seen)
    assert not stack(takes[1], "observation.soft_hand.grid").any() and "text is not merged" in report.text()


def test_it_becomes_a_recording(tmp_path):
    from terrella.data import Dataset

    sources = {"A": arm(unit="deg", size=(16, 16)), "B": rover(), "C": arm("other", terminal=False, seed=4)}
    seen = []
    facts, text = merge_into(sources, tmp_path / "all", fps=10, progress=lambda done, of: seen.append(done))
    assert seen == [1, 2, 3, 4, 5, 6] and "rover: 2 takes" in text and facts["complete"]
    dataset = Dataset(tmp_path / "all")
    about = json.loads((tmp_path / "all" / "meta" / "terrella.json").read_text())
    report = json.loads((tmp_path / "all" / "meta" / "merge.json").read_text())
    assert (
        about["embodiments"] == report["embodiments"]
        and about["embodiments"][2]["stats"]["action"]["elbow"]["count"] == 15
    )
    mapping = read_mapping(tmp_path / "all.toml")
    assert read_mapping(tmp_path / "all" / "meta" / "merge.toml") == mapping
    source = merge(sources, mapping)
    for old, new in zip(source.takes(), dataset.source().takes(), strict=True):
        assert new.task == old.task
        for name, sensor in source.sensors.items():
            if sensor.kind == "vector" and not name.startswith("next."):
                truth = stack(old, name) if len(old.readings[name].values) else np.zeros((0, *sensor.shape))
                found = np.asarray(new.readings[name].values)
                np.testing.assert_array_equal(found[: len(truth)], truth)
                assert not found[len(truth) :].any()
    with pytest.raises(DatasetError, match="all.toml exists already"):
        merge_into(sources, tmp_path / "all")
    with pytest.raises(DatasetError, match="not empty"):
        merge_into(sources, tmp_path / "all", tmp_path / "all.toml")
    facts, text = merge_into(sources, tmp_path / "later", dry=True)
    assert (tmp_path / "later.toml").exists() and not (tmp_path / "later").exists() and "edit it" in text
    merge_into(sources, tmp_path / "fast", tmp_path / "all.toml", fps=20)
    assert Dataset(tmp_path / "fast").fps == 20
    with pytest.raises(DatasetError, match=r"no \[\[source\]\] with the path 'D'"):
        merge_into({**sources, "D": arm()}, tmp_path / "none", tmp_path / "all.toml")


def test_rewards_between_rows_and_takes_of_one_row():
    state = Sensor("observation.state", "vector", (1,), "float32", ("x",))
    reward = Sensor("next.reward", "vector", (1,), "float32")
    late = {
        "observation.state": (np.arange(4) / 10, np.zeros((4, 1))),
        "next.reward": ([0.05, 0.06], np.array([[2], [3]])),
    }
    single = {"observation.state": ([0.0], np.zeros((1, 1)))}
    report = MergeReport()
    _, (take,) = merged_takes({"A": robot("r", [state, reward], [single, late])}, report=report)
    assert stack(take, "next.reward")[:, 0].tolist() == [5]
    assert stack(take, "next.reward_mask")[:, 0].tolist() == [True, False, False, False]
    assert report.sources["A"].skipped == ["take 0: its mapped sensors give fewer than two rows"]


def test_text_cannot_be_kept():
    label = Sensor("observation.label", "vector", (1,), "string")
    source = {"A": robot("r", [label], [])}
    mapping = propose(source)
    kept = replace(mapping.sources[0], out={}, keep={"observation.label": "observation.label"})
    with pytest.raises(DatasetError, match="text cannot be kept"):
        merge(source, replace(mapping, sources=(kept,)))


def test_instructions_keep_their_rows_when_a_merge_begins_later(tmp_path):
    """The rows begin where all sensors have begun: what was said then moves with them."""
    a, b = Sensor("observation.a", "vector", (1,), names=("a",)), Sensor("observation.b", "vector", (1,), names=("b",))
    early, late = np.arange(21) / 10, np.arange(10, 21) / 10
    take = Take(
        {a.name: Readings(early, np.zeros((21, 1))), b.name: Readings(late, np.zeros((11, 1)))},
        "one",
        facts={"language": [[0.0, "one"], [1.5, "two"]], "weather": "rain"},
    )
    source = Source("r", {a.name: a, b.name: b}, lambda: [take], 10.0, robot="r")
    _, (merged,) = merged_takes({"A": source})
    shift = 21 - len(merged.readings["embodiment"].time_s)
    expected = [[0.0 - shift / 10, "one"], [1.5 - shift / 10, "two"]]
    assert shift == 10 and merged.facts["weather"] == "rain"
    for (when, words), (at, text) in zip(merged.facts["language"], expected, strict=True):
        assert words == text and when == pytest.approx(at)
    merge_into({"A": source}, tmp_path / "set")
    dataset = Dataset(tmp_path / "set")
    assert [dataset.tasks[number] for number in dataset.episode(0, ["task_index"])["task_index"].ravel()] == (
        ["one"] * 5 + ["two"] * 6
    )


@pytest.mark.parametrize("stage", ["write_json", "takes"])
@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(28, "No space left on device")])
def test_a_merge_that_is_stopped_leaves_nothing(tmp_path, monkeypatch, stage, error):
    """Also after the last row, while the report and the statistics of robots are written."""

    def stop(target, value, **named):
        if stage == "takes" or "merge.json" in str(target):
            raise error
        real(target, value, **named)

    real = files.write_json
    monkeypatch.setattr(files, "write_json", stop)
    with pytest.raises((KeyboardInterrupt, DatasetError)):
        merge_into({"A": arm()}, tmp_path / "all")
    assert list(tmp_path.iterdir()) == []
