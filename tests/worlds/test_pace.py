"""`play --fps`: a world of frames is drawn in as many steps as leave the pace, and what is given up is said."""

import pytest

import terrella
from terrella.core.errors import TerrellaError
from terrella.workflows import pace
from terrella.workflows import play as playing
from terrella.workflows.play import PlayConfig
from terrella.worlds.learned import LearnedWorld

from .test_flow import network, world


@pytest.mark.parametrize(("each_s", "fps", "steps", "said"), [
    (0.05, 10, 2, "keeps 10 frames a second in 2 drawing steps a frame, not 3"), (0.05, 5, 3, "keeps 5 frames a second, as it is"),
    (0.5, 4, 1, "cannot keep 4 frames a second here: 2 is the most, in 1 drawing step a frame, not 3"),
])  # fmt: skip
def test_a_pace_is_kept_by_fewer_drawing_steps(monkeypatch, each_s, fps, steps, said):
    words: list[str] = []
    monkeypatch.setattr(pace, "frame_s", lambda made: each_s * made.generator.config.steps)
    kept = pace.at_pace(world(network(moves=0)), fps, words.append)
    assert isinstance(kept, LearnedWorld) and kept.generator.config.steps == steps and said in words[0]


def test_a_pace_is_measured_and_at_most_the_worlds_own():
    assert 0 < pace.frame_s(world(network(moves=0))) < 10
    with pytest.raises(TerrellaError, match="has 10 steps a second"):
        pace.at_pace(world(network(moves=0)), 11, print)


def test_a_budget_of_memory_says_what_is_forgotten_sooner():
    words: list[str] = []
    for budget, said in (
        (4.0, "views of its way, in"), (16.0, "MiB an episode"), (0.0, "--memory-mb 0 cannot hold one"),
    ):  # fmt: skip
        pace.say_memory(terrella.load("doom-maze", memory_mb=budget), budget, words.append)
        assert said in words[-1] and ("older ones are forgotten sooner" in words[-1]) == (budget < 16)
    with pytest.raises(TerrellaError, match="keeps its last pictures alone"):
        pace.say_memory(world(network(moves=0)), 4.0, words.append)
    with pytest.raises(TerrellaError, match="--memory-mb -1 is no memory"):
        playing._check(PlayConfig(memory_mb=-1.0))
