"""The guide "From Python" keeps its word: its code runs, in order, here with few frames and steps."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from terrella.workflows import practise
from terrella.workflows.learn_schedule import RECORDING, SCORING, TRAINING, LearnSchedule

GUIDE = Path(__file__).parents[1] / "docs" / "from-python.md"
SHORT = {
    '"gym:CarRacing-v3"': '"gym:tests.cli.tiny:TerrellaTiny-v0"',
    "LearnConfig(minutes=30,": "LearnConfig(minutes=0.5, frames=300,",
    "frames=5000": "frames=600",
    "LatentTraining(steps=4000)": "LatentTraining(steps=2, batch=4, latent=4, rollout=2, leap=2, history=1, hidden=8)",
    "Practice(minutes=5)": "Practice(steps=2, batch=8, horizon=2, hidden=8)",
    "episodes=10,": "episodes=2, steps=8, curve=False,",
    "episodes=50,": "episodes=2, steps=8,",
    "minutes=20, frames=8000": "minutes=0.05, frames=1000",
    "episodes=300, seeds=3": 'arms=("nominal",), episodes=4, seeds=1, practice=1, real_episodes=(1,)',
}


@pytest.mark.slow
def test_the_guides_code_runs_in_order(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    shares = {RECORDING: 60.0, TRAINING: 1.0, SCORING: 1.0}  # recording ends with its frames, training with its steps
    monkeypatch.setattr(LearnSchedule, "share_s", property(lambda schedule: shares))
    monkeypatch.setattr("terrella.workflows.learn.ENDLESS", 4)
    monkeypatch.setattr(practise, "ROUNDS", 1)
    for module in ("practise", "learn_trial"):  # a slow machine refuses these few seconds
        monkeypatch.setattr(f"terrella.workflows.{module}.HOPELESS_STEPS", 0)
    monkeypatch.setattr(practise, "TRIAL_EPISODES", 2)
    code = "\n".join(re.findall(r"^```python\n(.*?)^```", GUIDE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL))
    for long, short in SHORT.items():
        assert long in code, "the guide and its short form belong together"
        code = code.replace(long, short)
    names: dict = {"__name__": "guide"}
    exec(compile(code, GUIDE.name, "exec"), names)
    assert names["pictures"].shape == (4, 16, 24, 3)
    assert names["card"].card.rows and names["evaluation"].page.is_file()
    assert (tmp_path / "result.json").stat().st_size > 100
    assert "copying the last" in capsys.readouterr().out
