"""`terrella practise` from outside: a gain is proven outside, a warning comes first, bad input is a sentence."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from tests.cli.tiny import NAME

from terrella.cli import main
from terrella.cli.train_policy import _evaluating
from terrella.workflows.opening import EnvironmentConfig
from terrella.workflows.verified_practice import VerifiedPracticeConfig

BLIND = NAME.replace("Tiny-v0", "Blind-v0")
SMALL = ["--updates", "2", "--groups", "4", "--group-size", "4", "--steps", "24", "--episodes", "6", "--within", "0.02"]
GOAL = ["--goal", "observation=16"]


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    """A policy that imitates slips and pushes to the right."""
    folder = tmp_path_factory.mktemp("policy")
    recorded = ["record", "world", BLIND, "--policy", "constant:2@0.6", "--frames", "400", "--pictures", "none"]
    assert main([*recorded, "--out", str(folder / "recording")]) == 0
    asked = [
        "train",
        "policy",
        "--method",
        "imitation",
        "--from",
        str(folder / "recording"),
        "--out",
        str(folder / "run"),
    ]
    assert main([*asked, "--steps", "3", "--batch", "8", "--hidden", "8", "--history", "1"]) == 0
    return folder


def practised(capsys, policy, out, *words):
    assert main(["practise", str(policy / "run"), "--in", BLIND, "--out", str(out), *SMALL, *words, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_the_table_has_both_places_and_the_blind_arm_and_what_was_stopped_goes_on(policy, capsys, tmp_path):
    result = practised(capsys, policy, tmp_path / "run", *GOAL, "--real", BLIND)
    assert set(result["gains"]) == {"inside", "outside"} and set(result["gains"]["outside"]) == {"after", "blind"}
    assert result["gains"]["inside"] == result["gains"]["outside"], "the world is the environment"
    kept = [result[name]["value"] for name in ("failures", "successes") if result[name]["count"]]
    assert kept and set(kept) == {1.0}, "what fails outside fails inside, and what succeeds succeeds"
    assert sum(result[name]["count"] for name in ("failures", "successes")) == 3 * 6
    assert any("Only 6 episodes" in line for line in result["verdict"])
    assert json.loads((tmp_path / "run" / "practise.json").read_text())["verdict"] == result["verdict"]
    assert practised(capsys, policy, tmp_path / "run", *GOAL, "--real", BLIND)["scores"] == result["scores"]
    again = [
        "practise",
        str(policy / "run"),
        "--in",
        BLIND,
        "--out",
        str(tmp_path / "run"),
        *SMALL,
        "--goal",
        "observation=9",
    ]
    assert main(again) == 2 and "other settings" in capsys.readouterr().err


def test_without_an_environment_the_verdict_says_that_outside_is_not_measured(policy, capsys, tmp_path):
    result = practised(capsys, policy, tmp_path / "run", *GOAL, "--no-blind")
    assert result["verdict"][0].startswith("Not measured outside: name the environment with --real.")
    assert list(result["gains"]) == ["inside"] and result["failures"] is None
    assert "--goal observation=16 --within 0.02 --steps 24 --best-of 4 16" in result["next"], "the same success"


def test_the_command_that_follows_has_the_same_success_or_is_left_out():
    def after(**settings):
        return _evaluating(Path("p"), "world", VerifiedPracticeConfig(**settings))

    assert after(success="won", within=0.1) == "terrella evaluate p --in world --success won --best-of 4 16"
    small = after(goal=("x=1",), environment=EnvironmentConfig(size=(8, 8)))
    assert small == "terrella evaluate p --in world --goal x=1 --size 8 8 --best-of 4 16"
    assert after(goal=("x=1", "y=2")) == after(goal=("x=1",), success="won") == ""


def test_the_best_of_several_plans_is_evaluated_beside_the_policy(policy, capsys, tmp_path):
    words = ["evaluate", str(policy / "run"), "--in", BLIND, "--real", BLIND, "--best-of", "3", *GOAL, *SMALL[6:]]
    assert main([*words, "--out", str(tmp_path), "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert rows["best:3:run"]["real"]["value"] >= rows["run"]["real"]["value"]


@pytest.mark.parametrize(
    "words, sentence",
    [
        ([], "say what success is"),
        (["--goal", "position=3"], "position"),
        (["--goal", "observation=99"], "can never be reached"),
        (["--goal", "observation=10", "--within", "0.9"], "already solved"),
        (["--goal", "3"], "give CHANNEL=VALUE"),
        (["--success", "won"], "won"),
        ([*GOAL, "--real", "gym:CartPole-v1"], "they differ"),
        ([*GOAL, "--group-size", "1"], "--group-size 2 or more"),
        ([*GOAL, "--noise", "0"], "--noise is above 0"),
        ([*GOAL, "--episodes", "0"], "whole numbers from 1 up"),
        (["--goal", "observation=16", "--within", "0.000001", "--steps", "1"], "none of 64 imagined rollouts"),
        ([*GOAL, "--reference", "no/where"], "no/where"),
        ([*GOAL, "--reference", "RECORDING"], "a reference is for a learned world"),
        ([*GOAL, "--reference", "no/where", "--reward", "predicted"], "leave --reward predicted out"),
    ],
)
def test_what_cannot_be_practised_is_said_in_a_sentence(policy, capsys, tmp_path, words, sentence):
    out, words = tmp_path / "new", [str(policy / "recording") if word == "RECORDING" else word for word in words]
    assert main(["practise", str(policy / "run"), "--in", BLIND, "--out", str(out), *SMALL, *words]) == 2
    error = capsys.readouterr().err
    assert sentence in error and "Traceback" not in error
    assert not (out / "policy").exists(), "refused before it practises"


def test_other_policies_are_refused(policy, capsys, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:  # before episodes are imagined, which takes minutes in worlds of pictures
        patch.delattr("terrella.workflows.verified_practice._check_study")
        assert main(["practise", str(policy / "run"), "--in", "gym:CartPole-v1", "--success", "done"]) == 2
    assert "gym:CartPole-v1 takes Discrete(2): it is for other actions" in capsys.readouterr().err
    assert main(["practise", str(tmp_path / "none"), "--in", BLIND, *GOAL]) == 2
    assert "there is no folder" in capsys.readouterr().err
    before = (policy / "run/policy/weights.safetensors").read_bytes()
    for name in ("run", "run/policy"):
        assert main(["practise", str(policy / name), "--in", BLIND, *GOAL, "--out", str(policy / "run"), *SMALL]) == 2
        assert "holds the policy itself" in capsys.readouterr().err
    assert (policy / "run/policy/weights.safetensors").read_bytes() == before
    (tmp_path / "policy.json").write_text('{"kind": "goal-actor"}')
    assert main(["practise", str(tmp_path), "--in", BLIND, *GOAL]) == 2
    assert "'goal-actor'; practice fine-tunes policies by" in capsys.readouterr().err
    assert main(["evaluate", "random", "--in", BLIND, "--best-of", "2", *GOAL]) == 2
    assert "--best-of takes counts" in capsys.readouterr().err
