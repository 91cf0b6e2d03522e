"""`terrella plan` from outside: figures beside a floor, the same twice, a film to look at, and one sentence for bad goals."""

from __future__ import annotations

import json
import shlex
from copy import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from gymnasium import spaces
from tests.cli.tiny import NAME

import terrella
from terrella.act.planning import Planner, episodes
from terrella.act.planning.costs import checked_goal
from terrella.cli import main
from terrella.core import Spec
from terrella.core.errors import ObservationError, TerrellaError
from terrella.data import Dataset
from terrella.sim.randomised import Randomised
from terrella.workflows.collect import open_player
from terrella.workflows.opening import ControlsConfig, EnvironmentConfig
from terrella.workflows.plan_energy import DECISIONS
from terrella.workflows.plan_study import PlanConfig, open_study
from terrella.workflows.progress import silent
from terrella.workflows.real_environment import open_copied, open_real, refuse_randomised

BLIND = NAME.replace("Tiny-v0", "Blind-v0")
QUICK = ["--episodes", "4", "--steps", "24", "--samples", "6", "--iterations", "2", "--horizon", "4", "--json"]


def planned(capsys, *words):
    assert main(["plan", *words]) == 0
    return json.loads(capsys.readouterr().out)


def test_a_goal_is_reached_beside_a_floor_and_the_same_seed_does_the_same(capsys, tmp_path):
    words = [BLIND, "--goal", "observation=20", "--within", "0.001", "--search", "tree", *QUICK]
    one, other = (planned(capsys, *words, "--out", str(tmp_path / name)) for name in "ab")
    assert one["planner"]["success"]["value"] == 1
    assert one["planner"]["steps"]["value"] < one["random"]["steps"]["value"]
    for arm in ("planner", "random"):
        assert one[arm]["success"] == other[arm]["success"] and one[arm]["steps"] == other[arm]["steps"]
    assert [point["with"] for point in one["curve"]] == ["3 plans a round", "6 plans a round"]
    assert one["curve"][0]["imagined"] < one["curve"][1]["imagined"]
    whole = json.loads((tmp_path / "a" / "plan.json").read_text())
    assert len(whole["played"]) == 4 and max(whole["divergence"]["observation"]) < 1e-5 and not whole["film"]
    assert "Does more search help?" in (tmp_path / "a" / "plan.html").read_text()


def test_reality_and_dream_are_filmed(capsys, tmp_path):
    found = planned(capsys, NAME, "--goal", "reward", "--no-curve", *QUICK, "--out", str(tmp_path))
    assert found["curve"] == []
    assert (
        "success" not in found["planner"] and found["planner"]["return"]["value"] >= found["random"]["return"]["value"]
    )
    assert (tmp_path / "plan.mp4").stat().st_size > 500
    assert (
        max(json.loads((tmp_path / "plan.json").read_text())["divergence"]["rgb"]) < 1e-5
    )  # it plans in the game itself


@pytest.mark.parametrize(
    "words, said",
    [
        (["--goal", "1,2,3"], "3 numbers"),
        (["--goal", "99"], "can never be reached"),
        (["--goal", "colour=1"], "cannot render 'colour'"),
        (["--goal", "no-such.png"], "no pictures"),
        (["--goal", "somewhere nice"], "is no goal"),
        (["--goal", "5", "--within", "0"], "--within"),
        (["--goal", "5", "--within", "3"], "already solved"),
        (["--success", "won"], "no channel 'won'"),
        (["--search", "gradient"], "no gradient"),
        (["--real", "gym:CartPole-v1"], "they differ"),
        (["--trust", "0.1"], "uncertainty"),
        (["--samples", "1"], "samples must be 2 or more"),
        (["--agent", "random", "--proposal", "random", "--budget-ms", "5"], "leave --proposal, --budget-ms out"),
        (["--goal", "reward", "--cost", "last"], "leave --cost out"),
        (["--goal", "reward", "--within", "0.1"], "leave --within out"),
        (["--goal", "5", "--success", "done", "--within", "0.1"], "leave --within out"),
        (["--goal", "5", "--apart", "2"], "leave --apart out"),
        (["--real", BLIND, "--randomise", "no-such.toml"], "no-such.toml"),
    ],
)
def test_what_cannot_be_planned_is_said_in_a_sentence(capsys, tmp_path, words, said):
    assert main(["plan", BLIND, *QUICK[:4], "--out", str(tmp_path / "new"), *words]) == 2
    error = capsys.readouterr().err
    assert said in error and "Traceback" not in error
    assert not (tmp_path / "new").exists()


