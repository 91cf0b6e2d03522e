"""terrella train policy and learn --practise: what they say, and that they go on where they were stopped."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from terrella.cli import main
from terrella.data import Dataset
from terrella.workflows import practise as practising

SHORT = ["--steps", "2", "--batch", "8", "--horizon", "4", "--hidden", "8", "--episodes", "2"]


def test_a_policy_practises_in_a_simulator_and_is_tried_there(tmp_path, capsys) -> None:
    asked = ["train", "policy", "--in", "gym:CartPole-v1", "--out", str(tmp_path / "run")]
    assert main([*asked, *SHORT, "--real", "gym:CartPole-v1", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert "chance in gym:CartPole-v1" in told["verdict"] or "chance in CartPole" in told["verdict"]
    assert told["return"]["count"] == 2 and told["practised_steps"] == 64
    assert (tmp_path / "run" / "policy" / "policy.json").is_file()
    assert main([*asked, *SHORT, "--real", "gym:Pendulum-v1"]) == 2
    assert "takes actions in" in capsys.readouterr().err


@pytest.mark.parametrize("option", [["--preset", "large"], ["--batch", "4"], ["--no-compile"], ["--no-half"]])
def test_options_of_worlds_of_pictures_are_refused_with_practise(option, tmp_path, capsys):
    assert main(["learn", "gym:CartPole-v1", "--practise", *option, "--out", str(tmp_path / "out")]) == 2
    assert "are for worlds of pictures; --practise takes none." in capsys.readouterr().err


def test_what_cannot_be_practised_is_said_in_a_sentence(tmp_path, capsys) -> None:
    (tmp_path / "file").write_text("")
    asked = ["train", "policy", "--in", "gym:CartPole-v1", "--out", str(tmp_path / "file" / "run"), *SHORT]
    assert main(asked) == 2
    assert "cannot be written" in capsys.readouterr().err
    assert main(["learn", "gym:CartPole-v1", "--practise", "--out", str(tmp_path)]) == 2
    assert "holds something else" in capsys.readouterr().err


def test_rounds_of_practice_go_on_where_they_were_stopped(tmp_path, capsys, monkeypatch) -> None:
    for name, value in {"ROUNDS": 2, "TRIAL_EPISODES": 2, "FEWEST_FRAMES": 100}.items():
        monkeypatch.setattr(practising, name, value)
    asked = ["learn", "gym:CartPole-v1", "--practise", "--minutes", "1000", "--frames", "300", "--json"]
    asked += ["--out", str(tmp_path / "learned")]
    learn, practise = practising.train_latent, practising.train_policy
    small = {"steps": 2, "batch": 4, "latent": 4, "rollout": 1, "history": 1}

    hours = {}

    def learned(data, out, config, report, paced):
        paced(66)
        hours[out.name] = config.hours
        return learn(data, out, replace(config, **small), report)

    def practised(world, name, out, config, *more):
        return practise(world, name, out, replace(config, steps=2, batch=8, horizon=2, hidden=8), *more)

    def stopped(world, name, out, *more):
        if out.name == "policy-1":
            raise KeyboardInterrupt
        return practised(world, name, out, *more)

    monkeypatch.setattr(practising, "train_latent", learned)
    monkeypatch.setattr(practising, "train_policy", stopped)
    assert main(asked) == 130
    said = capsys.readouterr().err
    assert "2 rounds of about 150 frames" in said and "66 steps, too few to learn anything" in said
    rows = Dataset(tmp_path / "learned" / "recording").length
    monkeypatch.setattr(practising, "train_policy", practised)
    capsys.readouterr()
    assert main(asked) == 0
    told = json.loads(capsys.readouterr().out)
    assert [one["frames"] for one in told["rounds"]][-1] == rows and "chance in" in told["verdict"]
    notes = json.loads((tmp_path / "learned" / "practise.json").read_text())
    assert notes["rounds"] == told["rounds"]
    hours.clear()
    more = ["3000" if word == "1000" else word for word in asked]
    assert main(more) == 0, "with more minutes the last round is trained on"
    again = json.loads(capsys.readouterr().out)["rounds"]
    assert list(hours) == ["world-1"] and hours["world-1"] == pytest.approx(0.5 * 2500 / 60)
    assert again[:1] == told["rounds"][:1] and [one["minutes"] for one in again] == [500, 2500]
    other = [*asked[:-3], "--seed", "1", *asked[-3:]]
    assert main(other) == 2 and "begun with other settings" in capsys.readouterr().err


@pytest.mark.parametrize("options", [["--episodes", "0"], ["--steps", "0"]])
def test_counts_are_whole(options, tmp_path, capsys) -> None:
    asked = ["train", "policy", "--in", "gym:CartPole-v1", "--out", str(tmp_path / "run")]
    assert main([*asked, *options]) == 2
    assert "1 " in capsys.readouterr().err


def test_nothing_is_collected_while_the_world_of_what_was_is_learned(tmp_path, monkeypatch) -> None:
    for name, value in {"ROUNDS": 1, "FEWEST_FRAMES": 100, "SHARES": {**practising.SHARES, "collecting": 0.0}}.items():
        monkeypatch.setattr(practising, name, value)

    def stopped(data, out, config, report, paced):
        out.mkdir(exist_ok=True)
        raise KeyboardInterrupt

    monkeypatch.setattr(practising, "train_latent", stopped)
    monkeypatch.setattr(practising, "_forecast", lambda *_: "")
    asked = ["learn", "gym:CartPole-v1", "--practise", "--frames", "300", "--out", str(tmp_path / "learned")]
    assert main(asked) == 130
    collected = Dataset(tmp_path / "learned" / "recording").length
    assert main(asked) == 130
    assert 150 <= collected == Dataset(tmp_path / "learned" / "recording").length < 300


def test_minutes_in_which_nothing_is_learned_are_refused_and_leave_nothing(tmp_path, capsys, monkeypatch) -> None:
    trial = {"frames": 160, "collected_s": 1.0, "world_steps": 30, "steps": 4}
    monkeypatch.setattr(practising, "_round", lambda *_: trial)
    out = tmp_path / "out"
    assert main(["learn", "gym:CartPole-v1", "--practise", "--minutes", "2", "--out", str(out)]) == 2
    said = capsys.readouterr().err
    assert "75 training steps of the world" in said and "Give --minutes 16." in said and not out.exists()


def test_the_policy_that_earned_most_is_gone_on_from() -> None:
    earned = lambda *returns: [{"return": value} for value in returns]  # noqa: E731
    assert practising.best_round(earned(-1213.0)) == 0, "the explorer's round has a policy that nobody has tried"
    assert practising.best_round(earned(-100.0, -217.0)) == 0, "what the explorer earned is no policy's"
    assert practising.best_round(earned(-1213.0, -217.0, -170.0, -368.0)) == 1
