"""Outcomes: errors of reward, health and end are what they should be for worlds that are right, blind, or always wrong."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from gymnasium import spaces

from terrella.core import Spec, State, make_rng
from terrella.core.errors import DatasetError
from terrella.core.spec import DONE, REWARD
from terrella.measure import CLIPS, ENDINGS, Exam, ExamConfig, examine
from terrella.measure.clips import Clip
from terrella.measure.outcomes import auc, clips_with_endings, correlation, early_ends, outcome_rows
from terrella.measure.rollouts import StepMetric, dream
from terrella.measure.scorecard import PREDICTED

HEALTH = spaces.Box(-np.inf, np.inf, (), np.float32)


class Game:
    """Each step pays what is pressed and costs one of health; at 0 it is over. `blind` says that nothing ever happens."""

    def __init__(self, blind: bool = False):
        self.blind = blind
        channels = {"rgb": spaces.Box(0, 255, (8, 8, 3), np.uint8), "reward": REWARD, "done": DONE, "health": HEALTH}
        self.spec = Spec("game", spaces.MultiBinary(1), channels, ("rgb",), 0.1, may_observe=("health",))

    def start(self, batch, rng) -> State:
        return State({"health": torch.full((batch,), 9.0), "reward": torch.zeros(batch)})

    def observe(self, observation, prior, rng) -> State:
        count = len(observation["rgb"])
        return State({"health": observation["health"].float(), "reward": torch.zeros(count)})

    def imagine(self, state, action, rng) -> State:
        if self.blind:
            return state
        alive = state["health"] > 0
        return State({"health": state["health"] - alive.float(), "reward": action[:, 0].float() * alive})

    def render(self, state, channels):
        seen = {"health": state["health"], "reward": state["reward"], "done": state["health"] <= 0}
        seen["rgb"] = torch.zeros(state.batch, 8, 8, 3, dtype=torch.uint8)
        return {name: seen[name] for name in channels}


def recording(lengths=(40, 30, 50)):
    """Episodes of the game, of `lengths` rows each, the last without an action."""
    health = np.concatenate([np.arange(length)[::-1] for length in lengths]).astype(np.float32)
    rows, stops = len(health), np.cumsum(lengths)
    action = np.random.default_rng(0).integers(0, 2, (rows, 1)).astype(np.float32)
    done = health == 1
    reward = action[:, 0] * (health > 0)
    return SimpleNamespace(
        episodes=[(stop - length, stop) for length, stop in zip(lengths, stops)], length=rows, depth=None, pose=None,
        rgb=np.zeros((rows, 8, 8, 3), np.uint8), action=action, reward=reward, done=done,
        arrays={}, keys={}, further={"health": health[:, None]},
    )  # fmt: skip


def exam_rows(clips, real, horizons=(4, 16)):
    """Rows by arm, horizon and name."""
    config = ExamConfig(horizons, (), batch=5, strips=1, long_steps=0, speed_steps=0)
    arms = {"right": Game(), "blind": Game(blind=True)}
    going = {"recorded": real}
    card = examine(Exam(arms, {CLIPS: {"recorded": clips}, ENDINGS: {"recorded": clips}}, config, going=going))
    return {(row.arm, row.horizon, row.what): row for row in card.rows if row.probe == "outcomes"}


def test_a_world_that_is_right_errs_in_nothing_and_a_blind_one_as_a_copy_does():
    shown = clips_with_endings(recording(), Game().spec, (0, 1, 2), 5, 16, 24, make_rng(0))
    rows = exam_rows(*shown)
    for horizon in (4, 16):
        assert rows["right", horizon, "return error"].figure.value == rows["right", horizon, "error"].figure.value == 0
        blind = rows["blind", horizon, "error"]
        assert blind.figure.value == blind.baselines["copy last"].value > 1 and blind.gain.value == 0
        assert rows["blind", horizon, "ends: AUC"].figure.value == 0.5
        assert rows["right", horizon, "return error"].gain.value > 0
        assert rows["right", horizon, "return correlation"].figure.value == pytest.approx(1)
        assert np.isnan(rows["blind", horizon, "return correlation"].figure.value), "it never pays"
    ends = rows["right", 16, "ends: AUC"]
    assert ends.figure.value == 1.0 and 0 < int(ends.note.split()[0]) < 24
    pays = rows["right", 16, "pays: AUC"].figure.value
    assert pays == 1.0 or np.isnan(pays)


def test_half_of_the_passages_run_into_an_end_and_stand_still_after_it():
    shown = clips_with_endings(recording(), Game().spec, (0, 1, 2), 5, 16, 20, make_rng(1))
    short = [(clip, real) for clip, real in zip(*shown) if not real.all()]
    assert len(short) >= 10
    for clip, real in short:
        after = clip.channels["health"][int(real.sum()) :]
        assert (after == after[0]).all() and (clip.action[~real] == 0).all()
        assert real[:5].all()


@pytest.mark.parametrize("space", [spaces.Discrete(3, start=1), spaces.Box(0.5, 1, (1,), np.float32)])
def test_after_an_end_the_actions_are_legal(space):
    cache = recording()
    cache.action = np.ones_like(cache.action)
    for clip, _ in zip(
        *clips_with_endings(cache, replace(Game().spec, action=space), (0, 1, 2), 5, 16, 20, make_rng(1))
    ):
        assert all(space.contains(row.astype(space.dtype).reshape(space.shape)[()]) for row in clip.action)


def test_nothing_but_the_end_is_judged_after_an_end():
    clips, real = clips_with_endings(recording(), Game().spec, (0, 1, 2), 5, 16, 24, make_rng(0))
    exam = Exam({"right": Game()}, {CLIPS: {"recorded": clips}}, ExamConfig((4, 16), ()))
    going = torch.from_numpy(np.stack(real))
    dreamt = {name: torch.from_numpy(np.stack([clip.channels[name][5:] for clip in clips])) for name in ("health",)}
    dreamt["health"] = dreamt["health"].reshape(24, 16).clone()
    dreamt["reward"] = torch.from_numpy(np.stack([clip.channels["reward"][4:-1] for clip in clips]))
    after = ~going[:, 4:-1]
    assert after.any()
    dreamt = {name: torch.where(after, 99.0, values) for name, values in dreamt.items()}
    rows = [
        row
        for row in outcome_rows(exam, "recorded", "right", clips, going, dreamt)
        if row.what in ("error", "return error")
    ]
    assert len(rows) == 4 and all(row.figure.value == 0 for row in rows)
    assert min(row.figure.count for row in rows if row.what == "error") < 24


def test_the_share_of_clips_that_are_ended_too_early():
    clips, _ = clips_with_endings(recording((200,)), Game().spec, (0,), 5, 16, 4, make_rng(0))
    exam = Exam({"right": Game()}, {CLIPS: {"recorded": clips}}, ExamConfig((4, 16), ()))
    done = torch.zeros(4, 16, dtype=torch.bool)
    done[0, 2:4], done[1, 7], done[2, 8] = True, True, True
    rows = early_ends(exam, "recorded", "right", {"done": done})
    assert [(row.horizon, row.figure.value) for row in rows] == [(4, 1 / 4), (16, 3 / 4)]


class Walk:
    """A number that grows by one each step until it is 3: then the world says that it is over, and stands still."""

    spec = Spec("walk", spaces.MultiBinary(1), {"reward": REWARD}, ("reward",), 0.1)

    def observe(self, observation, prior, rng) -> State:
        place = observation["reward"].float()
        return State({"place": place, "done": place > 9})

    def imagine(self, state, action, rng) -> State:
        place = torch.where(state["done"], state["place"], state["place"] + 1)
        return State({"place": place, "done": place >= 3})

    def render(self, state, channels):
        return {"reward": state["place"]}


@pytest.mark.parametrize("ends, places", [(False, [1, 2, 3, 4, 5, 6]), (True, [1, 2, 3, 3, 3, 3])])
def test_a_rollout_goes_on_after_a_predicted_end_unless_the_end_is_judged(ends, places):
    clip = Clip({"reward": np.zeros(7, np.float32)}, np.zeros((7, 1), np.float32), 1, 0, 0)
    metric = StepMetric(("reward",), lambda seen, *_: {"place": seen["reward"]}, ends)
    assert dream(Walk(), [clip], PREDICTED, 6, make_rng(0), [metric])["place"].tolist() == [places]


def test_results_of_another_recording_do_not_count():
    clips, real = clips_with_endings(recording(), Game().spec, (0, 1, 2), 5, 16, 4, make_rng(0))
    brighter = [replace(clip, channels={**clip.channels, "rgb": clip.channels["rgb"] + 1}) for clip in clips]
    prints = [
        Exam({"right": Game()}, {CLIPS: {"recorded": some}}, ExamConfig()).fingerprint() for some in (clips, brighter)
    ]
    assert prints[0] != prints[1]


def test_auc_counts_pairs():
    score, positive = torch.tensor([3.0, 1.0, 2.0, 2.0]), torch.tensor([True, False, True, False])
    assert auc(score, positive) == pytest.approx((1 + 1 + 1 + 0.5) / 4)
    assert np.isnan(auc(score, torch.ones(4, dtype=torch.bool)))


def test_correlation_is_pearsons():
    first, second = torch.tensor([1.0, 2, 3, 4, 5]), torch.tensor([2.0, 1, 4, 3, 6])
    found = correlation(first, second)
    assert found.value == pytest.approx(np.corrcoef(first, second)[0, 1]) and found.low < found.value < found.high
    assert correlation(first, -first).value == pytest.approx(-1)


def test_what_is_too_short_is_refused():
    with pytest.raises(DatasetError, match="longer than"):
        clips_with_endings(recording((4, 5)), Game().spec, (0, 1), 5, 8, 4, make_rng(0))


def test_passages_stay_where_they_may():
    cache = recording()
    allowed = np.zeros(cache.length, bool)
    allowed[cache.episodes[1][0] + 3 : cache.episodes[1][1] - 2] = True
    shown = clips_with_endings(
        cache, Game().spec, (0, 1, 2), 2, 4, 12, make_rng(0), lambda cache, first, stop: allowed[first:stop]
    )
    for clip, real in zip(*shown):
        rows = clip.start + np.arange(len(real) + 1)
        assert allowed[rows[:-1][real]].all() and allowed[clip.start]
