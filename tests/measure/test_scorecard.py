"""The scorecard must praise a perfect world and find out each flaw, and tell the same twice."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from panorama import Panorama, card_of, exam_of, recording, some_clips

from terrella.core import check_world, make_rng
from terrella.core.errors import DatasetError, ObservationError
from terrella.measure import Album, ExamConfig, as_dict, examine, to_json, verdict
from terrella.measure.album import appearance
from terrella.measure.closure import (
    clips_that_walk,
    rows_of,
    run_round_trip,
    turn_round_trip,
    walk_round_trip,
    yaw_round_trip,
)
from terrella.measure.endurance import NAMES, long_rollout, still_rows
from terrella.measure.endurance import rows_of as stretches
from terrella.measure.fidelity import PSNR_CAP_DB
from terrella.measure.scorecard import EARLY, GAIN, PREDICTED, Curve, Row
from terrella.measure.speed import speed
from terrella.measure.statistics import Band, wilson

ARMS = {flaw or "perfect": Panorama(flaw) for flaw in ("", "static", "deaf", "long", "fading", "shy")}


@pytest.fixture(scope="module")
def clips():
    return some_clips()


@pytest.fixture(scope="module")
def card(clips):
    return card_of(ARMS, {"recorded": clips, "new": some_clips(6, seed=9)})


def row(card, what, arm, horizon, motion="predicted", place="recorded", probe=None):
    found = [
        r for r in card.rows if (r.what, r.arm, r.horizon, r.place, r.motion) == (what, arm, horizon, place, motion)
    ]
    return next(r for r in found if probe in (None, r.probe))


def test_the_fake_world_keeps_the_contract():
    check_world(Panorama())


def test_a_perfect_world_scores_at_the_cap_and_obeys(card):
    for motion in ("predicted", "true"):
        for horizon in (1, 8, 32):
            best = {
                what: row(card, what, "perfect", horizon, motion).figure.value for what in ("PSNR", "SSIM", "sharpness")
            }
            assert best["PSNR"] == pytest.approx(PSNR_CAP_DB, abs=2) and best["SSIM"] > 0.999
            assert best["sharpness"] == pytest.approx(1, abs=0.01)
    assert row(card, "PSNR: true actions over other actions", "perfect", 32).figure.low > 3
    assert row(card, "PSNR: true actions over no action", "perfect", 32).figure.low > 3
    assert row(card, "distance over the way gone, mean", "perfect", 32).figure.value < 0.01
    assert row(card, "distance", "perfect", 32).figure.value < 1e-4
    assert row(card, "turn", "perfect", 32).figure.value < 0.002


def test_every_figure_of_likeness_stands_beside_what_knows_nothing(card):
    for horizon in (8, 32):
        for what in ("PSNR", "distance", "turn"):
            beside = row(card, what, "perfect", horizon).baselines
            assert set(beside) == {"copy last", "other actions", "no action"}
        right = row(card, "PSNR", "perfect", horizon)
        assert all(right.figure.low > baseline.high for baseline in right.baselines.values())
    assert all("copy last" in r.baselines for r in card.rows if r.probe == "pixels" and r.what in ("SSIM", "sharpness"))


@pytest.mark.slow
def test_a_world_that_stands_still_is_said_to_move_too_little(card, clips):
    moving = [row(card, "change per step", "perfect", horizon).figure.value for horizon in (1, 8, 32)]
    assert moving == pytest.approx([1, 1, 1], abs=0.02)
    static = card_of({"still": Panorama("static")}, {"recorded": clips})
    assert row(static, "change per step", "still", 32).figure.value == 0
    assert "moves too little" in verdict(static)[0]


def test_the_verdict_comes_first(card, clips):
    assert next(iter(as_dict(card))) == "verdict"
    better = "better than copying the last frame at every step up to 32"
    assert verdict(card)[0] == f"panorama is {better}; it obeys, stays sharp, moves as much as the recording."
    alike = "not clearly better than copying the last frame at any step up to 32"
    still = verdict(card_of({"still": Panorama("static")}, {"recorded": clips}))
    assert still[0].startswith(f"panorama static is {alike}; it does not clearly obey")
    deaf = verdict(card_of({"deaf": Panorama("deaf")}, {"recorded": clips}))
    assert "does not clearly obey" in deaf[0]
    faded = verdict(card_of({"fading": Panorama("fading")}, {"recorded": clips}))
    assert "blurs" in faded[0], faded
    alone = verdict(card_of({"one": Panorama()}, {"recorded": clips[:1]}))
    assert "not clearly better" in alone[0] and "no clear difference" in alone[1], "one clip cannot say"


@pytest.mark.parametrize(
    "shares, words",
    [
        ({"recorded": 4, "new": 1}, None),
        ({"recorded": 20, "new": 20}, ", ends too early"),
        ({"recorded": 6, "new": 1}, ", may end too early, does not clearly end too early in new places"),
        ({"recorded": 1, "new": 20}, ", does not clearly end too early, ends too early in new places"),
    ],
)
def test_the_verdict_names_worlds_that_end_too_early(card, shares, words):
    rows = [
        Row(
            "outcomes",
            "done",
            EARLY,
            "",
            place,
            "perfect",
            PREDICTED,
            step,
            wilson(count if step == 32 else 24, 24),
            -1,
        )
        for place, count in shares.items()
        for step in (8, 32)
    ]
    said = verdict(replace(card, rows=[*card.rows, *rows]))[0]
    assert (f"{words}." in said) if words else "early" not in said


def test_the_verdict_says_at_which_steps_copying_is_better(card):
    def told(*gains: float, place: str = "recorded") -> Curve:
        band = Band(list(gains), [gain - 0.1 for gain in gains], [gain + 0.1 for gain in gains], 9)
        return Curve("pixels", "rgb", f"x{GAIN}", "dB", place, "perfect", "predicted", range(1, len(gains) + 1), band)

    def said(*curves: Curve) -> str:
        return verdict(replace(card, curves=list(curves)))[0].partition(" is ")[2].partition("; it ")[0]

    assert said(told(1, 1, 0, -1, -1)) == "worse than copying the last frame beyond 3 steps, better up to 2 steps"
    assert said(told(-1, 0, 1, 1)) == "worse than copying the last frame after 1 step, better beyond 2 steps"
    assert said(told(-1, -1)) == "worse than copying the last frame at every step up to 2"
    assert "worse than copying the last frame at 3 of 6 steps" in said(told(-1, 1, -1, 1, -1, 1))
    two = said(told(1, 1), told(1, -1, place="new")).partition("; ")
    assert two[0] == "better than copying the last frame at every step up to 2"
    assert two[2] == "in new places worse after 2 steps, better after 1 step"


def test_pooled_errors_do_not_flatter_copying_where_little_changes(clips):
    half = [
        replace(clip, channels=clip.channels | {"rgb": np.repeat(clip.channels["rgb"][:1], 35, 0)}) for clip in clips
    ]
    mixed = card_of({"fading": Panorama("fading")}, {"recorded": [*clips[:6], *half[6:]]})
    still, pooled, frames, pixels = (
        row(mixed, what, "fading", 1)
        for what in ("PSNR", *(f"pooled PSNR{of}" for of in ("", ", frames that change", ", pixels that change")))
    )
    assert still.baselines["copy last"].value > pooled.baselines["copy last"].value + 3
    assert (
        pooled.baselines["copy last"].value > frames.baselines["copy last"].value > pixels.baselines["copy last"].value
    )
    errors = [10 ** (-figure.value / 10) for figure in (pooled.figure, frames.figure)]
    assert errors[1] <= 2 * errors[0] * 1.01 and pooled.gain.low <= pooled.gain.value <= pooled.gain.high


def test_a_static_world_gains_nothing(card):
    for horizon in (1, 8, 32):
        figure = row(card, "PSNR", "static", horizon).gain
        assert (figure.value, figure.low, figure.high) == (0, 0, 0)


def test_a_deaf_world_is_found_out(card):
    for horizon in (8, 32):
        for others in ("other actions", "no action"):
            figure = row(card, f"PSNR: true actions over {others}", "deaf", horizon).figure
            assert figure.value == 0 and figure.low <= 0 <= figure.high


def test_a_stride_ten_percent_too_long_is_measured_as_such(card, clips):
    straight = row(card, "distance over the way gone, mean", "long", 8).figure
    assert 5 < straight.value <= 10.01
    went = sum(clip.walked_m()[-1] > 0.5 for clip in clips)
    assert row(card, "distance over the way gone, mean", "long", 32).figure.count == went


def test_fading_shows_in_sharpness_and_in_the_drop(card):
    ratios = [row(card, "sharpness", "fading", horizon).figure.value for horizon in (1, 8, 32)]
    for horizon, ratio in zip((1, 8, 32), ratios):
        assert ratio == pytest.approx(np.exp(-2 * horizon / 50), abs=0.03)
    drops = {arm: row(card, "PSNR lost from 8 to 32 steps", arm, 32).figure for arm in ("fading", "perfect")}
    assert drops["fading"].low > 3 and abs(drops["perfect"].value) < 2


def test_true_motion_is_scored_only_where_the_world_takes_poses(card):
    motions = {arm: {r.motion for r in card.rows if r.arm == arm and r.what == "PSNR"} for arm in ("shy", "long")}
    assert motions == {"shy": {"predicted"}, "long": {"predicted", "true"}}
    true, predicted = (row(card, "PSNR", "long", 32, motion).figure.value for motion in ("true", "predicted"))
    assert true > predicted
    assert {r.motion for r in card.rows if r.probe == "pose"} == {"predicted"}, "what was given is not predicted"


def test_places_are_kept_apart_and_described(card):
    assert [(place.name, place.clips, place.context, place.horizon) for place in card.places] == [
        ("recorded", 12, 3, 32),
        ("new", 6, 3, 32),
    ]
    assert row(card, "PSNR", "perfect", 8, place="new").figure.count == 6
    strips = [picture for picture in card.pictures if picture.probe == "pixels"]
    assert len(strips) == 4 and strips[0].rows["truth, rgb"].shape == (4, 24, 32, 3)


def test_the_same_seed_gives_the_same_card_whatever_the_other_arms(clips, card):
    again = [card_of({"deaf": Panorama("deaf")}, {"recorded": clips}) for _ in range(2)]
    assert to_json(again[0]) == to_json(again[1])
    assert row(again[0], "PSNR", "deaf", 32).figure == row(card, "PSNR", "deaf", 32).figure


def test_a_batch_of_clips_gives_the_figures_of_one_at_a_time(clips, card):
    config = replace(exam_of({}).config, batch=1)
    alone = card_of({"long": Panorama("long")}, {"recorded": clips}, config)
    for what in ("PSNR", "distance", "sharpness"):
        one, many = row(alone, what, "long", 32).figure, row(card, what, "long", 32).figure
        assert one.value == pytest.approx(many.value, rel=1e-3) and one.count == many.count


def test_the_json_is_strict_and_whole(card):
    told = json.loads(to_json(card), parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    assert len(told["rows"]) == len(card.rows) and "pictures" not in told
    assert told["rows"][1]["figure"]["count"] == 12 and told["dt_s"] == pytest.approx(1 / 35, rel=1e-5)


def test_what_a_world_lacks_is_listed_and_no_error(clips, card):
    gone = {(one.probe, one.arm): one.why for one in card.missing}
    assert (
        gone["calibration", "perfect"].startswith("needs uncertainty") and gone["drift", "deaf"] == "needs longer clips"
    )
    assert ("pose", "perfect") not in gone and ("pixels", "perfect") not in gone
    blind = card_of({"blind": Panorama("blind")}, {"recorded": clips})
    assert {one.probe: one.why for one in blind.missing}["pose"] == "needs pose, of the world and of the recording"
    assert not [r for r in blind.rows if r.probe == "pose"] and {r.motion for r in blind.rows} == {"predicted"}


def test_bad_clips_are_named(clips):
    with pytest.raises(DatasetError, match="no clips of new places"):
        card_of({"a": Panorama()}, {"new": []})
    with pytest.raises(DatasetError, match="largest horizon is 128"):
        card_of({"a": Panorama()}, {"recorded": clips}, ExamConfig())
    with pytest.raises(DatasetError, match="differ in length"):
        card_of({"a": Panorama()}, {"recorded": [*clips, *some_clips(2, 40)]})


def test_one_clip_has_figures_without_intervals_and_no_other_actions(clips):
    card = card_of({"a": Panorama()}, {"recorded": clips[:1]})
    assert not [r for r in card.rows if "other actions" in r.what]
    assert json.loads(to_json(card))["rows"][0]["figure"]["low"] is None


def closure(world, clips, way, batch=12):
    """The rows of a way there and back: of the frame after coming back, and of the far view seen again."""
    return rows_of(("recorded", "a"), way, run_round_trip(world, clips[:batch], way, make_rng(0)), lambda: make_rng(0))


def test_closure_of_a_perfect_world_closes(clips):
    back, again = closure(Panorama(), clips, yaw_round_trip(180))
    assert not back.void and back.figure.value > 45 and back.baselines["far view"].value < 20
    gone = run_round_trip(Panorama(), clips, yaw_round_trip(180), make_rng(0))
    frames = gone["frames"][0].numpy()
    assert back.horizon == 120 and frames.shape == (6, 24, 32, 3) and again.figure.value > 45
    assert np.array_equal(frames[1], frames[3]) and not np.array_equal(frames[0], frames[2])


def test_closure_of_a_static_world_is_void(clips):
    back, again = closure(Panorama("static"), clips, yaw_round_trip(180))
    assert back.void and again.void and back.figure.value == PSNR_CAP_DB


def test_closure_of_a_forgetful_world_does_not_close(clips):
    back, _ = closure(Panorama("forgetful"), clips, yaw_round_trip(180))
    assert not back.void and back.figure.high < 20


def test_a_walk_there_and_back_closes_where_the_place_is_remembered():
    clips = clips_that_walk(some_clips(8, 64), 100)
    assert clips and all(clip.walked_m()[49] >= 1 for clip in clips)
    done = {flaw: closure(Panorama(flaw), clips, walk_round_trip(100)) for flaw in ("", "static", "forgetful")}
    assert done[""][0].figure.value > 45 and done[""][0].horizon == 100 and "m away" in done[""][0].note
    assert done["static"][0].void and not done["forgetful"][0].void and done["forgetful"][0].figure.high < 20
    assert done[""][1].figure.value > 45 > 20 > done["forgetful"][1].figure.high
    assert done["static"][1].void and not done[""][1].void


def test_a_world_without_poses_is_turned_by_its_actions(clips):
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
    back, _ = closure(Keyed(), clips, turn_round_trip(left, right, "left and right", 60), batch=4)
    assert back.horizon == 60 and back.figure.value > 20 > back.baselines["far view"].value
    with pytest.raises(ObservationError, match="does not observe 'pose'"):
        closure(Keyed(), clips, yaw_round_trip(90), batch=4)


def long_report(world, clips, steps, album=None, rollouts=8):
    gone = long_rollout(world, clips, make_rng(0), steps, rollouts)
    return stretches(gone, clips, album, "a", "recorded", make_rng(0))


def test_long_dreams_of_the_perfect_world_stay_and_fading_ones_do_not(clips):
    album = Album.of_cache(recording())
    runs = {flaw: long_report(Panorama(flaw), clips, 300, album) for flaw in ("", "fading")}
    for found in runs[""].rows:
        assert 0.8 < found.figure.value < 1.2 or np.isnan(found.figure.value)
    assert [found.what for found in runs[""].rows] == list(NAMES)
    assert runs["fading"].rows[0].figure.value < 0.05
    curve = runs[""].curves[0]
    assert list(curve.x)[:3] == [30, 60, 90] and curve.x[-1] == 300
    assert runs[""].pictures[0].rows["a"].shape == (12, 24, 32, 3)


def test_standing_still_must_not_fade(clips):
    for flaw, most in (("", 1e-9), ("static", 1e-9), ("fading", 1.0)):
        found = still_rows(
            long_rollout(Panorama(flaw), clips, make_rng(0), 100, 4, idle=True), "a", "recorded", make_rng(0)
        )
        assert [one.what for one in found.rows] == list(NAMES[:4]) and found.curves[0].x[-1] == 100
        strayed = abs(found.rows[0].figure.value - 1)
        assert strayed <= most and (flaw != "fading" or strayed > 0.9)
        assert found.pictures[0].columns[:2] == ["now", "1"] and found.rows[0].baselines["copy last"].value == 1
    config = replace(exam_of({}).config, still_steps=100)
    said = [verdict(card_of({"a": Panorama(flaw)}, {"recorded": clips}, config))[0] for flaw in ("", "fading")]
    assert "holds still" in said[0] and "fades while the agent idles" in said[1]


def test_who_still_glides_is_held_against_where_it_comes_to_rest():
    looks, poses = torch.full((20, 2, 7), 100.0), torch.zeros(20, 2, 7)
    poses[:6, 0, 0], looks[:6, 0] = torch.linspace(3, 0.5, 6), torch.linspace(20, 90, 6)[:, None]
    gone = {"looks": looks, "first": looks[0], "poses": poses, "frames": torch.zeros(2, 8, 8, 3, dtype=torch.uint8)}
    glided = still_rows(gone, "a", "recorded", make_rng(0)).rows[0].figure
    assert glided.value == pytest.approx(1) == pytest.approx(glided.low)
    looks[10:] = 60.0
    assert still_rows(gone, "a", "recorded", make_rng(0)).rows[0].figure.value == pytest.approx(0.6)


def test_a_fuller_album_matches_more_of_the_dream(clips):
    own, full = (long_report(Panorama(), clips, 100, album) for album in (None, Album.of_cache(recording())))
    share = [int(found.rows[0].note.partition("(")[2].partition("%")[0]) for found in (own, full)]
    assert share[1] > share[0]
    natural = full.rows[0].baselines["real stretches"]
    assert 0.8 < natural.low < natural.high < 1.2


def test_a_dream_that_leads_where_nobody_recorded_is_not_judged(clips):
    class Elsewhere(Album):
        def nearest(self, pose, not_episode=None):
            return torch.full((len(pose),), -1)

    nowhere = Elsewhere([(clip.channels["rgb"], clip.pose, clip.episode) for clip in clips])
    found = long_report(Panorama(), clips, 100, nowhere).rows[0]
    assert "(0% of" in found.note and np.isnan(found.figure.value) and np.isnan(found.baselines["real stretches"].low)


def test_the_album_finds_the_nearest_view_and_no_far_one():
    cache = recording(2, 100)
    album = Album.of_cache(cache)
    pose = torch.from_numpy(cache.pose[[5, 150]])
    rows = album.nearest(pose)
    assert torch.equal(album.place[rows], pose[:, :3])
    assert torch.allclose(album.appearances(rows), appearance(torch.from_numpy(cache.rgb[rows.numpy()])))
    assert album.nearest(pose + torch.tensor([100.0, 0, 0, 0, 0, 0, 0])).tolist() == [-1, -1]
    others = album.nearest(pose, torch.tensor([0, 1]))
    assert all(row < 0 or album.episode[row] != episode for row, episode in zip(others.tolist(), (0, 1)))


def test_a_world_without_poses_is_held_against_the_mean(clips):
    found = long_report(Panorama("blind"), clips, 100).rows[0]
    assert "the mean of the recordings (100%" in found.note
    assert found.baselines["real stretches"].low < 1 < found.baselines["real stretches"].high


def test_speed_counts_what_it_timed(clips):
    timed = speed(Panorama(), clips, make_rng(0), steps=40)
    assert int(timed["threads"]) == torch.get_num_threads() and len(timed["ms"]) == 40 and timed["ms"].min() > 0


def test_nothing_learns_here(clips):
    class Watched(Panorama):
        def imagine(self, state, action, rng):
            assert torch.is_inference_mode_enabled()
            return super().imagine(state, action, rng)

    examine(exam_of({"a": Watched()}, {"recorded": clips[:2]}))
