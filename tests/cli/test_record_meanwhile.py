"""Recording in processes of its own: it goes on beside, stops when told to, goes on again, and says where it ended."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial

import pytest

from terrella.core.world import make_rng
from terrella.data import Dataset, Layout
from terrella.data.collect import Job
from terrella.workflows import record_meanwhile
from terrella.workflows.collect import open_player
from terrella.workflows.opening import ControlsConfig, EnvironmentConfig
from terrella.workflows.record_meanwhile import recording_meanwhile, spare_workers

from .tiny import NAME


@pytest.fixture(scope="module")
def job():
    make = partial(open_player, NAME, ControlsConfig(), EnvironmentConfig(), True, "explorer")
    spec = make()[0].spec
    return replace(Job.of(make, spec, make_rng(1), replace(Layout.of(spec), pictures="png")), steps=20)


def ended(recorded, within_s: float = 300.0) -> None:
    until = time.monotonic() + within_s
    while recorded._process.is_alive() and time.monotonic() < until:
        time.sleep(0.05)
    assert not recorded._process.is_alive()


@pytest.mark.slow
def test_it_records_beside_and_says_where_it_ended(job, tmp_path):
    with recording_meanwhile(job, tmp_path / "out", 1, 60) as recorded:
        ended(recorded)
        assert recorded.trouble() is None and Dataset(tmp_path / "out").length >= 60
    with recording_meanwhile(job, tmp_path / "out", 1, 10_000) as recorded:
        recorded._process.kill()
        ended(recorded)
        said = recorded.trouble() or ""
        assert "Recording has stopped: its process ended (-9). Training goes on" in said and recorded.trouble() is None
    assert Dataset(tmp_path / "out").length >= 60, "what was committed is kept"
    began = time.monotonic()
    with recording_meanwhile(replace(job, steps=0), tmp_path / "other", 1, 10_000) as recorded:
        ended(recorded)
        assert "has no step" in (recorded.trouble() or "")
    with recording_meanwhile(job, tmp_path / "out", 1, 10_000) as recorded:
        pass
    assert not recorded._process.is_alive() and time.monotonic() > began


@pytest.mark.parametrize(
    ("cores", "cuda", "workers"), [(2, True, 0), (3, False, 0), (4, False, 1), (4, True, 2), (64, True, 8)]
)
def test_workers_have_the_cores_that_training_leaves(cores, cuda, workers, monkeypatch):
    monkeypatch.setattr(record_meanwhile.os, "cpu_count", lambda: cores)
    assert spare_workers(cuda) == workers