def test_a_goal_that_is_never_reached_is_said_with_the_nearest_and_the_best_cost(capsys, tmp_path):
    words = [BLIND, "--goal", "24", "--within", "0.001", *QUICK[:-1], "--out", str(tmp_path)]
    assert main(["plan", *words]) == 0
    said = capsys.readouterr().out
    assert "Thinking longer is not seen to help" in said
    assert "never reached" in said and "the best plan in the world cost" in said


def test_another_policy_acts_or_proposes_by_its_name(capsys, tmp_path):
    """Steps to the right alone come to the wall: as the agent, and as what a search of two plans tries as well."""
    right = [BLIND, "--goal", "20", "--within", "0.001", *QUICK[:4]]
    acts = planned(capsys, *right, "--agent", "constant:2", "--json", "--out", str(tmp_path / "a"))
    assert acts["planner"]["success"]["value"] == 1 and "samples" in acts and acts["agent"] == "constant:2"
    few = [
        *right,
        "--search",
        "random",
        "--samples",
        "2",
        "--iterations",
        "1",
        "--horizon",
        "12",
        "--seed",
        "3",
        "--json",
    ]
    alone, helped = (
        planned(capsys, *few, *words, "--out", str(tmp_path / str(len(words))))["planner"]["success"]["value"]
        for words in ([], ["--proposal", "constant:2"])
    )
    assert helped == 1 > alone


def test_an_end_that_is_all_that_counts_is_gone_to_before_the_next_plan(capsys, tmp_path):
    words = [BLIND, "--goal", "20", "--within", "0.001", *QUICK]
    assert planned(capsys, *words, "--cost", "last", "--out", str(tmp_path / "a"))["replan"] == 4
    assert planned(capsys, *words, "--cost", "last", "--replan", "2", "--out", str(tmp_path / "b"))["replan"] == 2
    assert planned(capsys, *words, "--out", str(tmp_path / "c"))["replan"] == 1


def test_the_verdict_in_words_is_the_first_line(capsys, tmp_path):
    words = ["plan", BLIND, *QUICK[:4], "--no-curve", "--out", str(tmp_path)]
    assert main([*words, "--goal", "20", "--within", "0.001", "--agent", "random", "--steps", "8"]) == 0
    first, *_, last = capsys.readouterr().out.splitlines()
    assert first == "The policy random is not seen to do better than random actions; more --episodes may tell."
    assert last == f"next: terrella evaluate random --in {BLIND} --goal 20 --within 0.001 --steps 8", (
        "the same, no less"
    )


def test_the_printed_command_evaluates_the_same_search_towards_the_same_goal(capsys, tmp_path):
    goal = ["--goal", "observation=20", "--within", "0.001", "--search", "tree"]
    done = planned(capsys, BLIND, *goal, *QUICK, "--no-curve", "--out", str(tmp_path / "a"))
    program, *words = shlex.split(done["next"])
    assert program == "terrella"
    assert main([*words, "--episodes", "2", "--json", "--out", str(tmp_path / "b")]) == 0
    evaluated = json.loads(capsys.readouterr().out)
    assert (evaluated["goal"], evaluated["within"], evaluated["steps"]) == ("observation=20", 0.001, 24)
    assert "plan:search=tree,samples=6,iterations=2,horizon=4" in evaluated["names"].values()


@pytest.mark.parametrize(
    "watts, whole, samples, iterations, said",
    [
        (2000, 32, 32, 4, ""),
        (640, 32, 16, 4, "searches 16 of 32 plans a round"),
        (40, 32, 2, 2, "searches 2 of 32 plans a round and 2 of 4 rounds"),
        (5, 32, 2, 1, "cannot be kept: it takes 20 W"),
        (40, 3, 3, 1, "searches 1 of 4 rounds"),
    ],
)
def test_a_budget_of_watts_takes_plans_and_then_rounds(watts, whole, samples, iterations, said, monkeypatch, tmp_path):
    """A joule for each plan of a round; at one decision each 0.1 s 32 plans in 4 rounds are 1,280 W."""
    joules = lambda policy, *_: (float(policy.config.samples * policy.config.iterations), None)  # noqa: E731
    monkeypatch.setattr("terrella.workflows.plan_energy._measured", joules)
    search, lines = terrella.SearchConfig(samples=whole, iterations=4, horizon=4), list[str]()
    study = open_study(BLIND, PlanConfig("20", within=0.001, watts=watts, search=search, out=tmp_path), lines.append)
    assert (study.search.samples, study.search.iterations) == (samples, iterations)
    assert said in "".join(lines) and bool(said) == bool(lines)
    assert study.decision is not None and study.decision.kept == ("cannot" not in said)


