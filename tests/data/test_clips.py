"""Clips come in an order that is a pure function of seed and epoch, whole, once each, and resume at any batch."""

from __future__ import annotations

import json
import tracemalloc

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from terrella.core.errors import DatasetError
from terrella.data import ClipCache, Dataset, Layout, Recorder
from terrella.data.channels import RGB
from terrella.data.source import Sensor
from terrella.data.training.cache import finish_cache, new_arrays
from terrella.data.training.clips import Clips, ClipsConfig
from terrella.data.training.order import shuffled_numbers

KINDS = {
    "rgb": (np.dtype(np.uint8), (2, 3, 3)),
    "action": (np.dtype(np.float32), (2,)),
    "done": (np.dtype(np.bool_), ()),
}


def cache_of(folder, lengths, kinds=KINDS) -> ClipCache:
    """A cache of episodes of these lengths; its values tell their row."""
    stops = np.cumsum(lengths)
    (folder / "staged").mkdir(parents=True)
    arrays = new_arrays(folder / "staged", kinds, int(stops[-1]))
    for array in arrays.values():
        rows = np.arange(len(array)).reshape(-1, *[1] * (array.ndim - 1))
        array[:] = rows % 251 if array.dtype == np.uint8 else rows
    finish_cache(folder / "staged", folder / "cache", arrays, np.stack([stops - lengths, stops], 1), 10)
    return ClipCache(folder / "cache")


@pytest.fixture(scope="module")
def small(tmp_path_factory) -> ClipCache:
    return cache_of(tmp_path_factory.mktemp("small"), np.array([7, 3, 0, 12, 5, 1]))


def same(a, b) -> bool:
    return a.keys() == b.keys() and all(np.array_equal(a[name], b[name]) for name in a)


def test_a_shuffle_is_a_permutation_of_any_count():
    for count in range(200):
        for seed in range(3):
            found = shuffled_numbers(np.arange(count), count, seed, 5)
            assert np.array_equal(np.sort(found), np.arange(count))
            assert np.array_equal(found[::-1], shuffled_numbers(np.arange(count)[::-1], count, seed, 5))
    assert not np.array_equal(shuffled_numbers(np.arange(50), 50, 0), shuffled_numbers(np.arange(50), 50, 1))


@given(
    st.integers(1, 1 << 60), st.lists(st.integers(0, 1 << 60), min_size=1, max_size=50, unique=True), st.integers(0, 9)
)
def test_a_shuffle_of_any_size_gives_each_place_its_own(count, places, seed):
    places = np.unique(np.array(places) % count)
    found = shuffled_numbers(places, count, seed)
    assert len(np.unique(found)) == len(places) and found.min() >= 0 and found.max() < count


@pytest.mark.parametrize("count", [2, 5, 16])
def test_every_number_comes_to_every_place_equally_often(count):
    trials = 3000
    seen = np.zeros((count, count))
    for key in range(trials):
        seen[np.arange(count), shuffled_numbers(np.arange(count), count, key)] += 1
    spread = np.sqrt(trials / count * (1 - 1 / count))
    assert np.abs(seen - trials / count).max() < 4.5 * spread


