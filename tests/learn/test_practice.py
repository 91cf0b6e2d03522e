"""Practice in imagination: laws of returns and critic, policies that find the way in toy worlds, runs that go on exactly."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from gymnasium import spaces
from tests.act.tiny_worlds import Grid, Point, Recalls
from tests.learn.stopping import goes_on_exactly, quiet

from terrella.act.actor import Actor
from terrella.act.actor_network import ActorConfig
from terrella.core.errors import ActionError, ChannelError, ObservationError, TrainingError
from terrella.core.policy import Idle
from terrella.core.rollouts import rollout
from terrella.core.state import State
from terrella.core.world import make_rng
from terrella.learn.imagination import ContinuedEpisodes, RecordedStarts
from terrella.learn.objectives.actor_critic import Critic, Range, ReturnConfig, lambda_returns, step_weights
from terrella.learn.objectives.outcome import two_hot
from terrella.learn.recipes.policy import Practice, train_policy
from terrella.learn.train_step import TrainStep

QUICK = Practice(steps=80, batch=64, horizon=5, hidden=32, learning_rate=1e-2, save_every_s=1e9)


def now(step: int = 0) -> TrainStep:
    import numpy as np

    return TrainStep(step, 0.0, torch.device("cpu"), np.random.default_rng([0, step]), make_rng(step))


def slowly(reward, continues, value, known, wanted):
    """Lambda-returns as they are defined: n-step returns, mixed; a step after which nothing is known ends all of them."""
    steps, batch = reward.shape
    found = torch.zeros(steps, batch, dtype=reward.dtype)
    for entry in range(batch):
        for start in range(steps):
            last = next((t for t in range(start, steps) if not known[t, entry]), steps - 1)
            n_step = []
            for end in range(start, last + 1):
                total, share = 0.0, 1.0
                for t in range(start, end + 1):
                    total += share * reward[t, entry]
                    share *= wanted.discount * continues[t, entry]
                n_step.append(total + share * value[end + 1, entry])
            mix = wanted.td_lambda
            whole = sum((1 - mix) * mix**n * part for n, part in enumerate(n_step[:-1]))
            found[start, entry] = whole + mix ** (len(n_step) - 1) * n_step[-1]
    return found


def paid(world, state, policy, steps: int) -> float:
    seen = rollout(world, state, policy, make_rng(0), ("observation", "reward"), steps).observations
    return float(seen["reward"].sum())


@pytest.mark.parametrize("td_lambda", [0.0, 0.7, 1.0])
def test_lambda_returns_are_what_they_are_defined_to_be(td_lambda: float) -> None:
    rng = make_rng(0)
    reward, value = (torch.randn(n, 6, generator=rng, dtype=torch.float64) for n in (7, 8))
    continues = torch.rand(7, 6, generator=rng, dtype=torch.float64)
    continues[3, 2] = 0.0
    known = torch.rand(7, 6, generator=rng) > 0.2
    wanted = ReturnConfig(0.9, td_lambda)
    fast = lambda_returns(reward, continues, value, known, wanted)
    torch.testing.assert_close(fast, slowly(reward, continues, value, known, wanted))


def test_the_cautious_count_the_unknown_as_the_worst_that_is_expected_anywhere() -> None:
    reward, continues = torch.zeros(3, 2), torch.ones(3, 2)
    value = torch.tensor([[5.0, 4.0], [5.0, 4.0], [90.0, 4.0], [90.0, 4.0]])
    known = torch.tensor([[True, True], [False, True], [False, True]])
    plain, cautious = (
        lambda_returns(reward, continues, value, known, ReturnConfig(0.5, 1.0, cautious=said)) for said in (False, True)
    )
    assert plain[:2, 0].tolist() == [22.5, 45.0] and cautious[:2, 0].tolist() == [1.0, 2.0]
    assert torch.equal(plain[:, 1], cautious[:, 1])


def test_what_comes_after_an_end_or_the_unknown_counts_for_nothing() -> None:
    continues = torch.tensor([[1.0, 1.0, 0.5], [0.0, 1.0, 1.0], [1.0, 1.0, 1.0]])
    known = torch.tensor([[True, False, True], [True, True, True], [True, True, True]])
    assert step_weights(continues, known).tolist() == [[1, 1, 1], [1, 0, 0.5], [0, 0, 0.5]]


def test_the_critic_says_back_what_it_is_told() -> None:
    critic = Critic(ActorConfig.of(Point().spec, ("observation",), hidden=8))
    values = torch.tensor([-2e4, -150.0, -1.0, -0.01, 0.0, 0.3, 7.0, 900.0])
    shares = two_hot(values, critic.bins)
    assert (shares > 0).sum(1).max() <= 2
    critic.forward = lambda seen: (shares + 1e-30).log()  # what a perfect critic would say
    torch.testing.assert_close(critic.value({}), values, rtol=1e-4, atol=1e-4)


def test_a_critic_that_knows_nothing_says_nothing() -> None:
    critic = Critic(ActorConfig.of(Point().spec, ("observation",), hidden=8))
    assert torch.equal(critic.value({"observation": torch.randn(5, 2)}), torch.zeros(5))


def test_the_range_of_returns_is_never_below_one() -> None:
    narrow, wide = Range(), Range()
    assert float(narrow.update(torch.linspace(0, 0.1, 101))) == 1.0
    assert float(wide.update(torch.linspace(0, 1000, 101))) == pytest.approx(900)


@pytest.mark.parametrize("gradients", [True, False])
def test_it_finds_the_middle_of_the_plane(gradients: bool, tmp_path) -> None:
    world = Point()
    facts = train_policy(world, "point", tmp_path, replace(QUICK, gradients=gradients), quiet)
    actor = Actor.load(facts["policy"], world.spec)
    corners = torch.tensor([[4.0, 4.0], [4.0, -4.0], [-4.0, 4.0], [-4.0, -4.0]])
    action, _ = actor.act({"observation": corners}, None, make_rng(0))
    assert (action.sign() == -corners.sign()).all()
    mine, idle = (paid(world, State({"at": corners}), one, 10) for one in (actor, Idle(world.spec)))
    assert mine > 0.6 * idle  # both are below 0


def test_choices_are_learned_from_what_pays(tmp_path) -> None:
    class Inward(Grid):
        def start(self, batch, rng):
            return State({"at": torch.randint(0, 4, (batch, 2), generator=rng) * 2})

    facts = train_policy(Inward(), "grid", tmp_path, QUICK, quiet)
    actor = Actor.load(facts["policy"], Grid().spec)
    begins = State({"at": torch.tensor([[5, 0], [0, 3], [4, 2]])})
    mine, idle = (paid(Grid(), begins, one, 10) for one in (actor, Idle(actor.spec)))
    assert mine > 0.6 * idle  # both are below 0


@pytest.mark.exact
def test_a_stopped_run_goes_on_exactly(tmp_path) -> None:
    config = replace(QUICK, steps=16, batch=8, hidden=8)
    for name, world in (("point", Point()), ("grid", Grid()), ("recalls", Recalls())):
        goes_on_exactly(
            lambda out, world=world: train_policy(world, "toy", out, config, quiet),
            tmp_path / name / "whole",
            tmp_path / name / "cut",
            {"practice": 7},
        )
        one, other = (
            Actor.load(tmp_path / name / which, world.spec).network.state_dict() for which in ("whole", "cut")
        )
        assert all(torch.equal(one[key], other[key]) for key in one)


def test_episodes_go_on_from_batch_to_batch_and_begin_anew_when_they_are_long() -> None:
    world = Point()
    starts = ContinuedEpisodes(world, 4, 6, 0)
    starts.held.age[:] = torch.tensor([0, 2, 4, 6])
    first = starts.begin(now())
    moved = world.imagine(first, torch.ones(4, 2), make_rng(0))
    starts.end(moved, 2, now())
    again = starts.begin(now(1))
    kept = [bool(torch.equal(again["at"][n], moved["at"][n])) for n in range(4)]
    assert kept == [True, True, False, True]


@pytest.mark.parametrize("recorded", [False, True])
def test_practice_goes_on_with_half_of_the_episodes_where_memory_is_out(recorded, tmp_path, monkeypatch) -> None:
    settings = replace(QUICK, steps=3, batch=16)
    if recorded:
        world = Point()
        begun = RecordedStarts(world, world.start(32, make_rng(0)), 16)
        monkeypatch.setattr("terrella.learn.recipes.policy._starts", lambda *_: begun)

    class Small(Point):
        def imagine(self, state, action, rng):
            if len(action) > 5:
                raise RuntimeError("CUDA error: CUBLAS_STATUS_ALLOC_FAILED when calling `cublasCreate(handle)`")
            return super().imagine(state, action, rng)

    monkeypatch.setattr(ContinuedEpisodes, "sample", lambda self, sees: self.world.render(self.held.state(), sees))
    with pytest.warns(UserWarning, match="halved to [84], and training goes on"):
        facts = train_policy(Small(), "point", tmp_path, settings, quiet)
    assert facts["practised_steps"] == 3 * 4 * 5
    again = train_policy(Small(), "point", tmp_path, replace(settings, minutes=1.0), quiet)
    assert again["practised_steps"] == facts["practised_steps"], "the smaller batch is kept"


def test_nothing_but_a_reward_can_be_practised_for(tmp_path) -> None:
    world = Point(channels={name: space for name, space in Point.about["channels"].items() if name != "reward"})
    with pytest.raises(ChannelError, match="no channel 'reward'"):
        train_policy(world, "point", tmp_path, QUICK, quiet)
    ticket = Point()
    ticket.spec = replace(ticket.spec, forkable=False)
    with pytest.raises(ObservationError, match="one episode at a time"):
        train_policy(ticket, "point", tmp_path, QUICK, quiet)


def test_what_does_not_fit_is_refused_in_a_sentence(tmp_path) -> None:
    with pytest.raises(ChannelError, match="cannot render 'depth'"):
        train_policy(Point(), "point", tmp_path, replace(QUICK, sees=("depth",)), quiet)
    for settings in ({"batch": 0}, {"discount": 1.0}, {"minutes": -1.0}):
        with pytest.raises(TrainingError, match="--"):
            train_policy(Point(), "point", tmp_path, replace(QUICK, **settings), quiet)
    (tmp_path / "file").write_text("")
    with pytest.raises(TrainingError, match="cannot be written"):
        train_policy(Point(), "point", tmp_path / "file" / "run", QUICK, quiet)
    few = replace(QUICK, steps=1)
    train_policy(Point(), "point", tmp_path / "run", few, quiet)
    with pytest.raises(TrainingError, match="other settings"):
        train_policy(Point(), "point", tmp_path / "run", replace(few, horizon=6), quiet)
    wider = replace(Point().spec, action=spaces.Box(-2, 2, (2,)))
    with pytest.raises(ActionError, match="for other actions"):
        Actor.load(tmp_path / "run", wider)


def test_a_reward_that_is_no_number_stops_the_practice(tmp_path) -> None:
    class Mad(Point):
        def shown(self, state, name):
            return torch.full((state.batch,), torch.nan) if name == "reward" else super().shown(state, name)

    with pytest.raises(TrainingError, match="not a number"):
        train_policy(Mad(), "mad", tmp_path, QUICK, quiet)
