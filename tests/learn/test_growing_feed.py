"""Training on a recording that grows: it takes in new episodes when told to, and a resumed run sees what an unbroken one does."""

from __future__ import annotations

import numpy as np
import torch
from tests.data.layouts import layout_of
from tests.learn.small import BARE
from tests.learn.stopping import quiet

from terrella.core.world import make_rng
from terrella.data import Dataset, Recorder
from terrella.learn.growing_feed import GrowingFeed
from terrella.learn.recipes.video import train_video
from terrella.learn.recipes.video_flat import FlowRecipe
from terrella.learn.run_folder import load_run, resume_file
from terrella.learn.train_step import TrainStep


class Numbers:
    """A feed of numbers that go up."""

    def __init__(self, first: int):
        self.next = first

    def batch(self, now: TrainStep) -> int:
        self.next += 1
        return self.next - 1

    def state(self) -> dict:
        return {"next": self.next}

    def resume(self, state) -> None:
        self.next = state["next"]


def now(number: int) -> TrainStep:
    return TrainStep(number, 0.0, torch.device("cpu"), np.random.default_rng(number), make_rng(number))


def test_what_was_recorded_since_is_taken_in_when_it_is_enough_and_resumes_exactly():
    disk = [0, 0]
    make = lambda: GrowingFeed(Numbers(0), 100, lambda: (disk[0], disk[1]), lambda n: (Numbers(1000 * n), 50 * n))  # noqa: E731
    feed = make()
    assert not feed.pick_up() and [feed.batch(now(step)) for step in range(5)] == [0, 1, 2, 3, 4]
    old = feed.state()
    assert old == {"next": 5}, "as of a recording that does not grow"
    disk[:] = 1, 9
    assert not feed.pick_up(), "too little to build a cache for"
    disk[:] = 2, 100
    assert feed.pick_up() and feed.further == 100
    seen = [feed.batch(now(step)) for step in range(5, 45)]
    assert 10 < sum(number >= 2000 for number in seen) < 30, "as often as its rows say"
    disk[:] = 7, 350
    again = make()
    again.resume(feed.state())
    assert again.further == 100, "no more than the run had taken in"
    assert [again.batch(now(step)) for step in range(45, 65)] == [feed.batch(now(step)) for step in range(45, 65)]
    before = make()
    before.resume(old)
    assert before.batch(now(5)) == 5


def recorded(folder, episodes: int, shade: int):
    with Recorder(folder, layout_of(10.0, ("right",), rgb=(24, 32))) as recorder:
        for _ in range(episodes):
            for row in range(40):
                picture = np.full((24, 32, 3), shade, np.uint8)
                picture[:, (row % 30) : (row % 30) + 3] = 255
                recorder.add({"rgb": picture}, np.array([row % 2]) if row < 39 else None, 0.0, False)
            recorder.end_episode()
    return folder


def test_a_training_learns_what_is_recorded_meanwhile(tmp_path, monkeypatch):
    first, further, said = recorded(tmp_path / "first", 4, 40), tmp_path / "further", []
    picked, pick_up = [], GrowingFeed.pick_up

    def grows(feed):
        if not further.exists():
            recorded(further, 3, 90)
        picked.append(pick_up(feed))
        return picked[-1]

    monkeypatch.setattr(GrowingFeed, "pick_up", grows)
    shown = []
    make = FlowRecipe._further_feed
    monkeypatch.setattr(FlowRecipe, "_further_feed", lambda *given: shown.append(make(*given)) or shown[-1])
    settings = {"steps": 32, "strip_every_s": 0.0, "channels": (8, 8, 8), "geometry": False}
    config = type(BARE)(**{**vars(BARE), **settings})
    train_video(first, tmp_path / "run", config, quiet, say=said.append, meanwhile=further)
    assert picked[0] and not any(picked[1:]) and said[-1] == "It trains on 120 frames more, recorded meanwhile."
    assert shown[0][1] == Dataset(further).length
    state = (load_run(resume_file(tmp_path / "run", "flow"), {}, {}) or {})["feed"]
    assert state["episodes"] == 3 and {"first", "other"} <= set(state)
