"""Clips do not overlap, never cross an end or a lost action, and lie where they were asked to."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from gymnasium import spaces
from panorama import Panorama, recording, some_clips

from terrella.core import make_rng
from terrella.core.errors import DatasetError, ObservationError
from terrella.measure import clips_from_cache, in_box, out_of_sight
from terrella.measure.clips import evidence
from terrella.space.camera import yaw


def rows(clip) -> range:
    return range(clip.start, clip.start + len(clip.action))


@pytest.mark.parametrize("seed", range(5))
def test_windows_lie_in_their_episodes_and_do_not_overlap(seed):
    cache = recording(seed=seed)
    clips = clips_from_cache(cache, [0, 2, 3], 4, 20, 100, make_rng(seed))
    used = [row for clip in clips for row in rows(clip)]
    assert len(used) == len(set(used)) and len(clips) >= 3 * (200 // 24 - 1)
    for clip in clips:
        first, stop = cache.episodes[clip.episode]
        assert clip.episode in (0, 2, 3) and first <= clip.start and clip.start + 24 <= stop
        assert np.array_equal(clip.pose, cache.pose[clip.start : clip.start + 24])


def test_no_clip_crosses_a_lost_action_or_an_end():
    cache = recording()
    cache.action_valid[60] = False  # row 60 may close a clip but not lead to row 61
    cache.done[300] = True
    for seed in range(10):
        for clip in clips_from_cache(cache, range(4), 3, 20, 100, make_rng(seed)):
            assert not {60, 61} <= set(rows(clip)) and not {300, 301} <= set(rows(clip))


def test_places_can_be_kept_apart():
    cache = recording(length=400)
    middle = float(np.median(cache.pose[:, 0]))
    box = (middle, -1e9, 1e9, 1e9)
    inside = clips_from_cache(cache, range(4), 2, 10, 100, make_rng(0), in_box(*box))
    outside = clips_from_cache(cache, range(4), 2, 10, 100, make_rng(0), out_of_sight(*box))
    assert inside and outside
    assert all((clip.pose[:, 0] >= middle).all() for clip in inside)
    assert all((clip.pose[:, 0] < middle).all() for clip in outside)


def test_a_place_that_is_only_looked_into_is_not_recorded_ground():
    cache = recording(length=400)
    middle = float(np.median(cache.pose[:, 0]))
    cache.world["camera"] = (0.5, 0.8, 0.5, 0.5)
    cache.depth = np.full((len(cache.pose), 4, 8), 0.01, np.float32)
    box = (middle, -1e9, 1e9, 1e9)
    near = clips_from_cache(cache, range(4), 2, 10, 100, make_rng(0), out_of_sight(*box))
    cache.depth[:] = 1e3  # now everybody who faces the box sees into it
    far = clips_from_cache(cache, range(4), 2, 10, 100, make_rng(0), out_of_sight(*box))
    assert 0 < len(far) < len(near)
    for clip in far:
        heading = yaw(torch.from_numpy(clip.pose))
        assert (heading.cos() < 0.8).all(), "nobody in it faces the box"


def test_the_draw_repeats_from_its_seed():
    first, second, other = some_clips(seed=1), some_clips(seed=1), some_clips(seed=2)
    assert [clip.start for clip in first] == [clip.start for clip in second] != [clip.start for clip in other]


def test_too_short_a_recording_is_named():
    with pytest.raises(DatasetError, match="no window of 304 rows"):
        clips_from_cache(recording(), range(4), 4, 300, 5, make_rng(0))


def test_moving_clips_are_told_from_still_ones():
    cache = recording()
    still = clips_from_cache(cache, [0], 3, 20, 1, make_rng(0))[0]
    cache.pose[still.start : still.start + 23] = cache.pose[still.start]
    assert not still.moves() and still.walked_m()[-1] == 0
    assert any(clip.moves() for clip in some_clips())


def test_evidence_that_does_not_fit_is_refused():
    clips = some_clips(2)
    seen = evidence(clips, Panorama().spec, 0)
    assert set(seen) == {"rgb", "pose"} and seen["rgb"].shape == (2, 24, 32, 3)
    lacking = [replace(clip, channels={"rgb": clip.channels["rgb"]}) for clip in clips]
    with pytest.raises(ObservationError, match="lacks"):
        evidence(lacking, Panorama().spec, 0)
    small = [replace(clip, channels={**clip.channels, "rgb": clip.channels["rgb"][:, ::2]}) for clip in clips]
    with pytest.raises(ObservationError, match="size"):
        evidence(small, Panorama().spec, 0)


def test_depth_of_another_size_is_shown_at_the_size_of_the_world():
    cache = recording()
    cache.depth = np.random.default_rng(0).random((len(cache.pose), 6, 8)).astype(np.float32)
    clips = clips_from_cache(cache, range(4), 2, 10, 3, make_rng(0))
    spec = Panorama().spec
    channels = {**spec.channels, "depth": spaces.Box(0, 100, (12, 16), np.float32)}
    seen = evidence(clips, replace(spec, channels=channels, observes=("rgb", "pose", "depth")), 0)["depth"]
    assert seen.shape == (3, 12, 16) and torch.equal(
        seen[:, ::2, ::2], torch.from_numpy(np.stack([c.channels["depth"][0] for c in clips]))
    )


def test_what_a_world_heeds_is_shown_to_it_where_it_was_recorded():
    cache, spec = recording(), Panorama().spec
    count = len(cache.pose)
    things = np.zeros((count, 12, 16), bool)
    things[:, 5, 7] = True
    cache.further = {"health": np.arange(count, dtype=np.float32)[:, None], "things": things, "ammo": np.zeros(count)}
    clips = clips_from_cache(cache, range(4), 2, 10, 3, make_rng(0))
    channels = {"health": spaces.Box(-np.inf, np.inf, (), np.float32), "things": spaces.Box(0, 1, (6, 8), np.bool_)}
    heeding = replace(spec, channels={**spec.channels, **channels}, may_observe=("health", "things"))
    seen = evidence(clips, heeding, 1)
    assert seen["health"].tolist() == [clip.start + 1 for clip in clips] and "ammo" not in seen
    assert seen["things"].dtype == torch.bool and seen["things"].nonzero().tolist() == [[k, 2, 3] for k in range(3)]
    odd = {"health": np.full((12, 1), np.nan, np.float32), "things": np.zeros((12, 3), bool)}
    plain = [{name: clip.channels[name] for name in ("rgb", "pose")} for clip in clips]
    strange = [replace(clip, channels={**some, **odd}) for clip, some in zip(clips, plain)]
    assert set(evidence(strange, heeding, 1)) == set(spec.observes), "what does not fit is left out"
    silent = [replace(clip, channels=some) for clip, some in zip(clips, plain)]
    assert set(evidence(silent, heeding, 1)) == set(spec.observes), "nobody is asked for what was not recorded"
