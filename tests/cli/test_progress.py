"""Progress in a log: lines with the time left, few of them, the last one always."""

from __future__ import annotations

import pytest

from terrella.workflows import progress


@pytest.fixture
def clock(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    return now


def test_the_time_left_counts_what_this_run_did_alone(clock, capsys):
    with progress.stage("recording", progress.Terminal()) as report:
        report(500, 1000)  # of an earlier run
        clock[0] += 60
        report(600, 1000)  # 100 in a minute: 400 take four more
    assert "60% 4.0 min left" in capsys.readouterr().err


def test_a_log_gets_few_lines_and_the_last(clock, capsys):
    with progress.stage("recording", progress.Terminal()) as report:
        for done in range(1000):
            clock[0] += 0.1
            report(done + 1, 1000, "loss 1")
    lines = capsys.readouterr().err.splitlines()
    assert 2 <= len(lines) <= 1 + 100 / progress.LINE_EVERY_S
    assert lines[-1] == "recording 100% loss 1"


def test_another_stage_has_a_time_of_its_own(clock, capsys):
    with progress.stage("training", progress.Terminal()) as report:
        report(0, 10, "cache")
        clock[0] += 1000
        report(0.0, 1.0)
        clock[0] += 30
        report(0.5, 1.0)
    assert capsys.readouterr().err.splitlines()[-1] == "training 50% 0.5 min left"
