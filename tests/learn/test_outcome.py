"""A made-up game: a light that moves when told to, pays and takes a life where it should, and is learned from pictures."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from gymnasium import spaces
from tests.learn.stopping import quiet

from terrella.core import chance, check_world, make_rng
from terrella.core.errors import DatasetError, ObservationError, TrainingError
from terrella.core.state import State
from terrella.data import ClipCache, Recorder
from terrella.learn.objectives.outcome import Happenings, OutcomeObjective, learn_outcome, levels, two_hot
from terrella.learn.recipes.adapt_frames import settings_of
from terrella.learn.recipes.video import TrainConfig, train_video
from terrella.learn.recipes.video_parts import vectors_to_predict
from terrella.learn.recording import Recording, controls_of
from terrella.learn.train_step import TrainStep
from terrella.learn.trainer import Run
from terrella.worlds.config import VideoConfig
from terrella.worlds.folder import load_world
from terrella.worlds.frame_history import FrameHistory, StartClips
from terrella.worlds.generator import UNet
from terrella.worlds.learned import About, LearnedWorld
from terrella.worlds.outcome import FrameOutcome
from terrella.worlds.parts import CHANGES, Evidence

from ..data.layouts import layout_of

SIZE, FACTS = (16, 24), {"discrete": True, "action_low": [0], "action_high": [2], "action_names": ["STAY", "L", "R"]}


def picture(place: int) -> np.ndarray:
    rgb = np.full((*SIZE, 3), 30, np.uint8)
    rgb[6:10, 4 * place : 4 * place + 4] = (240, 200, 90)
    return rgb


def shown(place: int, lives: int) -> dict[str, np.ndarray]:
    numbers = {"lives": np.array([lives], np.float32), "place": np.array([place, 2 * place], np.float32)}
    return {"rgb": picture(place), **numbers}


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Six places in a row: the rightmost pays 2 on arrival, the leftmost takes one of 3 lives, and the last life ends it."""
    folder, rng = tmp_path_factory.mktemp("outcome") / "set", np.random.default_rng(0)
    layout = layout_of(15.0, ("action_0",), rgb=SIZE, vectors={"lives": 1, "place": 2}, world=FACTS)
    with Recorder(folder, layout) as recorder:
        for _ in range(24):
            place, lives = int(rng.integers(1, 5)), 3
            for _ in range(60):
                action = int(rng.integers(0, 3))
                went = min(max(place + (0, -1, 1)[action], 0), 5)
                reward = 2.0 if went == 5 and place != 5 else 0.0
                fell = went == 0 and place != 0
                recorder.add(shown(place, lives), np.array([action]), reward, lives - fell == 0)
                place, lives = went, lives - fell
                if lives == 0:
                    break
            recorder.add(shown(place, lives), None, 0.0, False)
            recorder.end_episode()
    return folder


@pytest.fixture(scope="module")
def learned(recording, tmp_path_factory):
    cache = ClipCache.open(recording, SIZE)
    start = np.zeros(cache.length, np.int64)
    for first, last in cache.episodes:
        start[first:last] = first
    usable = np.arange(cache.length) < cache.episodes[20][0]
    seen = Recording(cache, start, usable, controls_of(cache))
    happened = Happenings.of(cache, seen.action(slice(None)).numpy(), usable)
    torch.manual_seed(0)
    outcome = FrameOutcome(happened.config())
    run = Run(tmp_path_factory.mktemp("run"), {}, quiet)
    learn_outcome(run, OutcomeObjective(outcome, seen.rgb, happened, batch=6, learning_rate=5e-3), 300)
    return cache, seen, happened, outcome


