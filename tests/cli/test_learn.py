"""`terrella learn` from outside: one command to a world and its card, which goes on wherever it was stopped or killed."""

from __future__ import annotations

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

import terrella
from terrella import library
from terrella.cli import main
from terrella.core.errors import TerrellaError
from terrella.data import Dataset
from terrella.learn.presets import PRESETS
from terrella.learn.recipes.video import TrainConfig, TrainingPace
from terrella.learn.trainer import Trainer
from terrella.workflows.collect import explore
from terrella.workflows.learn import LearnConfig
from terrella.workflows.learn_environment import held_to_real_time
from terrella.workflows.learn_schedule import DISTILLING, RECORDING, SCORING, TRAINING, LearnSchedule, folder_for
from terrella.workflows.learn_trial import Pace, forecast, slower, time_environment
from terrella.workflows.opening import EnvironmentConfig
from terrella.workflows.results import changed_settings
from terrella.workflows.results import command as command_line
from terrella.worlds.folder import load_world

from .tiny import NAME

ROOT = Path(__file__).parents[2]
FRAMES = 300


def begun(folder: Path, settings: dict, minutes: float) -> LearnSchedule:
    """A plan of which something is recorded."""
    plan = LearnSchedule(folder, settings, minutes)
    (folder / RECORDING / "meta").mkdir(parents=True)
    (folder / RECORDING / "meta" / "info.json").write_text("{}")
    plan.save()
    return plan


@pytest.mark.parametrize("minutes", [0.5, 3, 30, 600])
def test_the_minutes_are_divided_and_none_is_left_over(minutes, tmp_path):
    plan = LearnSchedule(tmp_path / "new", {}, minutes)
    share = plan.share_s
    assert sum(share.values()) == pytest.approx(60 * minutes, abs=6) and share[TRAINING] > 0.5 * 60 * minutes
    assert minutes != 30 or share[SCORING] == 120
    plan.spent[RECORDING] = 2.0  # sooner than was planned: training has the rest
    plan.note(RECORDING, {})
    assert plan.share_s[TRAINING] > share[TRAINING]
    plan.spent[TRAINING] = plan.seconds  # later than was planned
    plan.note(TRAINING, {})
    assert 0 <= plan.left_s(SCORING) <= share[SCORING], "nothing is promised beyond the minutes"


def test_a_student_has_a_part_of_the_time_of_training(tmp_path):
    plan, alone = LearnSchedule(tmp_path / "a", {}, 10, student=True), LearnSchedule(tmp_path / "b", {}, 10).share_s
    share = plan.share_s
    assert share[TRAINING] + share[DISTILLING] == alone[TRAINING] and share[DISTILLING] == 0.3 * alone[TRAINING]
    assert alone[DISTILLING] == 0
    plan = begun(tmp_path / "c", {}, 3)
    for stage in (RECORDING, TRAINING, DISTILLING, SCORING):
        plan.note(stage, {})
    (tmp_path / "c" / "student").mkdir()
    assert DISTILLING not in LearnSchedule(tmp_path / "c", {}, 5).facts, "its teacher learns on"
    assert not (tmp_path / "c" / "student").exists()


