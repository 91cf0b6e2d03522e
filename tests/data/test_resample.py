"""Resampling equals a plain slow twin, never invents a reading, and rows are where they are said to be."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from terrella.core.errors import DatasetError
from terrella.data.resample import SAME_TIME_S, resample, row_times, slerp
from terrella.data.source import Lazy, Readings, Sensor, Take

NAMES = ("x", "yaw", "hand.qw", "hand.qx", "hand.qy", "hand.qz")
POSE = Sensor("observation.state", "vector", (6,), "float64", NAMES, units={"yaw": "rad"})


def twin(time_s, values, at, policy, gap):
    """One row by plain loops: its value, or None."""
    gap = math.inf if gap is None else gap + SAME_TIME_S
    before = [i for i, t in enumerate(time_s) if t <= at]
    if policy == "previous":
        late = [i for i, t in enumerate(time_s) if t <= at + SAME_TIME_S]
        return values[late[-1]] if late and abs(at - time_s[late[-1]]) <= gap else None
    nearest = None
    for i, t in enumerate(time_s):
        if nearest is None or abs(t - at) < abs(time_s[nearest] - at) or t == time_s[nearest]:
            nearest = i
    if policy == "nearest" or nearest is None:
        return values[nearest] if nearest is not None and abs(time_s[nearest] - at) <= gap else None
    if abs(time_s[nearest] - at) <= SAME_TIME_S:
        return values[nearest]
    if not before:
        return None
    a = before[-1]
    if a == len(time_s) - 1:
        return values[a] if at - time_s[a] <= gap else None
    if time_s[a + 1] - time_s[a] > gap:
        return None
    share = (at - time_s[a]) / (time_s[a + 1] - time_s[a])
    one, two = values[a], values[a + 1]
    mixed = [one[i] + share * (two[i] - one[i]) for i in range(6)]
    if abs(two[1] - one[1]) > math.pi:
        mixed[1] = two[1] if share > 0.5 else one[1]
    mixed[2:] = slow_slerp(one[2:], two[2:], share)
    return np.array(mixed)


def slow_slerp(a, b, share):
    """By the power of the rotation from a to b: a (a^-1 b)^share, with unit quaternions w, x, y, z."""
    if sum(p * q for p, q in zip(a, b)) < 0:
        b = [-q for q in b]
    w, x, y, z = a[0], -a[1], -a[2], -a[3]
    turn = times((w, x, y, z), b)
    axis = math.sqrt(sum(q * q for q in turn[1:]))
    angle = math.atan2(axis, turn[0]) * share
    unit = [q / axis for q in turn[1:]] if axis > 1e-12 else [0, 0, 0]
    return times(a, (math.cos(angle), *(math.sin(angle) * q for q in unit)))


def times(a, b):
    w, x, y, z = a
    W, X, Y, Z = b
    return (
        w * W - x * X - y * Y - z * Z,
        w * X + x * W + y * Z - z * Y,
        w * Y - x * Z + y * W + z * X,
        w * Z + x * Y - y * X + z * W,
    )


clocks = st.lists(st.integers(0, 400), max_size=12).map(lambda ticks: np.sort(np.array(ticks, np.float64)) / 100)
moments = st.lists(st.integers(-100, 500), min_size=1, max_size=20).map(lambda ticks: np.array(ticks) / 100 + 0.0007)
gaps = st.sampled_from([None, 0.05, 0.3, 1.0])


@given(clocks, moments, gaps, st.sampled_from(["previous", "nearest", "linear"]), st.integers(0, 1000), st.booleans())
def test_it_equals_its_slow_twin(time_s, at_s, gap, policy, seed, on_time):
    at_s = at_s - 0.0007 * on_time  # on the hundredths, where ties and equal times are, or off them
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(len(time_s), 6)) * [1, 3, 1, 1, 1, 1]
    values[:, 2:] /= np.linalg.norm(values[:, 2:], axis=1, keepdims=True)
    found, valid = resample(Readings(time_s, values), POSE, at_s, policy, gap)
    assert found.shape == (len(at_s), 6) and valid.dtype == bool
    for row, at in enumerate(at_s):
        truth = twin(list(time_s), values, at, policy, gap)
        assert valid[row] == (truth is not None)
        np.testing.assert_allclose(found[row], 0 if truth is None else truth, atol=1e-9)


@given(clocks.filter(len), gaps, st.sampled_from(["previous", "nearest", "linear"]))
def test_at_its_own_times_it_is_the_identity(time_s, gap, policy):
    time_s = np.unique(time_s)
    values = np.random.default_rng(len(time_s)).normal(size=(len(time_s), 6)).astype(np.float32)
    sensor = Sensor("observation.state", "vector", (6,), "float32", NAMES)
    jitter = np.linspace(-0.9, 0.9, len(time_s)) * SAME_TIME_S  # what float32 times come to
    found, valid = resample(Readings(time_s, values), sensor, time_s + jitter, policy, gap)
    assert valid.all() and found.dtype == np.float32
    np.testing.assert_array_equal(found, values)


@given(st.integers(0, 10_000), st.integers(1, 200))
def test_lines_and_turns_are_exact(seed, rate):
    """A point that moves steadily and a body that turns steadily are met exactly between any two readings."""
    rng = np.random.default_rng(seed)
    time_s = np.sort(rng.uniform(0, 2, 20))
    at_s = np.arange(time_s[0], time_s[-1], 1 / rate)
    steady = lambda t: np.stack([3 * t - 1, 0.1 * t, np.cos(t), np.sin(t), 0 * t, 0 * t], 1)  # noqa: E731
    found, valid = resample(Readings(time_s, steady(time_s)), POSE, at_s, "linear")
    assert valid.all()
    np.testing.assert_allclose(found, steady(at_s), atol=4 * SAME_TIME_S)
    off = np.abs(at_s[:, None] - time_s).min(1) > SAME_TIME_S
    np.testing.assert_allclose(found[off], steady(at_s)[off], atol=1e-9)


def test_slerp_stays_on_the_sphere_and_takes_the_shorter_way():
    a, b = (
        np.array([[1.0, 0, 0, 0]]),
        np.array([[-np.cos(0.3), 0, 0, -np.sin(0.3)]]),
    )  # b: 0.6 rad about z, written as -q
    np.testing.assert_allclose(slerp(a, b, np.array([[0.5]])), [[np.cos(0.15), 0, 0, np.sin(0.15)]], atol=1e-12)
    nothing = np.zeros((1, 4))
    np.testing.assert_array_equal(slerp(a, nothing, np.array([[0.4]])), a)
    np.testing.assert_array_equal(slerp(a, nothing, np.array([[0.6]])), nothing)


def test_whole_numbers_and_truths_are_never_mixed():
    time_s = np.array([0.0, 1.0])
    for dtype, values in (("int64", [[2], [9]]), ("bool", [[False], [True]])):
        sensor = Sensor("observation.gear", "vector", (1,), dtype, ("gear",))
        found, valid = resample(Readings(time_s, np.array(values)), sensor, np.array([-0.5, 0.4, 1.2]), "linear")
        assert found.dtype == dtype and found[:, 0].tolist() == [0, values[0][0], values[1][0]]
        assert valid.tolist() == [False, True, True]


def test_pictures_are_fetched_when_they_are_looked_at_and_once():
    fetched = []

    def make(i):
        fetched.append(i)
        return np.full((2, 2, 3), i, np.uint8)

    camera = Sensor("observation.images.front", "image", (2, 2, 3), "uint8")
    readings = Readings(np.arange(5) / 10, Lazy(5, make))
    rows, valid = resample(readings, camera, np.arange(-1, 12) / 30, "previous")
    assert not fetched and len(rows) == 13 and valid.tolist() == [False] + [True] * 12
    assert [int(picture[0, 0, 0]) for picture in rows] == [0, 0, 0, 0, 1, 1, 1, 2, 2, 2, 3, 3, 3]
    assert fetched == [0, 1, 2, 3] and rows[0].shape == (2, 2, 3)


def test_vectors_of_any_shape_and_text():
    time_s, at_s = np.array([0.0, 1.0]), np.array([-1, 0.25])
    grid = Sensor("observation.grid", "vector", (2, 2), "float32", ("height", "width"))
    found, valid = resample(Readings(time_s, np.stack([np.zeros((2, 2)), np.ones((2, 2))])), grid, at_s, "linear")
    assert found.tolist() == [[[0, 0], [0, 0]], [[0.25, 0.25], [0.25, 0.25]]] and valid.tolist() == [False, True]
    text = Sensor("observation.label", "vector", (1,), "string")
    found, valid = resample(Readings(time_s, [np.array(["a"], object), np.array(["b"], object)]), text, at_s, "linear")
    assert found.tolist() == [[""], ["a"]] and valid.tolist() == [False, True]


def test_what_is_not_there_is_blank():
    depth = Sensor("observation.depth", "depth", (2, 3))
    rows, valid = resample(Readings(np.zeros(0), np.zeros((0, 2, 3))), depth, np.zeros(2), "nearest")
    assert np.isinf(rows[1]).all() and rows[1].shape == (2, 3) and not valid.any()
    points = Sensor("observation.points.lidar", "points", (0, 4))
    rows, _ = resample(Readings(np.zeros(0), []), points, np.zeros(1), "previous")
    assert rows[0].shape == (0, 4)


def test_what_is_not_a_number_stays_so_and_warns_nobody():
    values = np.array([[np.nan] * 6, [np.inf] * 6, [-np.inf] * 6, [1e308] * 6])
    found, valid = resample(Readings(np.arange(4.0), values), POSE, np.array([0.5, 1.5, 2.5, 3]), "linear")
    assert valid.all() and not np.isfinite(found[:3, 0]).any() and (found[3] == 1e308).all()


def take(**clocks_s):
    return Take({name.replace("__", "."): Readings(np.array(t), np.zeros((len(t), 1))) for name, t in clocks_s.items()})


def test_rows_begin_when_all_have_begun_and_end_when_all_have_ended():
    one = take(observation__a=[0.2, 0.3, 0.4], observation__b=[0.0, 0.9], action=[0.0, 5.0])
    np.testing.assert_allclose(row_times(one, one.readings, 10), 0.2 + np.arange(8) / 10)
    np.testing.assert_allclose(row_times(one, ["action"], 1), np.arange(6))
    np.testing.assert_allclose(row_times(one, ["observation.a", "action"], 10), [0.2, 0.3, 0.4])
    assert row_times(one, ["observation.c"], 10).shape == (0,)
    assert row_times(take(observation__a=[]), ["observation.a"], 10).shape == (0,)


@given(st.integers(1, 5000), st.sampled_from([7.5, 10, 24, 29.97, 30, 50, 60]), st.booleans())
@settings(max_examples=40)
def test_rows_at_a_recordings_own_rate_are_its_rows(count, fps, in_float32):
    time_s = np.arange(count) / fps
    time_s = time_s.astype(np.float32).astype(np.float64) if in_float32 else time_s
    one = Take({"observation.state": Readings(time_s, np.zeros((count, 1)))})
    np.testing.assert_allclose(row_times(one, ["observation.state"], fps), time_s, atol=SAME_TIME_S)


@pytest.mark.parametrize(
    ("time_s", "values", "said"),
    [
        ([0, 2, 1], np.zeros((3, 6)), "ascending"),
        ([0, np.nan], np.zeros((2, 6)), "finite"),
        ([0, 1], np.zeros((3, 6)), "3 readings at 2 times"),
        ([0, 1], np.zeros((2, 5)), "shape"),
        ([0, 1], [np.zeros(6), np.zeros(5)], "shape"),
        ([0], [["a"] * 6], "shape"),
    ],
)
def test_broken_readings_are_named(time_s, values, said):
    with pytest.raises(DatasetError, match=f"observation.state.*{said}|{said}.*observation.state"):
        resample(Readings(np.array(time_s, np.float64), values), POSE, np.zeros(1), "linear")


def test_what_cannot_be_done_is_refused():
    good = Readings(np.zeros(1), np.zeros((1, 6)))
    with pytest.raises(DatasetError, match="no resampling policy 'cubic'"):
        resample(good, POSE, np.zeros(1), "cubic")
    with pytest.raises(DatasetError, match="finite times"):
        resample(good, POSE, np.array([np.nan]))
    with pytest.raises(DatasetError, match="'linear'"):
        resample(Readings(np.zeros(1), [np.zeros((2, 2))]), Sensor("d", "depth", (2, 2)), np.zeros(1), "linear")
    with pytest.raises(DatasetError, match="positive"):
        row_times(take(observation__a=[0]), ["observation.a"], 0)
    with pytest.raises(DatasetError, match="mend its times"):
        row_times(take(observation__a=[0, 1.7e18]), ["observation.a"], 30)
