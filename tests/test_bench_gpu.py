"""The benchmark for GPUs is rehearsed on a CPU, so that whoever has a card need not mend it first."""

from __future__ import annotations

import json
import runpy
from pathlib import Path

import pytest

import terrella
from terrella.workflows.learn import LearnResult

SCRIPT = Path(__file__).parent.parent / "benchmarks" / "gpu.py"


@pytest.fixture
def rehearsed(tmp_path, capsys):
    """rehearsed(rows) -> what was measured of them."""
    script = runpy.run_path(str(SCRIPT))

    def measured(*only: str) -> list[dict]:
        settings = script["Settings"](cpu=True, seconds=0.01, out=tmp_path / "bench.json", only=only)
        assert script["main"](settings) == 0
        report = json.loads((tmp_path / "bench.json").read_text())
        assert report["rehearsal"] and "a rehearsal" in capsys.readouterr().out
        assert {row["what"] for row in report["rows"]} == set(only)
        return report["rows"]

    return measured


def test_it_is_rehearsed_without_a_card(rehearsed):
    rows = rehearsed("arm", "flow training")
    assert [row["what"] for row in rows] == ["arm", "flow training"]
    assert all(row["per_s"] > 0 and not row["error"] and row["off"] == 0 for row in rows)
    assert rows[0]["kernels"] > 20 and rows[0]["profile"]["kernels"] and rows[0]["profile"]["call sites"]


def test_environments_are_learned_one_after_the_other_and_faults_are_kept(tmp_path, capsys, monkeypatch):
    script, asked, really = runpy.run_path(str(SCRIPT)), [], terrella.learn

    def learn(name, config, progress):
        asked.append((name, config.minutes, config.device))
        if name == "gym:CartPol-v1":
            return really(name, config)
        return LearnResult(("Pong is better.",), config.out, None, {"training": 9.0}, "", 700)

    monkeypatch.setattr(terrella, "learn", learn, raising=False)
    settings = script["Settings"](
        cpu=True, out=tmp_path / "bench.json", learn=("gym:CartPol-v1", "gym:Pong"), minutes=2
    )
    assert script["main"](settings) == 1 and asked == [("gym:CartPol-v1", 2, "cpu"), ("gym:Pong", 2, "cpu")]
    fault, pong = json.loads((tmp_path / "bench.json").read_text())["learned"]
    assert "CartPol" in fault["error"] and (pong["steps"], pong["verdict"]) == (700, ["Pong is better."])
    assert "Pong is better." in capsys.readouterr().out


@pytest.mark.slow
def test_worlds_are_rehearsed(rehearsed):
    """One of each kind: test_dispatch and test_step_program hold the others."""
    rows = rehearsed("islet", "latent")
    assert all(row["per_s"] > 0 and not row["error"] and row["off"] < 2e-3 for row in rows)