@pytest.mark.slow
def test_a_student_is_learned_and_scored_beside_its_world(tmp_path, capsys, monkeypatch):
    shares = {RECORDING: 60.0, TRAINING: 30.0, DISTILLING: 30.0, SCORING: 60.0}
    monkeypatch.setattr(LearnSchedule, "share_s", property(lambda schedule: shares))
    monkeypatch.setattr("terrella.workflows.learn.ENDLESS", 8)
    monkeypatch.setattr("terrella.workflows.learn.CLIP_COUNTS", (3,))
    monkeypatch.setattr("terrella.workflows.learn.time_environment", lambda *_: None)
    narrow = tuple(replace(one, channels=tuple(wide // 64 * 8 + 8 for wide in one.channels)) for one in PRESETS)
    for module in ("workflows.learn", "learn.presets", "learn.recipes.student"):
        monkeypatch.setattr(f"terrella.{module}.PRESETS", narrow)
    asked = [*command(tmp_path / "two"), "--student"]
    assert main([*asked, "--preset", "medium", "--batch", "1", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    student, teacher = (load_world(Path(told[name]) / "world") for name in ("student", "world"))
    assert (student.generator.config.channels, teacher.generator.config.channels) == (
        narrow[0].channels,
        narrow[1].channels,
    )
    assert any(line.startswith("two-student is ") for line in told["verdict"])
    assert "two-student" in Path(told["card"]).read_text()


def test_a_plan_goes_on_with_its_own_settings_alone(tmp_path):
    begun(tmp_path / "a", {"environment": "gym:A-v1", "seed": 0}, 3).note(RECORDING, {"frames": 5})
    assert LearnSchedule(tmp_path / "a", {"environment": "gym:A-v1", "seed": 0}, 3).facts == {RECORDING: {"frames": 5}}
    with pytest.raises(TerrellaError, match="environment gym:A-v1, not gym:B-v1"):
        LearnSchedule(tmp_path / "a", {"environment": "gym:B-v1", "seed": 0}, 3)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("dear")
    with pytest.raises(TerrellaError, match="something else"):
        LearnSchedule(tmp_path / "mine", {}, 3)
    (tmp_path / "a" / "learn.json").write_text("{")
    with pytest.raises(TerrellaError, match="damaged"):
        LearnSchedule(tmp_path / "a", {}, 3)


def test_more_minutes_train_a_finished_world_on(tmp_path):
    plan = begun(tmp_path / "a", {}, 3)
    for stage in (RECORDING, TRAINING, SCORING):
        plan.note(stage, {})
    assert set(LearnSchedule(tmp_path / "a", {}, 2).facts) == {RECORDING, TRAINING, SCORING}
    assert LearnSchedule(tmp_path / "a", {}, 2).minutes == 3, "more than three are needed to train it further"
    assert set(LearnSchedule(tmp_path / "a", {}, 5).facts) == {RECORDING}


def test_a_plan_of_which_nothing_was_recorded_binds_nobody(tmp_path):
    LearnSchedule(tmp_path / "a", {"seed": 0}, 3).save()
    assert LearnSchedule(tmp_path / "a", {"seed": 1}, 3).facts == {} and not (tmp_path / "a").exists()


@pytest.mark.parametrize(
    "name, folder",
    [
        ("gym:CarRacing-v3", "CarRacing-v3"),
        ("gym:ALE/Breakout-v5", "Breakout-v5"),
        ("gym:my.game:Mine-v0", "Mine-v0"),
        ("doom:my_way_home", "my_way_home"),
        ("doom:freedoom2/MAP01,MAP02", "MAP01-MAP02"),
    ],
)
def test_the_folder_is_named_after_the_environment(name, folder):
    assert folder_for(name) == Path("learned") / folder


@pytest.mark.parametrize(
    "given, said",
    [
        (["gym:CartPol-v1"], "CartPol-v1"),
        (["gym:CartPol-v1@2"], "CartPol-v1"),
        ([NAME.replace("Tiny-", "Blind-")], "shows no pictures"),
        ([NAME, "--minutes", "0"], "--minutes"),
        ([NAME, "--minutes", "inf"], "--minutes"),
        ([NAME, "--frames", "1"], "--frames"),
        ([NAME, "--keys", "q=99"], "99"),
        ([NAME, "--device", "tpu"], "--device tpu: PyTorch has no such device here; use cpu"),
    ],
)
def test_what_cannot_be_learned_is_said_and_leaves_nothing(given, said, tmp_path, capsys):
    assert main(["learn", *given, "--out", str(tmp_path / "out")]) == 2
    err = capsys.readouterr().err
    (line,) = [line for line in err.splitlines() if line.startswith("terrella: ")]
    assert said in line and not (tmp_path / "out").exists()
    assert "records for" not in err, "nothing is promised of what does not open"


def test_of_a_fast_game_every_action_is_held_so_that_it_is_played_in_real_time():
    assert held_to_real_time("gym:CartPole-v1", EnvironmentConfig()) == "gym:CartPole-v1@2"  # 50 steps a second
    for name, environment in (
        ("gym:Pendulum-v1", EnvironmentConfig()),  # 20 steps a second
        ("gym:CartPole-v1@1", EnvironmentConfig()),
        ("gym:CartPole-v1", EnvironmentConfig(fps=40)),
    ):
        assert held_to_real_time(name, environment) == name


def command(out: Path) -> list[str]:
    return ["learn", NAME, "--minutes", "5", "--frames", str(FRAMES), "--out", str(out)]


def killed_while_recording(out: Path) -> None:
    script = f"import sys; from terrella.cli import main; main({command(out)!r})"
    paths = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    with subprocess.Popen([sys.executable, "-c", script], cwd=ROOT, env={**os.environ, "PYTHONPATH": paths}) as process:
        while not (out / RECORDING / "meta" / "info.json").exists() and process.poll() is None:
            time.sleep(0.01)
        os.kill(process.pid, signal.SIGKILL)


@pytest.mark.slow
def test_whatever_stops_it_the_same_command_goes_on_to_a_world_with_a_card(tmp_path, capsys, monkeypatch):
    shares = {RECORDING: 60.0, TRAINING: 1.0, SCORING: 60.0}  # recording ends with its frames, training with its steps
    monkeypatch.setattr(LearnSchedule, "share_s", property(lambda schedule: shares))
    monkeypatch.setattr("terrella.workflows.learn.ENDLESS", 8)
    monkeypatch.setattr("terrella.workflows.learn.HOPELESS_STEPS", 5)
    monkeypatch.setattr("terrella.workflows.learn.CLIP_COUNTS", (3,))
    out = tmp_path / "tiny"
    killed_while_recording(out)
    stepped = Trainer._step

    def interrupting(self, number):
        if self.stage == "flow" and number == 0:
            signal.raise_signal(signal.SIGINT)
        return stepped(self, number)

    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "_step", interrupting)
        assert main(command(out)) == 130
    said = capsys.readouterr().err
    assert "records for up to" in said and "the same command continues" in said
    assert Dataset(out / RECORDING).length == FRAMES
    assert main([*command(out), "--json"]) == 0
    told = capsys.readouterr()
    facts = json.loads(told.out)
    assert "Continues in" in told.err and "trains for" in told.err and "records for" not in told.err
    assert "copying the last" in facts["verdict"][0] and facts["play"].endswith("run")
    assert (out / "run" / "world" / "world.json").exists() and Path(facts["card"]).stat().st_size > 0
    assert main(command(out)) == 0
    again = capsys.readouterr()
    assert "is finished" in again.err and facts["verdict"][0] in again.out and "play it: terrella play" in again.out
    assert f"train it further: terrella learn {NAME} --minutes " in again.out and f"--out {out}" in again.out
    assert f"as one page for others: terrella export world {out / 'run'} --out {out.name}.html" in again.out
    assert library.folder_of(out) == out / "run" / "world" and (out / "run" / "newest.png").exists()
    assert main([*command(out), "--seed", "5"]) == 2
    assert "seed 0, not 5" in capsys.readouterr().err


def test_a_world_that_is_being_learned_can_be_named_by_its_folder(tmp_path):
    (tmp_path / "learn.json").write_text("{}")
    with pytest.raises(TerrellaError, match="has no world yet"):
        library.folder_of(tmp_path)
    (tmp_path / "run" / "world").mkdir(parents=True)
    (tmp_path / "run" / "world" / "world.json").write_text("{}")
    assert library.folder_of(tmp_path) == tmp_path / "run" / "world"


def test_commands_that_are_printed_can_be_pasted():
    config = LearnConfig(minutes=3, out=Path("my worlds/it's"), environment=EnvironmentConfig(size=(64, 96)))
    line = command_line("terrella", "learn", "gym:A-v1", **changed_settings(config))
    assert shlex.split(line) == [
        "terrella",
        "learn",
        "gym:A-v1",
        "--minutes",
        "3",
        "--out",
        "my worlds/it's",
        "--size",
        "64",
        "96",
    ]
    assert changed_settings(terrella.PlanConfig(curve=False)) == {"no_curve": True}
    assert command_line("evaluate", goal="-1,0", **{"in": "a b"}) == "evaluate --goal=-1,0 --in 'a b'", "no option"


PACE = TrainingPace(setup_s=5.0, step_s=0.5, share=0.6)


@pytest.mark.parametrize("minutes, training_s", [(1, 30), (2, 80)])
def test_too_few_minutes_are_refused_with_the_number_that_is_enough(minutes, training_s):
    with pytest.raises(TerrellaError, match=r"too few on this machine.* Give --minutes 1[0-9] or more") as refused:
        forecast(Pace(50.0, PACE), minutes, 600, training_s)
    better = int(re.search(r"--minutes (\d+)", str(refused.value))[1])
    assert "That is little" not in forecast(Pace(50.0, PACE), better, 600, 60 * better * 0.75), "the advice holds"


def test_what_the_minutes_give_is_said_before_they_are_spent(tmp_path, capsys, monkeypatch):
    said = forecast(Pace(50.0, PACE), 5, 4000, 220)
    assert "4,000 frames" in said and "254 training steps" in said and "That is little: --minutes" in said
    out = tmp_path / "hopeless"
    monkeypatch.setattr("terrella.workflows.learn.time_environment", lambda *_: Pace(50.0, PACE._replace(step_s=60.0)))
    assert main(command(out)) == 2 and "too few on this machine" in capsys.readouterr().err
    assert not out.exists(), "a refusal leaves nothing"
    assert "does not compile" not in said
    assert forecast(Pace(50.0, PACE._replace(compiles=True)), 5, 4000, 220).startswith(said)


def test_the_trial_times_a_recording_and_training_steps():
    pace = time_environment(EnvironmentConfig().open(NAME), 0, TrainConfig())
    assert pace.frames_per_s > 1 and 0 < pace.training.step_s < 60 and 0.3 < pace.training.share < 0.9


def test_a_pace_that_is_slower_than_the_trial_is_said_as_training_begins():
    assert slower(600, 5) is None and "which is little" in (slower(599, 5) or "")
    assert "about 66 steps, too few to learn anything" in (said := slower(66, 5) or "") and "--minutes 46 " in said


def test_a_slow_game_is_recorded_for_longer_which_is_said(tmp_path, capsys, monkeypatch):
    enough = []

    def slow(world, out, frames, seed, report, *rest, **more):
        for rows in (1, 40, 590, 600):
            report(rows, frames)
            enough.append(more["enough"]())
        return explore(world, out, 20, seed, report, *rest, **more)

    monkeypatch.setattr("terrella.workflows.learn.explore", slow)
    monkeypatch.setattr("terrella.workflows.progress.LINE_EVERY_S", -1.0)
    monkeypatch.setattr(LearnSchedule, "share_s", property(lambda plan: {RECORDING: 0.0, TRAINING: 1.0, SCORING: 1.0}))
    monkeypatch.setattr("terrella.workflows.learn.time_environment", lambda *_: None)
    main(command(tmp_path / "slow"))
    assert enough == [False, False, False, True]
    said = [line for line in capsys.readouterr().err.splitlines() if " recording " in line and "%" in line]
    assert ["a slow game: until it has 600 frames" in line for line in said[1:4]] == [True, True, False]


def test_too_few_frames_are_said_and_kept(tmp_path, capsys, monkeypatch):
    few = lambda world, out, frames, *rest, **more: explore(world, out, 20, *rest, **more)  # noqa: E731
    monkeypatch.setattr("terrella.workflows.learn.explore", few)
    monkeypatch.setattr("terrella.workflows.learn.time_environment", lambda *_: None)
    out = tmp_path / "few"
    assert main(command(out)) == 2
    assert "20 frames" in (said := capsys.readouterr().err) and "goes on recording" in said
    assert Dataset(out / RECORDING).length == 20 and not (out / "run").exists()
