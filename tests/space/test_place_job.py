"""Places that are made in the background: polled, resumed, refused."""

from __future__ import annotations

import fcntl
import json
import os
import threading

import pytest

import terrella
from terrella.core.errors import TerrellaError
from terrella.workflows import place_job
from terrella.workflows.build_space import BuildSpaceConfig
from terrella.workflows.splat_places import SpaceResult


@pytest.fixture
def making(monkeypatch):
    """Stands in for the work: it reports, waits for `go`, then answers or fails."""
    state = {"go": threading.Event(), "calls": [], "fails": ""}

    def make(out, name, source, settings, progress):
        state["calls"].append((name, source, settings))
        progress("half of it")
        assert state["go"].wait(20)
        if state["fails"]:
            raise TerrellaError(state["fails"])
        return SpaceResult({"world": str(out)}, ("made",))

    monkeypatch.setattr(place_job, "make_place", make)
    return state


def record(out):
    return out.with_name(out.name + ".job.json")


def test_a_job_begins_while_another_program_polls_it(tmp_path, making):
    making["go"].set()
    with open(tmp_path / "p.job.lock", "w") as polled:
        fcntl.flock(polled, fcntl.LOCK_SH)
        threading.Timer(0.1, fcntl.flock, (polled, fcntl.LOCK_UN)).start()
        assert terrella.start_place(tmp_path / "p", text="a room").wait(20).facts


def test_a_job_is_polled_and_its_result_awaited(tmp_path, making):
    job = terrella.start_place(tmp_path / "p", text="a room", config=BuildSpaceConfig(gaussians=2000))
    while job.status.text != "half of it":
        pass
    assert terrella.place_status(tmp_path / "p").state == job.status.state == "running"
    with pytest.raises(TerrellaError, match="is being made by process"):
        terrella.start_place(tmp_path / "p", text="a room")
    with pytest.raises(TerrellaError, match="not done after 0 s"):
        job.wait(0)
    making["go"].set()
    assert job.wait(20).summary() == "made" and terrella.place_status(tmp_path / "p").facts == {
        "world": str(tmp_path / "p")
    }
    with pytest.raises(TerrellaError, match="is done"):
        terrella.resume_place(tmp_path / "p")


def test_a_job_whose_process_ended_goes_on_with_its_own_settings(tmp_path, making):
    making["go"].set()
    terrella.start_place(tmp_path / "p", video="film.mp4").wait(20)
    lines = json.loads(record(tmp_path / "p").read_text())
    record(tmp_path / "p").write_text(
        json.dumps({**lines, "state": "running", "process": os.getpid()})
    )  # another program has its number now
    assert terrella.place_status(tmp_path / "p").state == "stopped"
    terrella.resume_place(tmp_path / "p").wait(20)
    first, again = making["calls"]
    assert first == again and first[:2] == ("video", "film.mp4")


def test_a_failure_is_a_sentence_and_can_be_tried_again(tmp_path, making):
    making.update(fails="film.mp4 does not exist; check the path.")
    making["go"].set()
    job = terrella.start_place(tmp_path / "p", image="film.mp4")
    with pytest.raises(TerrellaError, match="does not exist"):
        job.wait(20)
    assert terrella.place_status(tmp_path / "p").text == making["fails"]
    making["fails"] = ""
    assert terrella.resume_place(tmp_path / "p").wait(20).lines == ("made",)


def test_wrong_arguments_and_records_are_refused(tmp_path, making):
    for wrong in ({}, {"text": "a", "image": "b"}, {"sculpture": "a"}):
        with pytest.raises(TerrellaError, match="give one of text="):
            terrella.start_place(tmp_path / "p", **wrong)  # pyright: ignore[reportArgumentType]
    with pytest.raises(TerrellaError, match="start_place begins one"):
        terrella.resume_place(tmp_path / "p")
    for text in ("{", "[]", json.dumps({"state": "failed", "source": {}, "config": {}, "process": os.getpid()})):
        record(tmp_path / "p").write_text(text)
        with pytest.raises(TerrellaError, match="damaged"):
            terrella.resume_place(tmp_path / "p")
    assert not making["calls"]
