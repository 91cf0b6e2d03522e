"""Judging in a dream and in reality: the same starts for all, the same twice, and a control that only habits help."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from gymnasium import spaces
from tests.act.tiny_worlds import Point

from terrella.act.paired_evaluation import PERSISTENCE, UNCERTAINTY, LoopedActions, PairedEvaluation, check_finite
from terrella.act.planning import PlayedEpisode, SuccessCriterion
from terrella.act.policies_by_name import NoisyPolicy, policy_of
from terrella.core.errors import PlanningError, TerrellaError
from terrella.core.policy import Reactive
from terrella.core.spec import REWARD, Spec
from terrella.core.state import State
from terrella.core.world import make_rng


class Off(Point):
    """A dream of it in which all goes a tenth too far."""

    def imagine(self, state, action, rng):
        return State({"at": super().imagine(state, action, rng)["at"] + 0.1 * action})


class Guess:
    """Shows a bit; pays 1 for an action that is the same; the next bit is drawn by chance."""

    def __init__(self):
        channels = {"observation": spaces.Box(0, 1, (1,), np.float32), "reward": REWARD}
        self.spec = Spec("guess", spaces.Discrete(2), channels, ("observation",), 0.1)

    def start(self, batch, rng):
        bits = torch.cat([torch.randint(2, (1,), generator=rng) for _ in range(batch)])
        return State({"bit": bits, "reward": torch.zeros(batch)})

    def observe(self, observation, prior, rng):
        return State(
            {"bit": observation["observation"][:, 0].long(), "reward": torch.zeros(len(observation["observation"]))}
        )

    def imagine(self, state, action, rng):
        return self.start(state.batch, rng).replace(reward=(action == state["bit"]).float())

    def render(self, state, channels):
        shown = {"observation": state["bit"].float()[:, None], "reward": state["reward"]}
        return {name: shown[name] for name in channels}


def homing(seen, rng):
    return (-seen["observation"]).clamp(-1, 1)


def test_all_begin_where_reality_did_and_the_same_again():
    bench, spec = PairedEvaluation(Off(), Point(), SuccessCriterion(), 6, 3, ("observation",)), Point().spec
    starts = bench.starts(1, 5)
    real = torch.cat([state["at"] for state in bench._real_states(starts)])
    dream = torch.cat([state["at"] for state in bench._dream_states(starts)])
    assert torch.equal(real, dream) and len(real.unique(dim=0)) == 5
    assert torch.equal(
        real, PairedEvaluation(Off(), Point(), SuccessCriterion(), 9, 3).starts(1, 5).seen["observation"]
    )
    one, other = (
        bench.play(lambda name=name: policy_of(name, spec), spec, 1, 5) for name in ("constant:1,1", "random")
    )
    again = PairedEvaluation(Off(), Point(), SuccessCriterion(), 6, 3).play(
        lambda: policy_of("random", spec), spec, 1, 5
    )
    for arm in ("real", "dream", "control"):
        assert [one.reward for one in getattr(other, arm)] == [one.reward for one in getattr(again, arm)]
    assert one.real[0].reward != one.dream[0].reward
    for mine, theirs in zip(other.real, other.dream):  # chance is the same in both
        assert all(torch.equal(a, b) for a, b in zip(mine.actions, theirs.actions))


def test_the_error_grows_as_it_must_and_uncertainty_is_told():
    spec = Point().spec
    bench = PairedEvaluation(Off(), Point(), SuccessCriterion(), 4, 0, ("observation",))
    found = bench.play(lambda: policy_of("constant:0.5,0.5", spec), spec, 0, 3).open_loop_errors
    expected = torch.arange(5) * 0.05 / 20  # in shares of the range
    assert torch.allclose(found["observation"], expected.expand(3, 5), atol=1e-5)
    held = torch.arange(5) * 0.5 / 20
    assert torch.allclose(found["observation" + PERSISTENCE], held.expand(3, 5), atol=1e-5)
    assert found[UNCERTAINTY].shape == (3, 5)


def test_a_world_alone_and_starts_that_are_not_solved():
    judge = SuccessCriterion({"observation": torch.zeros(1, 2)}, within=0.1)
    bench = PairedEvaluation(Point(), None, judge, 12, 0)
    found = bench.play(lambda: Reactive(homing), Point().spec, 0, 30)
    assert not found.real and found.skipped > 0 and all(one.success for one in found.dream)
    assert min(one.steps for one in found.dream) > 0
    with pytest.raises(PlanningError, match="already solved"):
        PairedEvaluation(Point(), None, SuccessCriterion(judge.goal, within=5), 12, 0).starts(0, 1)


def test_the_control_knows_habits_and_nothing_else():
    spec, means = Guess().spec, []
    right = Reactive(lambda seen, rng: seen["observation"][:, 0].long())
    for share in (0.0, 0.4, 0.8):
        chunk = PairedEvaluation(Guess(), Guess(), SuccessCriterion(), 100, 0).play(
            lambda p=share: NoisyPolicy(right, p, spec), spec, 0, 20
        )
        arms = chunk.real, chunk.dream, chunk.control
        means.append([sum(one.reward for one in arm) / 2000 for arm in arms])
    real, dream, control = zip(*means)
    assert real[0] == dream[0] == 1 and list(dream) == sorted(dream, reverse=True)
    assert all(abs(a - b) < 0.05 for a, b in zip(real, dream))
    assert all(abs(one - 0.5) < 0.05 for one in control)


def test_an_echo_begins_again_where_it_ends():
    echo, rng = LoopedActions([torch.tensor([1, 2]), torch.tensor([3])]), make_rng(0)
    memory, heard = echo.begin(2, rng), []
    for _ in range(3):
        action, memory = echo.act({}, memory, rng)
        heard.append(action.tolist())
    assert heard == [[1, 3], [2, 3], [1, 3]]
    assert echo.act({}, memory[1:], rng)[0].tolist() == [3]


def test_a_return_that_is_no_number_is_said():
    with pytest.raises(TerrellaError, match="of mine in the dream is not finite in 1 of 2"):
        check_finite("mine", "the dream", [PlayedEpisode(reward=1.0), PlayedEpisode(reward=math.nan)])


def test_a_dream_of_few_at_once_follows_as_many():
    dream = Off()
    dream.spec = dataclasses.replace(dream.spec, max_batch=4)
    bench, spec = PairedEvaluation(dream, Point(), SuccessCriterion(), 6, 3, ("observation",)), Point().spec
    chunk = bench.play(lambda: policy_of("random", spec), spec, 0, 10)
    assert len(chunk.dream) == len(chunk.real) == 10
