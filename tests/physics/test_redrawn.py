"""A guard over pictures: what vanishes is drawn again where it was going, and what is set elsewhere is moved there."""

from dataclasses import replace

import pytest
import torch

from terrella.core import State, make_rng
from terrella.core.errors import TerrellaError
from terrella.physics import Guarded, PhysicalSystem
from terrella.physics.laws.permanence import Permanence
from terrella.physics.redrawn import RedrawnWorld
from terrella.physics.tolerance import Tolerance
from terrella.physics.tracker import fit_tracker
from terrella.physics.tracks import HERE, PLACE, RADIUS, Tracked, _upright, tracked_system
from terrella.sim.bodies import BodiesConfig, BodiesWorld

SIDE = 64


class Forgetful:
    """A world of pictures alone that moves what it sees by two pixels a step, and loses it in the fourth step."""

    def __init__(self):
        self.bodies = BodiesWorld("uniform")
        self.spec = replace(
            self.bodies.spec,
            name="forgetful",
            observes=("rgb",),
            channels={name: self.bodies.spec.channels[name] for name in ("rgb", "done")},
            system={},
        )

    def start(self, batch, rng):
        return self.observe(self.bodies.render(self.bodies.start(batch, rng), ("rgb",)), None, rng)

    def observe(self, observation, prior, rng):
        age = torch.zeros(len(observation["rgb"]), dtype=torch.long) if prior is None else prior["age"]
        return State({"rgb": observation["rgb"], "age": age, "done": torch.zeros(len(age), dtype=torch.bool)})

    def imagine(self, state, action, rng):
        empty = torch.tensor((16, 20, 27), dtype=torch.uint8).expand_as(state["rgb"])
        gone = (state["age"] == 3)[:, None, None, None]
        return state.replace(rgb=torch.where(gone, empty, state["rgb"].roll(2, 2)), age=state["age"] + 1)

    def render(self, state, channels):
        return {name: state[name] for name in channels}


def guarded(batch: int):
    world = Forgetful()
    start = world.bodies.start(batch, make_rng(1))
    pictures = torch.cat(
        [world.bodies.render(world.bodies.start(30, make_rng(seed)), ("rgb",))["rgb"] for seed in range(2)]
    )
    system = tracked_system(PhysicalSystem.from_json(world.bodies.spec.system))
    tracked = Tracked(fit_tracker(pictures), system, _upright(0.1, SIDE, "the test"))
    redrawn = RedrawnWorld(world, tracked)
    return redrawn, Guarded(redrawn, redrawn.system, [Tolerance(Permanence(), 0.5, 200, 0.005)]), start


def test_what_vanishes_is_drawn_again_where_it_was_going():
    redrawn, guard, start = guarded(6)
    picture, waits = redrawn.world.bodies.render(start, ("rgb",)), torch.zeros(6, dtype=torch.long)
    state = guard.observe(picture, None, make_rng(0))
    first = guard.render(state, (PLACE,))[PLACE][:, :2]
    for _ in range(6):
        state = guard.imagine(state, waits, make_rng(0))
    shown = guard.render(state, (PLACE, HERE, "rgb"))
    assert bool((shown[HERE][:, 0] == 1).all())
    way = (shown[PLACE][:, :2] - first) / 0.1
    assert torch.allclose(way, torch.tensor([12.0, 0.0]).double().expand(6, 2), atol=0.3)
    seen = redrawn.tracked.tracker.areas(shown["rgb"])[:, 0]
    assert torch.allclose(redrawn.tracked.scale.metres(seen[:, 1:3]), shown[PLACE][:, :2], atol=0.02)
    report = guard.report(state)
    assert report.broken["permanence"] == pytest.approx(1 / 6) and report.left["permanence"] == 0
    assert report.change > 0.9 and not report.frozen


def test_a_thing_is_moved_in_the_picture():
    redrawn, _, start = guarded(4)
    picture = redrawn.world.bodies.render(start, ("rgb",))
    state = redrawn.observe(picture, None, make_rng(0))
    given = redrawn.render(state, (PLACE, HERE, RADIUS))
    given[PLACE] = given[PLACE] + torch.tensor([0.33, -0.21, 0.0, 0.0])  # 3.3 pixels to the right, 2.1 down
    after = redrawn.observe(given, state, make_rng(0))
    before, moved = (redrawn.tracked.tracker.areas(part["rgb"])[:, 0] for part in (picture, after))
    assert torch.allclose(moved[:, 1:3] - before[:, 1:3], torch.tensor([3.3, 2.1]).double().expand(4, 2), atol=0.1)
    assert torch.allclose(moved[:, 0], before[:, 0], rtol=0.05)


def test_a_world_without_pictures_cannot_be_redrawn():
    redrawn, _, _ = guarded(1)
    with pytest.raises(TerrellaError, match="observes no picture"):
        RedrawnWorld(BodiesWorld("uniform", BodiesConfig(pictures=False)), redrawn.tracked)
    with pytest.raises(TerrellaError, match="begins with a picture"):
        redrawn.observe({PLACE: torch.zeros(1, 4)}, None, make_rng(0))