def test_the_energy_of_a_decision_stands_beside_its_time(capsys, tmp_path):
    found = planned(capsys, BLIND, "--goal", "20", "--no-curve", *QUICK, "--out", str(tmp_path))
    assert found["decision_joules"] > 0 and found["decision_watts"] == pytest.approx(10 * found["decision_joules"])
    assert found["futures_bytes"] > 0 and "watts" not in found


def test_a_budget_of_memory_takes_plans(capsys, tmp_path):
    search = terrella.SearchConfig(samples=32, horizon=4)
    plain = open_study(BLIND, PlanConfig("20", within=0.001, search=search, out=tmp_path), lambda line: None)
    assert plain.decision is not None and plain.decision.future_bytes % 32 == 0
    one = plain.decision.future_bytes // 32
    for futures, samples, said in (
        (40, 32, ""), (10, 10, "searches 10 of 32 plans a round"), (1, 2, "cannot be kept: its futures hold"),
    ):  # fmt: skip
        lines, budget = list[str](), (futures + 0.1) * one / 2**20
        config = PlanConfig("20", within=0.001, memory_mb=budget, search=search, out=tmp_path)
        study = open_study(BLIND, config, lines.append)
        assert study.search.samples == samples and said in "".join(lines) and bool(said) == bool(lines)
        assert study.decision is not None and study.decision.facts()["memory_kept"] == (futures > 1)


@pytest.mark.parametrize(
    "named, extra",
    [
        ("--watts", ["--watts", "0"]),
        ("--watts", ["--watts", "5", "--agent", "random"]),
        ("--memory-mb", ["--memory-mb", "-1"]),
    ],
)
def test_budgets_that_nothing_keeps_are_refused(named, extra, capsys, tmp_path):
    assert main(["plan", BLIND, "--goal", "20", *QUICK, *extra, "--out", str(tmp_path)]) == 2
    assert named in capsys.readouterr().err


@pytest.mark.parametrize("words", [["--cost", "last"], ["--proposal", "constant:2"]])
def test_no_command_is_printed_where_evaluate_has_no_such_search(words, capsys, tmp_path):
    goal = ["--goal", "20", "--within", "0.001"]
    assert "next" not in planned(capsys, BLIND, *goal, *words, *QUICK, "--no-curve", "--out", str(tmp_path))


def test_an_agent_needs_no_reward_where_a_channel_says_what_success_is(tmp_path, monkeypatch):
    def without_reward(name, environment):
        world = copy(open_copied(name, environment))
        shown = {channel: space for channel, space in world.spec.channels.items() if channel != "reward"}
        world.spec = replace(world.spec, channels=shown)
        return world

    monkeypatch.setattr("terrella.workflows.plan_study.open_copied", without_reward)
    config = terrella.PlanConfig(agent="constant:2", success="done", episodes=2, steps=70, out=tmp_path)
    assert open_study(BLIND, config, print).criterion.channel == "done"
    with pytest.raises(TerrellaError, match="no reward"):
        open_study(BLIND, replace(config, agent=None), print)


def test_the_real_environment_is_never_randomised(tmp_path):
    ranges = tmp_path / "ranges.toml"
    ranges.write_text('"body_mass" = {uniform = [0.5, 2.0], scale = true}\n')
    environment = EnvironmentConfig(randomise=str(ranges))
    opened = open_real(BLIND, environment, EnvironmentConfig().open(BLIND).spec)
    assert not isinstance(opened, Randomised)
    with pytest.raises(TerrellaError, match="was learned and is as it is"):
        refuse_randomised("doom-maze", environment)


def test_a_goal_beyond_the_range_of_one_number_names_that_range():
    numbers = spaces.Box(np.array([-np.inf, -2], np.float32), np.array([np.inf, 3], np.float32))
    spec = Spec("two", spaces.Discrete(2), {"state": numbers}, (), 0.1)
    with pytest.raises(ObservationError, match=r"holds 9, outside the range of two there \(-2 to 3\)"):
        checked_goal(spec, {"state": torch.tensor([50.0, 9.0])})