def test_a_shuffle_of_a_thousand_million_needs_no_memory():
    tracemalloc.start()
    shuffled_numbers(np.arange(64), 10**9, 1)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 50_000


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_each_start_comes_once_an_epoch_and_no_clip_leaves_its_episode(small, data):
    length, stride = data.draw(st.integers(1, 4)), data.draw(st.integers(1, 3))
    batch, seed = data.draw(st.integers(1, 7)), data.draw(st.integers(0, 100))
    picked = data.draw(st.sampled_from([None, [0, 3], [5, 3, 1]]))  # episode 3 is long enough for any of these
    options = {"seed": seed, "stride": stride, "episodes": picked, "drop_last": False, "shuffle": seed % 5 > 0}
    clips = Clips(small, ClipsConfig(length, ("rgb", "action", "row", "episode"), batch, **options))
    for epoch in range(2):
        found = list(clips)
        assert len(found) == -(-len(np.concatenate([b["row"] for b in found])) // batch) and clips.epoch == epoch + 1
        rows, episodes = (np.concatenate([b[name] for b in found]) for name in ("row", "episode"))
        span = (length - 1) * stride
        want = [
            (number, first)
            for number, (start, stop) in enumerate(small.episodes)
            if picked is None or number in picked
            for first in range(start, stop - span)
        ]
        assert sorted(zip(episodes[:, 0].tolist(), rows[:, 0].tolist())) == want
        assert (rows == rows[:, :1] + stride * np.arange(length)).all() and (episodes == episodes[:, :1]).all()
        for one in found:
            assert np.array_equal(one["action"], np.repeat(one["row"][..., None], 2, -1).astype(np.float32))
            assert np.array_equal(one["rgb"][..., 1, 2, 0], one["row"] % 251)


@pytest.mark.parametrize("workers", [0, 1, 3])
def test_it_goes_on_after_any_batch_with_any_number_of_workers(small, workers):
    def made(count):
        return Clips(small, ClipsConfig(3, ("rgb", "row"), 4, seed=7, workers=count))

    clips, states, seen = made(workers), [], []
    states.append(clips.state())
    for batch in clips.forever():
        seen.append(batch)
        states.append(json.loads(json.dumps(clips.state())))
        if len(seen) == 2 * len(clips) + 2:
            break
    assert not same(seen[0], seen[len(clips)])  # another epoch, another order
    for at, state in enumerate(states[:-1]):
        other = made((workers + at) % 4).resume(state)
        assert other.state() == state
        rest = other.forever()
        assert all(same(next(rest), batch) for batch in seen[at:])
        rest.close()
    by_epoch = made(workers).resume(states[1])
    assert all(same(a, b) for a, b in zip([*by_epoch, *by_epoch], seen[1:]))


def test_a_state_of_other_clips_is_refused(small, tmp_path):
    state = Clips(small, ClipsConfig(3, ("row",), 4)).state()
    for other, word in (
        (Clips(small, ClipsConfig(3, ("row",), 4, seed=1)), "seed=0"),
        (Clips(small, ClipsConfig(2, ("row",), 4)), "length=3"),
        (Clips(small, ClipsConfig(3, ("row",), 4, episodes=[0, 3])), "clips="),
        (Clips(cache_of(tmp_path, np.array([3, 7, 0, 12, 5, 1])), ClipsConfig(3, ("row",), 4)), "episodes="),
    ):
        with pytest.raises(DatasetError, match=word):
            other.resume(state)
    for wrong in (
        {},
        {"epoch": "x", "batch": 0, "of": {}},
        {**state, "batch": 99},
        {**state, "epoch": -1},
        {**state, "of": 3},
    ):
        with pytest.raises(DatasetError, match="state"):
            Clips(small, ClipsConfig(3, ("row",), 4)).resume(wrong)


@pytest.mark.parametrize(("world_size", "drop_last"), [(1, True), (2, False), (3, False), (3, True)])
def test_ranks_share_an_epoch_among_them(small, world_size, drop_last):
    options = {"seed": 3, "drop_last": drop_last, "world_size": world_size}
    ranks = [list(Clips(small, ClipsConfig(2, ("row",), 2, rank=rank, **options))) for rank in range(world_size)]
    rows = [row for batches in ranks for batch in batches for row in batch["row"][:, 0].tolist()]
    everything = [row for start, stop in small.episodes for row in range(start, stop - 1)]
    assert len(rows) == len(set(rows)) and set(rows) <= set(everything)
    if drop_last:
        assert len({len(batches) for batches in ranks}) == 1 and len(everything) - len(rows) < 2 * world_size
    else:
        assert sorted(rows) == everything


def test_a_batch_is_kept_for_as_long_as_anything_refers_to_it(small):
    clips = Clips(small, ClipsConfig(2, ("rgb", "row"), 2, workers=2))
    kept = [(batch["row"].copy(), batch["rgb"][1, 1:].reshape(-1)[::2]) for batch in clips]  # a view of a view
    for row, view in kept:
        want = np.repeat((row[1, 1:] % 251).astype(np.uint8), 18)[::2]
        assert np.array_equal(view, want)


def test_memory_is_used_again_when_nothing_refers_to_it(small):
    places = set()
    for count, batch in enumerate(Clips(small, ClipsConfig(2, ("rgb",), 2)).forever()):
        places.add(batch["rgb"].ctypes.data)
        del batch
        if count == 50:
            break
    assert len(places) <= 2


def test_torch_tensors_lie_over_the_same_memory(small):
    plain, tensors = (
        next(iter(Clips(small, ClipsConfig(2, ("rgb", "action", "done"), 4, torch=wrap)))) for wrap in (False, True)
    )
    assert all(
        isinstance(value, torch.Tensor) and np.array_equal(value, plain[name]) for name, value in tensors.items()
    )
    assert tensors["rgb"].dtype == torch.uint8 and tensors["rgb"].shape == (4, 2, 2, 3, 3)


def test_it_reads_a_recording_as_the_cache_shows_it(recording):
    clips = Clips(
        recording, ClipsConfig(5, ("rgb", "depth", "pose", "action", "action_valid", "row"), 8, (24, 32), workers=2)
    )
    cache = ClipCache.open(Dataset(recording), (24, 32))
    for batch in clips:
        for name in ("rgb", "depth", "pose", "action", "action_valid"):
            assert np.array_equal(batch[name], getattr(cache, name)[batch["row"]])
    assert len(clips) == (3 * 26 + 6) // 8


def test_further_cameras_and_sensors_are_channels_by_their_keys(tmp_path):
    left, state, far = "observation.images.left", "observation.joints", "observation.depth.far"
    sensors = {name: Sensor(name, "image", (16, 32, 3), "uint8") for name in (RGB, left)}
    sensors |= {state: Sensor(state, "vector", (3,), "float64"), far: Sensor(far, "depth", (4, 4))}
    sensors["action"] = Sensor("action", "vector", (1,))
    with Recorder(tmp_path, Layout(10, sensors)) as recorder:
        for i in range(12):
            grey = {RGB: np.full((16, 32, 3), 10 * i, np.uint8), left: np.full((16, 32, 3), 200 - 10 * i, np.uint8)}
            recorder.add_row({**grey, state: np.full(3, i), far: np.full((4, 4), i), "action": np.array([i])})
    assert left not in ClipCache.open(tmp_path, (8, 8)).arrays
    batch = next(iter(Clips(tmp_path, ClipsConfig(4, (RGB, "rgb", left, state, far, "row"), 3, (8, 8)))))
    rows = batch["row"]
    assert np.array_equal(batch["rgb"], batch[RGB]) and batch[left].shape == (3, 4, 8, 8, 3)
    assert np.abs(batch["rgb"].mean((2, 3, 4)) - 10 * rows).max() < 3
    assert np.abs(batch[left].mean((2, 3, 4)) - 200 + 10 * rows).max() < 3
    assert batch[state].dtype == np.float32 and np.array_equal(batch[state], np.repeat(rows[..., None], 3, -1))
    assert batch[far].dtype == np.float16 and np.array_equal(batch[far][..., 0, 0], rows)
    assert (tmp_path / ".cache" / "terrella").is_dir() and ClipCache.open(tmp_path, (8, 8)).arrays.keys() >= {
        state,
        far,
    }
    with pytest.raises(DatasetError, match="no camera 'back'"):
        ClipCache.open(tmp_path, (8, 8), cameras=["back"])


def test_what_cannot_be_is_said(small):
    for options, word in (
        ({"channels": ("rgb", "smell")}, "no 'smell'; it has action"),
        ({"channels": "rgb"}, "sequence"),
        ({"channels": ()}, "sequence"),
        ({"length": 0}, "length=0"),
        ({"stride": 0}, "stride=0"),
        ({"batch": -1}, "batch=-1"),
        ({"length": 13}, "no batch of 2"),
        ({"batch": 40}, "no batch of 40"),
        ({"episodes": [6]}, "no episode 6"),
        ({"episodes": [1, 1]}, "twice"),
        ({"episodes": [0.5]}, "whole numbers"),
        ({"episodes": []}, "no batch"),
        ({"rank": 2, "world_size": 2}, "rank=2"),
        ({"seed": -1}, "seed=-1"),
        ({"workers": -1}, "workers=-1"),
    ):
        with pytest.raises(DatasetError, match=word):
            Clips(small, ClipsConfig(**{"length": 2, "batch": 2, **options}))


def test_a_broken_cache_is_said(tmp_path):
    cache = cache_of(tmp_path, np.array([5, 5]))
    (cache.path / "action.npy").write_bytes((cache.path / "action.npy").read_bytes()[:150])
    with pytest.raises(DatasetError, match="damaged"):
        ClipCache(cache.path)


def test_opening_takes_no_more_memory_for_a_longer_recording(tmp_path):
    peaks = []
    for rows in (1_000, 1_000_000):
        cache = cache_of(tmp_path / str(rows), np.full(10, rows // 10), {"action": (np.dtype(np.float32), (1,))})
        tracemalloc.start()
        clips = Clips(ClipCache(cache.path), ClipsConfig(16, ("action",), 32))
        next(iter(clips))
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < peaks[0] + 20_000
