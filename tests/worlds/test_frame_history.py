"""A frames-only world: an episode begins, stands still until it has learned otherwise, and is the same after a save."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from gymnasium import spaces

from terrella.core import check_world, make_rng
from terrella.core.errors import ActionError
from terrella.worlds.config import VideoConfig
from terrella.worlds.controls import AXES, CHOICE, Controls
from terrella.worlds.folder import load_world, save_world
from terrella.worlds.frame_history import FrameHistory, StartClips
from terrella.worlds.generator import UNet
from terrella.worlds.learned import About, LearnedWorld
from terrella.worlds.outcome import FrameOutcome, OutcomeConfig

SIZE = (16, 24)


def made(controls: Controls, vitals: tuple[str, ...] = ()) -> LearnedWorld:
    torch.manual_seed(0)
    config = VideoConfig((1.0, 1.0, 0.5, 0.5), controls.numbers, SIZE, (8, 8), slots=4, geometry=False, residual=True)
    frames = torch.randint(0, 255, (3, 4, 3, *SIZE), dtype=torch.uint8)
    first = torch.tensor([[3.0], [2.0], [1.0]])[:, : len(vitals)]
    starts = replace(StartClips.of(frames, controls.numbers), actions=torch.rand(3, 4, controls.numbers), vitals=first)
    changes, spans, begins = ((-1.0, 0.0),) * len(vitals), (3.0,) * len(vitals), (2.0,) * len(vitals)
    outcome = FrameOutcome(OutcomeConfig(controls.numbers, (0.0, 1.0), vitals, changes, spans, begins=begins))
    scene, generator = FrameHistory(config.frames, starts), UNet(config.generator)
    return LearnedWorld(About("made", controls, 0.1), scene=scene, generator=generator, outcome=outcome)


CHOICES = Controls(CHOICE, (2.0,), (5.0,))
STEERING = Controls(AXES, (-1.0, 0.0), (1.0, 4.0))


@pytest.mark.parametrize("controls", [Controls.buttons(3), CHOICES, STEERING])
def test_every_kind_of_action_keeps_the_contract(controls):
    world = made(controls, ("lives",))
    assert "states_are_values" in check_world(world, steps=3) and world.spec.may_observe == ("lives",)


def test_what_networks_take_of_an_action():
    assert CHOICES.space() == spaces.Discrete(4, start=2)
    assert CHOICES.encode(torch.tensor([2, 5, 3])).tolist() == [[1, 0, 0, 0], [0, 0, 0, 1], [0, 1, 0, 0]]
    assert STEERING.encode(torch.tensor([[-1.0, 4.0], [0.0, 2.0], [1.0, 0.0]])).tolist() == [[-1, 1], [0, 0], [1, -1]]
    buttons = torch.tensor([[1, 0, 1]], dtype=torch.int8)
    assert Controls.buttons(3).encode(buttons).tolist() == [[1, 0, 1]]
    with pytest.raises(ActionError):
        made(CHOICES).imagine(made(CHOICES).start(1, make_rng(0)), torch.tensor([1]), make_rng(0))


def test_untrained_it_stands_still():
    """What is learned is what changes: before that, nothing does, to the last digit."""
    world, rng = made(CHOICES), make_rng(0)
    state = world.start(3, rng)
    after = world.imagine(state, torch.tensor([2, 3, 4]), rng)
    assert torch.equal(after["frames"][:, 0], state["frames"][:, 0])
    assert torch.equal(after["frames"][:, 1:], state["frames"][:, :-1])


def test_a_saved_world_begins_and_goes_on_alike(tmp_path):
    world = made(CHOICES, ("lives",))
    with torch.no_grad():
        world.generator.output.weight.normal_(0, 0.05)
    save_world(world, tmp_path / "world")
    loaded = load_world(tmp_path / "world")
    assert loaded.controls == CHOICES and loaded.outcome.config == world.outcome.config
    assert torch.equal(loaded.starts.vitals, world.starts.vitals)
    assert torch.equal(loaded.starts.actions, world.starts.actions)
    assert (loaded.starts.frames.int() - world.starts.frames.int()).abs().float().mean() < 2, "kept as fine JPEG"
    state = world.start(2, make_rng(0))
    ways = [one.imagine(state, torch.tensor([2, 5]), make_rng(1)) for one in (world, loaded)]
    assert ways[0] == ways[1]


def test_a_lone_picture_begins_with_the_usual_vitals_and_says_what_it_is_told(tmp_path):
    world, picture = made(CHOICES, ("lives",)), torch.from_numpy(np.full((2, *SIZE, 3), 7, np.uint8))
    alone = world.observe({"rgb": picture}, None, make_rng(0))
    assert alone["vitals"].tolist() == [[2.0], [2.0]]
    told = world.observe({"rgb": picture, "lives": torch.tensor([3.0, 1.0])}, alone, make_rng(0))
    assert world.render(told, ("lives",))["lives"].tolist() == [3.0, 1.0]