@torch.inference_mode()
def examine_outcome(outcome: FrameOutcome, rgb, happened: Happenings, first: int, stop: int) -> dict[str, np.ndarray]:
    """Follows the recorded frames of rows first..stop: predicted reward, done (probability) and vitals' change, one row
    for each recorded step."""
    found: dict[str, list] = {"reward": [], "done": [], "change": []}
    hidden = outcome.begin(1)
    for row in range(first, stop - 1):
        frames = rgb(np.array([row, row + 1]))
        vitals = torch.from_numpy(happened.vitals[row : row + 1])
        predicted = outcome(
            frames[:1], frames[1:], torch.from_numpy(happened.action[row : row + 1]).float(), vitals, hidden
        )
        hidden = predicted.hidden
        found["reward"].append(float(predicted.reward))
        found["done"].append(float(torch.sigmoid(predicted.done)))
        found["change"].append((predicted.vitals - vitals)[0].numpy())
    return {name: np.array(values) for name, values in found.items()}


def test_levels_and_shares_are_those_of_the_recording(learned):
    _, seen, happened, outcome = learned
    assert outcome.config.rewards == (0.0, 2.0) and outcome.config.vitals == ("lives",)
    assert outcome.config.changes == ((-1.0, 0.0),) and seen.controls.numbers == 3
    among = torch.tensor([-1.0, 0.0, 4.0])
    values = torch.tensor([-9.0, -0.25, 3.0, 4.0])
    shares = two_hot(values, among)
    assert torch.allclose(shares.sum(1), torch.ones(4))
    assert torch.allclose(shares @ among, torch.tensor([-1.0, -0.25, 3.0, 4.0]))
    many = levels(np.random.default_rng(0).normal(size=5000))
    assert len(many) <= 33 and list(many) == sorted(set(many))


def test_the_numbers_of_a_vector_are_predicted_beside_the_vitals(learned):
    cache, seen, happened, _ = learned
    both = Happenings.of(cache, seen.action(slice(None)).numpy(), seen.usable, {"place": cache.further["place"]})
    assert both.names == ("lives", "place", "place") and happened.names == ("lives",)
    assert np.array_equal(both.vitals[:, 2], 2 * both.vitals[:, 1]) and both.vitals[:, 1].max() == 5
    config = both.config()
    assert config.changes == ((-1.0, 0.0),) and config.sizes[1] == pytest.approx(2 * config.sizes[0])
    outcome = FrameOutcome(config)
    assert list(outcome.draws) == [CHANGES], "what is regressed is not drawn"
    assert outcome.channels().shows["place"].shape == (2,) and outcome.channels().shows["lives"].shape == ()
    assert outcome.channels().may_observe == ("lives", "place") and outcome.vectors == ("place",)
    begun = Evidence(3, torch.device("cpu"))
    place = torch.tensor([[1.0, 2.0], [3.0, 6.0], [0.0, 0.0]])
    state = State(outcome.observe(None, begun, {"place": place}))
    assert torch.equal(outcome.render(state, ("place",))["place"], place)
    assert torch.equal(outcome.render(state, ("lives",))["lives"], torch.zeros(3))
    with pytest.raises(ObservationError, match=re.escape("place is finite float [3, 2]; got (3,)")):
        outcome.observe(None, begun, {"place": place[:, 0]})


def test_vectors_are_read_off_episodes_that_it_never_saw(learned, tmp_path):
    cache, seen, _, _ = learned
    both = Happenings.of(cache, seen.action(slice(None)).numpy(), seen.usable, {"place": cache.further["place"]})
    torch.manual_seed(0)
    outcome = FrameOutcome(both.config())
    learn_outcome(Run(tmp_path, {}, quiet), OutcomeObjective(outcome, seen.rgb, both, 6, 5e-3), 120)
    first, stop = list(cache.episodes)[21]
    found = examine_outcome(outcome, seen.rgb, both, first, stop)["change"]
    right = np.diff(both.vitals[first:stop], axis=0)
    assert np.square(found - right)[:, 1:].mean() < 0.1 * np.square(right)[:, 1:].mean()