def test_a_plan_that_is_stopped_shows_how_far_it_came_beside_as_many_random_steps(capsys, tmp_path, monkeypatch):
    act, calls = Planner.act, []

    def stopped(planner, *given):
        calls.append(1)
        if len(calls) > 3 + 1 + DECISIONS:  # those whose energy is measured come first
            raise KeyboardInterrupt
        return act(planner, *given)

    monkeypatch.setattr(Planner, "act", stopped)
    words = [BLIND, "--goal", "observation=20", "--within", "0.001", "--search", "tree", *QUICK]
    assert main(["plan", *words, "--out", str(tmp_path)]) == 130
    result, whole = json.loads(capsys.readouterr().out), json.loads((tmp_path / "plan.json").read_text())
    assert result["stopped"] and [one["steps"] for one in whole["played"]].count(3) == 2 and len(whole["played"]) == 4
    assert result["planner"]["success"]["count"] == result["random"]["success"]["count"] == 4
    assert "the first 3 of at most 24 steps" in (tmp_path / "plan.html").read_text()
    calls[:] = [1] * 10
    assert main(["plan", *words, "--out", str(tmp_path / "none")]) == 130
    assert "before the first decision" in capsys.readouterr().err and not (tmp_path / "none").exists()


def test_a_plan_that_plays_one_episode_after_the_other_keeps_those_that_are_done(monkeypatch):
    study = open_study(BLIND, PlanConfig("observation=20", within=0.001, episodes=4, steps=24), silent)
    study = replace(study, real=copy(study.real))
    study.real.spec = replace(study.real.spec, forkable=False)
    played, play_from = [], episodes.play_from

    def stopped(*given):
        played.append(1)
        if len(played) > 2:
            raise KeyboardInterrupt
        return play_from(*given)

    monkeypatch.setattr(episodes, "play_from", stopped)
    done = study.run()
    assert done.stopped and not done.cut and len(done.planner.episodes) == 2 and done.random is None


def test_planning_from_python(tmp_path):
    lines = []
    search = terrella.SearchConfig("tree", samples=6, iterations=2, horizon=4)
    config = terrella.PlanConfig("observation=20", within=0.001, search=search, episodes=2, steps=24, out=tmp_path)
    result = terrella.plan(BLIND, config, progress=lines.append)
    assert isinstance(result, terrella.PlanResult)
    assert result.planner["success"].value == 1 and len(result.episodes) == 2 and result.page.is_file()
    verdict, reached = result.summary().splitlines()[:2]
    assert (
        verdict.startswith("Planning in this world ")
        and reached.startswith("reached in 100%")
        and result.settings["replan"] == 1
    )
    assert "No film: the environment shows no pictures." in lines
    json.dumps(result.to_json(), allow_nan=False)


def test_what_is_planned_in_a_learned_world_is_recorded_in_the_environment(capsys, tmp_path):
    first, run, more = (str(tmp_path / name) for name in ("first", "run", "more"))
    assert main(["record", "world", NAME, "--policy", "random", "--frames", "400", "--out", first]) == 0
    small = ["--steps", "2", "--latent", "4", "--hidden", "8", "--members", "2", "--rollout", "1"]
    assert main(["train", "latent", first, "--out", run, *small]) == 0
    words = ["--in", run, "--policy", "plan:samples=2,iterations=1,horizon=1", "--out", more]
    assert main(["record", "world", NAME, "--frames", "20", *words]) == 0
    assert Dataset(more).episode(0)["rgb"].shape[1:] == (16, 32, 3)  # as the world sees them
    assert main(["record", "world", "gym:CartPole-v1", *words]) == 2
    assert "differ" in capsys.readouterr().err
    quick = [*QUICK[:-1], "--episodes", "1", "--no-curve", "--out", str(tmp_path / "plan")]
    for limit, cut in (("1e-9", True), ("1e9", False)):
        assert main(["plan", run, "--real", NAME, "--trust", limit, *quick]) == 0
        assert ("plans were cut to 1.0 of 4 moves on average" in capsys.readouterr().out) == cut
    agent = ["--agent", "plan:horizon=2,samples=2,iterations=1", "--episodes", "1", "--steps", "4", "--no-curve"]
    assert main(["plan", NAME, *agent, "--out", str(tmp_path / "agent")]) == 0
    assert "plans were cut" not in capsys.readouterr().out, "shorter than the default, but whole"


def test_no_pictures_are_drawn_where_none_are_recorded():
    world, _ = open_player("mujoco:arm", ControlsConfig(), EnvironmentConfig(), False, "plan", "mujoco:arm")
    assert "rgb" not in world.spec.channels
