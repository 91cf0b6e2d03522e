"""The scorecard must praise a perfect world and find out each flaw, and tell the same twice."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from panorama import Panorama, recording, some_clips

from terrella.core import check_world, make_rng
from terrella.core.errors import DatasetError, ObservationError
from terrella.measure import (
    Album,
    ScoreConfig,
    closure,
    key_way,
    long_rollout,
    score,
    speed,
    to_json,
    walk_way,
    yaw_way,
)
from terrella.measure.album import look
from terrella.measure.closure import walkers
from terrella.measure.fidelity import PSNR_CAP_DB

CONFIG = ScoreConfig((1, 8, 32), (8, 32), (8, 32), drop=(8, 32), batch=5, strips=2)


@pytest.fixture(scope="module")
def clips():
    return some_clips()


@pytest.fixture(scope="module")
def card(clips):
    arms = {flaw or "perfect": Panorama(flaw) for flaw in ("", "static", "deaf", "long", "fading", "shy")}
    return score(arms, {"recorded": clips, "new": some_clips(6, seed=9)}, make_rng(0), CONFIG)


def row(card, kind, arm, horizon, motion=None, place="recorded"):
    found = [r for r in getattr(card, kind) if (r.arm, r.horizon, r.place) == (arm, horizon, place)]
    return next(r for r in found if motion is None or r.motion == motion)


def test_the_fake_world_keeps_the_contract():
    check_world(Panorama())


def test_a_perfect_world_scores_at_the_cap_and_obeys(card):
    for motion in ("predicted", "true"):
        for horizon in (1, 8, 32):
            best = row(card, "fidelity", "perfect", horizon, motion)
            assert best.psnr.value == pytest.approx(PSNR_CAP_DB, abs=2) and best.ssim.value > 0.999
            assert best.sharpness.value == pytest.approx(1, abs=0.01)
    assert row(card, "control", "perfect", 32).difference.low > 3
    assert row(card, "position", "perfect", 32).mean_share.value < 1e-4
    assert row(card, "position", "perfect", 32).heading_deg.value < 0.1


def test_a_static_world_gains_nothing(card):
    for horizon in (1, 8, 32):
        figure = row(card, "fidelity", "static", horizon, "predicted").gain
        assert (figure.value, figure.low, figure.high) == (0, 0, 0)


def test_a_deaf_world_is_found_out(card):
    for horizon in (8, 32):
        figure = row(card, "control", "deaf", horizon).difference
        assert figure.value == 0 and figure.low <= 0 <= figure.high


def test_a_stride_ten_percent_too_long_is_measured_as_such(card, clips):
    straight = row(card, "position", "long", 8).mean_share
    assert 0.05 < straight.value <= 0.1001
    assert row(card, "position", "long", 32).mean_share.count == sum(clip.walked_m()[-1] > 0.5 for clip in clips)


def test_fading_shows_in_sharpness_and_in_the_drop(card):
    ratios = [row(card, "fidelity", "fading", horizon, "predicted").sharpness.value for horizon in (1, 8, 32)]
    for horizon, ratio in zip((1, 8, 32), ratios):
        assert ratio == pytest.approx(np.exp(-2 * horizon / 50), abs=0.03)
    drops = {drop.arm: drop.loss for drop in card.drops if (drop.motion, drop.place) == ("predicted", "recorded")}
    assert drops["fading"].low > 3 and abs(drops["perfect"].value) < 2


def test_true_motion_is_scored_only_where_the_world_takes_poses(card):
    assert {r.motion for r in card.fidelity if r.arm == "shy"} == {"predicted"}
    assert {r.motion for r in card.fidelity if r.arm == "long"} == {"predicted", "true"}
    assert (
        row(card, "fidelity", "long", 32, "true").psnr.value > row(card, "fidelity", "long", 32, "predicted").psnr.value
    )


def test_places_are_kept_apart_and_described(card):
    assert [(place.name, place.clips, place.context, place.horizon) for place in card.places] == [
        ("recorded", 12, 3, 32),
        ("new", 6, 3, 32),
    ]
    assert row(card, "fidelity", "perfect", 8, "predicted", "new").psnr.count == 6
    assert len(card.pictures) == 4 and card.pictures[0].rows["truth"].shape == (4, 24, 32, 3)


def test_the_same_seed_gives_the_same_card_whatever_the_other_arms(clips, card):
    again = [score({"deaf": Panorama("deaf")}, {"recorded": clips}, make_rng(seed), CONFIG) for seed in (0, 0)]
    assert to_json(again[0]) == to_json(again[1])
    assert row(again[0], "fidelity", "deaf", 32).psnr.value == row(card, "fidelity", "deaf", 32).psnr.value


def test_the_json_is_strict_and_whole(card):
    told = json.loads(to_json(card), parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    assert len(told["fidelity"]) == len(card.fidelity) and "pictures" not in told
    assert told["fidelity"][1]["psnr"]["count"] == 12 and told["dt_s"] == pytest.approx(1 / 35, rel=1e-5)


def test_bad_clips_are_named(clips):
    with pytest.raises(DatasetError, match="no clips of new places"):
        score({"a": Panorama()}, {"new": []}, make_rng(0), CONFIG)
    with pytest.raises(DatasetError, match="largest horizon is 128"):
        score({"a": Panorama()}, {"recorded": clips}, make_rng(0))
    with pytest.raises(DatasetError, match="differ in length"):
        score({"a": Panorama()}, {"recorded": [*clips, *some_clips(2, 40)]}, make_rng(0), CONFIG)


def test_one_clip_has_figures_without_intervals_and_no_control(clips):
    card = score({"a": Panorama()}, {"recorded": clips[:1]}, make_rng(0), CONFIG)
    assert not card.control and json.loads(to_json(card))["fidelity"][0]["psnr"]["low"] is None


def test_closure_of_a_perfect_world_closes(clips):
    done = closure(Panorama(), clips, make_rng(0), yaw_way(180))
    assert not done.void and done.closed.value > 45 and done.far.value < 20
    assert done.steps == 120 and done.picture.shape == (6, 24, 32, 3) and done.again.value > 45
    assert np.array_equal(done.picture[1], done.picture[3]) and not np.array_equal(done.picture[0], done.picture[2])


def test_closure_of_a_static_world_is_void(clips):
    done = closure(Panorama("static"), clips, make_rng(0), yaw_way(180))
    assert done.void and done.closed.value == PSNR_CAP_DB


def test_closure_of_a_forgetful_world_does_not_close(clips):
    done = closure(Panorama("forgetful"), clips, make_rng(0), yaw_way(180))
    assert not done.void and done.closed.high < 20


def test_a_walk_there_and_back_closes_where_the_place_is_remembered():
    clips = walkers(some_clips(8, 64), 100)
    assert clips and all(clip.walked_m()[49] >= 1 for clip in clips)
    done = {flaw: closure(Panorama(flaw), clips, make_rng(0), walk_way(100)) for flaw in ("", "static", "forgetful")}
    assert done[""].closed.value > 45 and done[""].steps == 100 and done[""].far_m > 0.5
    assert done["static"].void and not done["forgetful"].void and done["forgetful"].closed.high < 20
    assert done[""].again.value > 45 > 20 > done["forgetful"].again.high
    assert done["static"].void_again and not done[""].void_again


def test_a_world_without_poses_is_turned_by_its_keys(clips):
    class Keyed(Panorama):
        """Takes pictures alone, and shows no pose."""

        @property
        def spec(self):
            whole = super().spec
            return replace(whole, observes=("rgb",), channels={"rgb": whole.channels["rgb"]})

        def observe(self, observation, prior, rng):
            return super().observe({"pose": prior["pose"] if prior else start["pose"], **observation}, None, rng)

    left, right = torch.tensor([0, 1, 0]), torch.tensor([0, 0, 1])
    start = Panorama()._state(torch.from_numpy(np.stack([clips[0].pose[0]] * 4)))
    way = key_way(left, right, "left and right", 60)
    done = closure(Keyed(), clips[:4], make_rng(0), way, batch=4)
    assert done.steps == 60 and done.closed.value > 20 > done.far.value
    with pytest.raises(ObservationError, match="does not observe 'pose'"):
        closure(Keyed(), clips[:4], make_rng(0), yaw_way(90))


def test_long_dreams_of_the_perfect_world_stay_and_fading_ones_do_not(clips):
    runs = {flaw: long_rollout(Panorama(flaw), clips, make_rng(0), steps=300, bucket=100) for flaw in ("", "fading")}
    for bucket in runs[""].buckets:
        assert bucket.matched > 0 and 0.9 < bucket.sharpness.value < 1.1
        assert all(0.8 < f.value < 1.2 for f in (*bucket.colour_mean, *bucket.colour_std))
    assert runs["fading"].buckets[-1].sharpness.value < 0.05
    assert [(b.first, b.last) for b in runs[""].buckets] == [(1, 100), (101, 200), (201, 300)]
    assert runs[""].picture.shape == (4, 24, 32, 3)


def test_a_fuller_album_matches_more_of_the_dream(clips):
    own = long_rollout(Panorama(), clips, make_rng(0), steps=100)
    full = long_rollout(Panorama(), clips, make_rng(0), steps=100, album=Album.of_cache(recording()))
    assert full.buckets[0].matched > own.buckets[0].matched
    low, high = full.natural
    assert 0.8 < low < high < 1.2


def test_a_dream_that_leads_where_nobody_recorded_is_not_judged(clips):
    class Elsewhere(Album):
        def nearest(self, pose, not_episode=None):
            return torch.full((len(pose),), -1)

    nowhere = Elsewhere([(clip.rgb, clip.pose, clip.episode) for clip in clips])
    run = long_rollout(Panorama(), clips, make_rng(0), steps=100, album=nowhere)
    assert run.buckets[0].matched == 0 and np.isnan(run.buckets[0].sharpness.value) and np.isnan(run.natural[0])


def test_the_album_finds_the_nearest_view_and_no_far_one():
    cache = recording(2, 100)
    album = Album.of_cache(cache)
    pose = torch.from_numpy(cache.pose[[5, 150]])
    rows = album.nearest(pose)
    assert torch.equal(album.place[rows], pose[:, :3])
    assert torch.allclose(album.looks(rows), look(torch.from_numpy(cache.rgb[rows.numpy()])))
    assert album.nearest(pose + torch.tensor([100.0, 0, 0, 0, 0, 0, 0])).tolist() == [-1, -1]
    others = album.nearest(pose, torch.tensor([0, 1]))
    assert all(row < 0 or album.episode[row] != episode for row, episode in zip(others.tolist(), (0, 1)))


def test_a_world_without_poses_is_held_against_the_mean(clips):
    world = Panorama("blind")
    run = long_rollout(world, clips, make_rng(0), steps=100)
    assert run.reference == "the mean of the recordings" and run.buckets[0].matched == 1
    assert run.natural[0] < 1 < run.natural[1]
    card = score({"blind": world}, {"recorded": clips}, make_rng(0), CONFIG)
    assert not card.position and {found.motion for found in card.fidelity} == {"predicted"}


def test_speed_counts_what_it_timed(clips):
    timed = speed(Panorama(), clips, make_rng(0), "a", steps=40)
    assert timed.threads == torch.get_num_threads() and 0 < timed.median_ms <= timed.p95_ms