def test_a_vital_that_changes_at_ends_alone_has_its_size_after_them(learned):
    _, _, happened, _ = learned
    ended = (happened.real & happened.done).astype(np.float32)[:, None]
    flag = replace(happened, vitals=np.zeros_like(ended), change=7 * ended, names=("collision",))
    outcome = FrameOutcome(flag.config())
    assert flag.config().spans == (7.0,), "not 1e-6, which would make a logit of 4 million of it"
    logit = outcome.ends(torch.zeros(1, outcome.ending.in_features - 2), torch.full((1, 1), 7.0))
    assert logit.abs().item() < 10
    never = replace(flag, change=np.zeros_like(ended))
    assert never.config().spans == (1.0,)


def test_rewards_and_vitals_that_vary_all_the_time_are_no_events(learned):
    _, _, happened, _ = learned
    rewarded = happened.reward != 0
    assert (happened.events() >= (rewarded & happened.real)).all() and rewarded.any()
    varied = replace(happened, reward=np.random.default_rng(0).random(len(happened.real)).astype(np.float32))
    without = replace(happened, reward=np.zeros_like(happened.reward))
    assert np.array_equal(varied.events(), without.events()) and 0 < varied.events().mean() < 0.5
    steady = replace(varied, change=np.random.default_rng(1).random(happened.change.shape).astype(np.float32))
    assert np.array_equal(steady.events(), happened.real & happened.done) and steady.events().any()


@pytest.mark.parametrize("followed", [0.0, 1.0])
def test_clips_go_on_with_vitals_of_their_own_and_learn_to_correct_them(learned, monkeypatch, followed):
    _, seen, happened, _ = learned
    always = replace(happened.config(), changes=((-1.0, 0.0),))
    outcome = FrameOutcome(always)
    outcome.changed[0].weight = torch.nn.Parameter(torch.zeros_like(torch.as_tensor(outcome.changed[0].weight)))
    outcome.changed[0].bias = torch.nn.Parameter(torch.tensor([50.0, -50.0]))  # a life is lost at every step
    steady = replace(happened, change=np.zeros_like(happened.change), vitals=np.full_like(happened.vitals, 3.0))
    targets, judged = [], []

    def ends(known, vitals):
        judged.append(vitals[:, 0].tolist())
        return known[:, 0]

    def noted(config, predicted, ends, reward, done, change):
        targets.append(change[:, 0])
        return ends

    monkeypatch.setattr(outcome, "ends", ends)
    monkeypatch.setattr("terrella.learn.objectives.outcome.FOLLOWED", followed)
    monkeypatch.setattr("terrella.learn.objectives.outcome.negative_log_likelihood", noted)
    objective = OutcomeObjective(outcome, seen.rgb, steady, batch=2)
    now = TrainStep(0, 0.0, torch.device("cpu"), np.random.default_rng(0), make_rng(0))
    list(objective.losses(objective.sample(now, 2), now))
    assert [change.tolist() for change in targets] == [[followed * step] * 2 for step in range(len(targets))]
    assert judged == [[3 - followed * (step + 1)] * 2 for step in range(len(targets))], "ends are judged by them, too"


@pytest.mark.slow
def test_reward_end_and_lives_are_read_off_episodes_that_it_never_saw(learned):
    cache, seen, happened, outcome = learned
    for first, stop in list(cache.episodes)[20:]:
        found = examine_outcome(outcome, seen.rgb, happened, first, stop)
        steps = slice(first, stop - 1)
        assert np.abs(found["reward"] - cache.reward[steps]).max() < 0.5
        lives = np.asarray(cache.arrays["observation.lives"]).reshape(-1)
        assert np.array_equal(found["change"][:, 0], np.diff(lives[first:stop]))
        assert ((found["done"] > 0.5) == cache.done[steps]).all()


