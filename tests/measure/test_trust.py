"""The trust horizon: forecast from a world's own uncertainty, measured by the truth, and where planners and practice stop."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from gymnasium import spaces

from terrella.act.planning import Planner, SearchConfig, within_measured_trust
from terrella.act.policies_by_name import NoisyPolicy, policy_of
from terrella.core import Spec, State, make_rng
from terrella.core.spec import chance_error, measured_trust, trust_level
from terrella.learn.recipes.policy import Practice
from terrella.measure.clips import Clip
from terrella.measure.exam import CLIPS, Exam, ExamConfig
from terrella.measure.examine import examine
from terrella.measure.trust import TRUST, forecast_trust, steps_within, trust_figures
from terrella.workflows.trust import practice_within_trust, search_within_trust, trusted_searches

CARD = {"uncertainty": {"ceiling": 0.4}}


class Fading:
    """Grey pictures that become brighter by `off` a step, where the truth stays black; it expects an error of `expects` a step."""

    def __init__(self, off: float = 0.01, expects: float = 0.01, card: dict = CARD):
        self.off, self.expects = off, expects
        unit = spaces.Box(0, 1, (), np.float32)
        shows = {"rgb": spaces.Box(0, 255, (4, 4, 3), np.uint8), "uncertainty": unit, "reward": unit}
        self.spec = Spec("fading", spaces.Discrete(2), shows, ("rgb",), 0.1, card=card, idle=(0,))

    def start(self, batch, rng):
        return State({"step": torch.zeros(batch)})

    def observe(self, observation, prior, rng):
        return self.start(len(observation["rgb"]), rng)

    def imagine(self, state, action, rng):
        return state.replace(step=state["step"] + 1)

    def render(self, state, channels):
        grey = (255 * self.off * state["step"]).round().to(torch.uint8).view(-1, 1, 1, 1).expand(-1, 4, 4, 3)
        every = {"rgb": grey, "uncertainty": self.expects * state["step"], "reward": torch.zeros(state.batch)}
        return {name: every[name] for name in channels}


def test_the_level_is_half_way_to_chance():
    assert trust_level(0.1, 0.5) == pytest.approx(0.3)
    assert trust_level(0.6, 0.5) == 0.6, "a first step worse than chance is not trusted"
    assert chance_error(Fading().spec) == 0.4
    assert math.isnan(chance_error(Fading(card={}).spec)) and math.isnan(
        chance_error(Fading(card={"uncertainty": 3}).spec)
    )
    spec = Fading().spec
    latent = replace(spec, card={}, channels={**spec.channels, "latent": spaces.Box(-1, 1, (2,))})
    assert chance_error(latent) == math.sqrt(2)
    assert steps_within(torch.tensor([0.1, 0.2, 0.3, 0.4]), 0.25) == 2 and steps_within(torch.zeros(3), 0.25) == 3
    assert steps_within(torch.tensor([0.1, 0.3, 0.1, 0.1, 0.4, 0.2, 0.4]), 0.25) == 4, (
        "one step that is worse by chance"
    )


class Ending(Fading):
    """Rollouts end after `last` steps, but for every third; after an end it expects an error of 1."""

    last = 30

    def imagine(self, state, action, rng):
        step = state["step"] + 1
        return State({"step": step, "done": (step >= self.last) & (state["which"] > 0), "which": state["which"]})

    def start(self, batch, rng):
        return State({"step": torch.zeros(batch), "which": torch.arange(batch) % 3})

    def render(self, state, channels):
        over = (state["step"] > self.last) & (state["which"] > 0)
        seen = {**super().render(state, channels), "uncertainty": torch.where(over, 1.0, 0.001 * state["step"])}
        return {name: seen[name] for name in channels}


def test_steps_after_a_predicted_end_do_not_count():
    starts = Ending().start(6, make_rng(0))
    for state, steps in ((starts, 50), (starts.at([1, 2]), 30)):
        forecast = forecast_trust(Ending(), 50, state)
        assert forecast is not None and (forecast.steps, forecast.ends) == (50, False)
        assert len(forecast.expected) == steps and max(forecast.expected) == pytest.approx(0.001 * steps)


def test_where_all_end_at_once_nothing_speaks_against_more_steps():
    world = Ending()
    world.last = 1
    forecast = forecast_trust(world, 50, world.start(6, make_rng(0)).at([1, 2]))
    assert forecast is not None and (forecast.steps, len(forecast.expected)) == (50, 1)


def test_the_forecast_is_where_the_expected_error_reaches_the_level():
    found = forecast_trust(Fading(), 50)
    assert found is not None and found.level == pytest.approx(0.205) and found.steps == 20 and found.ends
    short = forecast_trust(Fading(), 5)
    assert short is not None and (short.steps, short.ends) == (5, False)
    other = forecast_trust(Fading(), 50, Fading().start(3, make_rng(0)))
    assert other is not None and other.steps == 20
    measured = forecast_trust(Fading(card={**CARD, "trust_steps_measured": 12}), 50)
    assert measured is not None and (measured.steps, measured.measured) == (12, True), "no more than was measured"
    longer = forecast_trust(Fading(card={**CARD, "trust_steps_measured": 30}), 50)
    assert longer is not None and (longer.steps, longer.measured) == (20, False)
    assert forecast_trust(Fading(card={}), 50) is None, "it cannot say how far off chance is"
    assert forecast_trust(Fading(expects=0.0), 50) is None, "as a latent world of one member"


def test_planners_and_practice_stop_there_and_say_so():
    said: list[str] = []
    search = SearchConfig(replan=40).filled(horizon=40)
    cut = search_within_trust(Fading(), search, said.append)
    assert (cut.horizon, cut.replan) == (20, 20) and "not trusted beyond 20 of 40 steps" in said[0]
    assert search_within_trust(Fading(), SearchConfig(block=4).filled(), said.append).horizon == 5
    practice = practice_within_trust(Fading(), Practice(horizon=40), said.append)
    assert practice.horizon == 20 and "rollouts end there" in said[-1]
    count = len(said)
    assert search_within_trust(Fading(), replace(search, trust=0.3), said.append).horizon == 40, "somebody set a limit"
    assert practice_within_trust(Fading(), Practice(trust=0.3), said.append).horizon is None
    assert practice_within_trust(Fading(), Practice(horizon=5), said.append).horizon == 5
    assert search_within_trust(Fading(card={}), search, said.append) == search, "a world that cannot say"
    assert len(said) == count


def test_plans_in_a_latent_world_go_on_and_it_is_said():
    said: list[str] = []
    world = Fading(card={**CARD, "trust_steps_measured": 12})
    world.spec = replace(world.spec, channels={**world.spec.channels, "latent": spaces.Box(-1, 1, (2,))})
    search = SearchConfig().filled(horizon=400)
    assert search_within_trust(world, search, said.append) == search == within_measured_trust(world, search)
    assert "not trusted beyond 12 of 400 steps" in said[0] and "Its plans go on; --trust" in said[0]
    policy = policy_of("plan:horizon=40", world.spec, world)
    assert isinstance(policy, Planner) and policy.config.horizon == 40 and policy.config.trust is None
    practice = practice_within_trust(world, Practice(horizon=40), said.append)
    assert practice.horizon == 12 and "rollouts end there" in said[1]  # a critic's value stands for what follows


def test_a_planner_by_its_name_stops_there_too():
    card = {"uncertainty": {"ceiling": 0.4, "invents": 0.3}, "trust_steps_measured": 12}
    said: list[str] = []
    for name, within, moves in (
        ("plan:horizon=40", within_measured_trust, 12),
        ("plan:horizon=40,replan=40@0.1", within_measured_trust, 12),
        ("plan:horizon=40,trust=0.2", within_measured_trust, 40),
        ("plan:horizon=40,block=5", trusted_searches(said.append), 2),
    ):
        world = Fading(card=card)
        policy = policy_of(name, world.spec, world, within=within)
        planner = policy.policy if isinstance(policy, NoisyPolicy) else policy
        assert isinstance(planner, Planner)
        assert planner.config.horizon == moves and planner.config.replan <= moves, name
        assert planner.config.trust == (0.2 if "trust" in name else 0.3), "the threshold of the world's card"
    assert len(said) == 1 and "not trusted beyond 12 of 200 steps" in said[0]
    unmeasured = Fading(card=CARD)
    within = trusted_searches(said.append)
    for _ in range(2):
        policy = policy_of("plan:horizon=40", unmeasured.spec, unmeasured, within=within)
        assert isinstance(policy, Planner) and policy.config.horizon == 20, "forecast"
    assert len(said) == 2, "said once"


def black(steps: int) -> Clip:
    return Clip({"rgb": np.zeros((steps, 4, 4, 3), np.uint8)}, np.zeros(steps, np.int64), 2, 0, 0)


@pytest.mark.parametrize("off, steps", [(0.01, 20), (0.02, 10), (0.001, 30)])
def test_the_scorecard_has_the_forecast_beside_the_measured_horizon(off, steps):
    config = ExamConfig(horizons=(30,), control_horizons=(), long_steps=0, still_steps=0, speed_steps=0)
    card = examine(Exam({"a": Fading(off)}, {CLIPS: {"recorded": [black(32)] * 2}}, config), probes=(TRUST,))
    (forecast,), (measured,) = (card.find("trust", f"trust horizon, {what}") for what in ("forecast", "measured"))
    assert (forecast.figure.value, measured.figure.value) == (20, steps)
    assert (measured.figure.low, measured.figure.high, measured.figure.count) == (steps, steps, 2)
    assert ("not reached" in measured.note) == (steps == 30)
    ratio = [row.figure.value for row in card.find("trust", "trust horizon, measured over forecast")]
    assert ratio == ([] if steps == 30 else [steps / 20])


def test_the_scorecard_forecasts_no_longer_than_the_world_was_measured_to_be_trusted():
    world = Fading(0.02, card={**CARD, "trust_steps_measured": 12})
    config = ExamConfig(horizons=(30,), control_horizons=(), long_steps=0, still_steps=0, speed_steps=0)
    card = examine(Exam({"a": world}, {CLIPS: {"recorded": [black(32)] * 2}}, config), probes=(TRUST,))
    (forecast,), (measured,) = (card.find("trust", f"trust horizon, {what}") for what in ("forecast", "measured"))
    assert (forecast.figure.value, measured.figure.value) == (12, 10) and "of the world's card" in forecast.note
    (ratio,) = card.find("trust", "trust horizon, measured over forecast")
    assert ratio.figure.value == 10 / 12
    assert measured_trust(replace(world.spec, card={"trust_steps_measured": "9"})) is None, "a stranger's card"


def test_the_horizon_has_an_interval_over_clips():
    """Half of the rollouts are lost at step 10 and half never: the mean error crosses the level where more than half are lost."""
    lost = torch.zeros(8, 30, dtype=torch.float64)
    lost[:5, 10:] = 0.4
    expected = torch.linspace(0, 0.4, 30).expand(8, 30)
    figures = {what: figure for what, (figure, _) in trust_figures(expected, lost, 0.4).items()}
    measured, ratio = figures["measured"], figures["measured over forecast"]
    assert (measured.value, measured.low, measured.high) == (10, 10, 30)
    assert figures["forecast"].low == figures["forecast"].high == 15
    assert (ratio.value, ratio.high) == (pytest.approx(10 / 15), 2)
    assert trust_figures(expected, lost[:5].repeat(2, 1)[:8], 0.4)["measured"][0].high == 10


def test_a_world_that_expects_no_error_is_named_with_what_it_lacks():
    config = ExamConfig(horizons=(30,), control_horizons=(), long_steps=0, still_steps=0, speed_steps=0)
    card = examine(Exam({"a": Fading(card={})}, {CLIPS: {"recorded": [black(32)] * 2}}, config), probes=(TRUST,))
    assert not card.rows and "needs uncertainty" in card.missing[0].why
