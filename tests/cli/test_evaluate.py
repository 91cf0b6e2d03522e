"""`terrella evaluate` from outside: a dream that is reality agrees with it, what was judged is kept, bad input is a sentence."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from gymnasium import spaces
from tests.cli.tiny import NAME

import terrella
from terrella.act.paired_evaluation import PairedEvaluation
from terrella.cli import main
from terrella.workflows.evaluate import EvaluateConfig, labels_of, open_evaluation
from terrella.workflows.progress import silent

BLIND = NAME.replace("Tiny-v0", "Blind-v0")
QUICK = ["--steps", "24", "--episodes", "6"]
RIGHT = [f"constant:2{slips}" for slips in ("", "@0.2", "@0.4", "@0.6", "@0.9")]
FIVE = [*RIGHT, "constant:0", "--in", BLIND, "--real", BLIND, *QUICK]


def evaluated(capsys, *words):
    assert main(["evaluate", *words, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_a_dream_that_is_reality_agrees_and_what_was_stopped_goes_on(capsys, tmp_path, monkeypatch):
    whole = evaluated(capsys, *FIVE, "--out", str(tmp_path / "whole"))
    assert "ranks these 6 policies as reality does" in whole["verdict"][0]
    assert whole["dream"]["pearson"]["value"] == pytest.approx(1) and whole["dream"]["mmrv"]["value"] == 0
    assert whole["rows"]["constant:2"]["real"] == whole["rows"]["constant:2"]["dream"]
    assert "random" in whole["rows"] and "random" not in whole["policies"]
    assert max(whole["curves"]["observation"]["value"]) < 1e-5
    assert "<svg" in (tmp_path / "whole" / "evaluate.html").read_text()

    play, played = PairedEvaluation.play, []

    def stopped(bench, *told):
        played.append(told)
        if len(played) == 4:
            raise KeyboardInterrupt
        return play(bench, *told)

    monkeypatch.setattr(PairedEvaluation, "play", stopped)
    assert main(["evaluate", *FIVE, "--out", str(tmp_path / "part")]) == 130
    said = capsys.readouterr().err
    assert "the same command continues. So far: " in said and "constant:2 return 14.3 of 6" in said
    part = evaluated(capsys, *FIVE, "--out", str(tmp_path / "part"))
    assert len(played) == 1 + 7 and part["rows"] == whole["rows"] and part["dream"] == whole["dream"]
    assert main(["evaluate", *FIVE, "--out", str(tmp_path / "part"), "--seed", "1"]) == 2
    assert "other settings (seed 0, not 1)" in capsys.readouterr().err


def test_one_policy_in_a_world_alone(capsys, tmp_path):
    words = ["idle", "--in", BLIND, *QUICK, "--out", str(tmp_path)]
    assert main(["evaluate", *words]) == 0
    said = capsys.readouterr().out
    assert "In the dream the best of 1 is idle" in said and "random (baseline)" in said
    assert main(["evaluate", *words, "--real", BLIND]) == 2
    assert "other settings (real None" in capsys.readouterr().err


@pytest.mark.parametrize(
    "words, said",
    [
        (["rondom"], "did you mean 'random'"),
        (["constant:7"], "takes actions in"),
        (["idle", "--real", "gym:CartPole-v1"], "they differ"),
        (["idle", "--success", "won"], "no channel 'won'"),
        (["idle", "--success", "done", "--within", "0.2"], "leave --within out"),
        (["idle", "--episodes", "0"], "whole numbers from 1 up"),
        (["idle", "--goal", "99"], "can never be reached"),
        (["idle", "--goal", "5", "--within", "3"], "already solved"),
        (["tests/cli/tiny.py:NAME"], "is not a policy"),
    ],
)
def test_what_cannot_be_judged_is_said_in_a_sentence(capsys, tmp_path, words, said):
    assert main(["evaluate", *words[:1], "--in", BLIND, "--out", str(tmp_path / "new"), *words[1:]]) == 2
    error = capsys.readouterr().err
    assert said in error and "Traceback" not in error
    assert not (tmp_path / "new").exists()


def test_a_policy_that_gives_no_actions_is_said_in_a_sentence(capsys, tmp_path):
    file, asked = tmp_path / "broken.py", ["--in", BLIND, "--out", str(tmp_path / "new")]
    file.write_text(
        "import torch\nnan = lambda seen, rng: torch.full((len(seen['observation']),), torch.nan)\n"
        "wide = lambda seen, rng: torch.zeros(len(seen['observation']), 3)\n"
    )
    for name, said in (("nan", "not a finite number"), ("wide", "action of shape (6, 3) where")):
        assert main(["evaluate", f"{file}:{name}", *asked, *QUICK]) == 2
        error = capsys.readouterr().err
        assert said in error and f"broken.py:{name}: " in error and error.count("\n") == 1


def test_names_are_short_as_long_as_they_differ():
    names = ("a/one.py:left", "b/two.py:left@0.5", "runs/actor/", "other/actor", "constant:-1")
    labels = labels_of(names)
    assert labels["a/one.py:left"] == "left" and labels["b/two.py:left@0.5"] == "left@0.5"
    assert labels["runs/actor/"] == "runs/actor/" and labels["constant:-1"] == "constant:-1"


def test_evaluating_from_python(tmp_path):
    config = terrella.EvaluateConfig(real=BLIND, episodes=3, steps=24, out=tmp_path)
    result = terrella.evaluate(["constant:2", "constant:0"], BLIND, config)
    assert result.scores.rows["constant:2"]["real"].value >= result.scores.rows["constant:0"]["real"].value
    assert result.names["constant:0"] == "constant:0" and result.summary().endswith(f"the page: {result.page}")
    json.dumps(result.to_json(), allow_nan=False)


def test_the_distance_to_a_goal_has_the_units_of_reality_inside_a_world_without_bounds():
    study = open_evaluation(BLIND, EvaluateConfig(BLIND, goal="observation=16"), silent)
    free = replace(study.spec, channels={"observation": spaces.Box(-np.inf, np.inf, (1,), np.float32)})
    seen = {"observation": torch.tensor([[4.0]])}
    assert float(study.pair.criterion.distance(SimpleNamespace(spec=free), seen)) == pytest.approx(12 / 24)