@pytest.mark.slow
def test_a_history_world_is_trained_on_a_choice_with_its_outcome(recording, tmp_path):
    config = TrainConfig(
        size=SIZE,
        steps=4,
        batch=2,
        outcome_steps=8,
        uncertainty_frames=0,
        strip_every_s=1e9,
        channels=(8, 8, 8),
        predict=("place", "lives", "place"),
    )
    train_video(recording, tmp_path, config, quiet)
    world = load_world(tmp_path / "world")
    assert world.spec.action == spaces.Discrete(3) and world.spec.action_names == ("STAY", "L", "R")
    assert {"reward", "done", "lives"} <= set(world.spec.channels)
    assert settings_of(world).predict == ("place",), "a student or an adapted world predicts it, too"
    assert world.outcome.config.changes == ((-1.0, 0.0),), "a count stays whole, whatever --predict says"
    assert "states_can_be_saved" in check_world(world)
    state = world.start(16, make_rng(0))
    began, place = (world.render(state, (name,))[name] for name in ("lives", "place"))
    assert place.shape == (16, 2) and torch.equal(place[:, 1], 2 * place[:, 0]) and len(set(place[:, 0].tolist())) > 1
    assert set(began.tolist()) <= {1.0, 2.0, 3.0} and len(set(began.tolist())) > 1, "a story begins with its own lives"


def test_a_vector_that_no_recording_has_is_refused(recording, tmp_path):
    with pytest.raises(DatasetError, match="no vector hand, drifted; it has lives, place"):
        train_video(recording, tmp_path, TrainConfig(size=SIZE, predict=("hand", "place", "drifted")), quiet)
    with pytest.raises(TrainingError, match="add --no-geometry"):
        vectors_to_predict(Recording.open(recording, SIZE, quiet), ("place",), VideoConfig((1.0, 1.0, 0.5, 0.5), 3))


def test_the_state_of_a_gymnasium_environment_is_a_vector_too(tmp_path):
    layout = layout_of(15.0, ("action_0",), rgb=SIZE, vectors={"state": 3}, world=FACTS)
    with Recorder(tmp_path / "set", layout) as recorder:
        for row in range(80):
            recorder.add({"rgb": picture(row % 6), "state": np.full(3, row, np.float32)}, np.array([1]), 0.0, False)
        recorder.end_episode()
    video = VideoConfig((1.0, 1.0, 0.5, 0.5), 3, SIZE, geometry=False)
    vectors = vectors_to_predict(Recording.open(tmp_path / "set", SIZE, quiet), ("state",), video)
    assert {name: array.shape[1] for name, array in vectors.items()} == {"state": 3}


def test_a_dream_pays_costs_lives_and_ends(learned):
    _, seen, _, outcome = learned
    config = VideoConfig((1.0, 1.0, 0.5, 0.5), 3, SIZE, (8, 8, 8), slots=4, geometry=False)
    starts = replace(StartClips.of(torch.zeros(1, 4, 3, *SIZE, dtype=torch.uint8), 3), vitals=torch.full((1, 1), 3.0))
    parts = {"scene": FrameHistory(config.frames, starts), "generator": UNet(config.generator), "outcome": outcome}
    world, rng = LearnedWorld(About("row", seen.controls, 1 / 15), **parts), make_rng(0)
    before, after = (torch.from_numpy(np.stack([picture(place) for place in pair])) for pair in ((1, 4), (0, 5)))
    state = world.observe({"rgb": before, "lives": torch.tensor([1.0, 3.0])}, None, rng)
    numbers = world.controls.encode(torch.tensor([1, 2]))
    drawn = world.observe({"rgb": after, "lives": torch.tensor([1.0, 3.0])}, state, rng)  # as if it had been dreamt
    nobody, seeds = torch.zeros(2, dtype=torch.bool), torch.zeros(2, dtype=torch.int64)
    then = drawn.replace(
        **world.outcome.step(state, drawn, lambda: nobody, numbers, chance.uniforms(seeds, world.outcome.draws))
    )
    assert then["vitals"][:, 0].tolist() == [0.0, 3.0] and then["done"].tolist() == [True, False]
    assert then["reward"][1] > 1.5 and then["reward"][0] < 0.5
    still = world.imagine(then, torch.tensor([2, 2]), rng)
    assert torch.equal(still.at(0)["frames"], then.at(0)["frames"]) and float(still["reward"][0]) == 0
    assert not torch.equal(still.at(1)["frames"], then.at(1)["frames"])
