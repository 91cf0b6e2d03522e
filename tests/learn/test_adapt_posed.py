"""adapt of a world with depth and poses: another body in its places, measured before and after."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.data.corridor import Corridor
from tests.learn.conftest import recorded
from tests.learn.haunted import Haunted
from tests.learn.stopping import quiet

from terrella.core.errors import DatasetError
from terrella.learn.recipes import adapt as adapting
from terrella.learn.recipes import adapt_frames
from terrella.learn.recipes.adapt import AdaptConfig, adapt
from terrella.learn.recipes.adapt_frames import _fitting, frame_errors, settings_of
from terrella.worlds.body import MotionBody
from terrella.worlds.folder import load_world

FEW = AdaptConfig(steps=4, batch=2)


def rushed(kind: type[Corridor]) -> Corridor:
    class Rushed(kind):
        """A body that is twice as fast."""

        def imagine(self, state, action, rng):
            return super().imagine(super().imagine(state, action, rng), action, rng)

    return Rushed()


@pytest.fixture(autouse=True)
def short_stages(monkeypatch):
    monkeypatch.setattr(adapt_frames, "ROLLOUTS", 4)
    monkeypatch.setattr(
        adapting,
        "settings_of",
        lambda world: replace(
            settings_of(world), motion_steps=20, outcome_steps=3, estimator_steps=3, uncertainty_frames=0
        ),
    )


def test_it_goes_on_in_the_places_of_the_new_recording_and_measures_both(shared, corridor, bare_run, tmp_path):
    world, new = load_world(bare_run[0] / "world"), recorded(shared, "rushed", rushed(Corridor))
    facts = adapt(world, new, tmp_path / "run", FEW, quiet, corridor)
    errors, adapted = facts["errors"], load_world(tmp_path / "run" / "world")
    before = world.generator.state_dict()
    apart = [(weight - before[name]).abs().max() for name, weight in adapted.generator.state_dict().items()]
    assert 0 < max(map(float, apart)) < 0.3, "a few steps from where the world was"
    fast, slow = (_fitting(world, one, quiet) for one in (new, corridor))
    poses = {tuple(pose) for pose in np.array(fast.cache.pose).tolist()}
    assert len(adapted.memory) == len(world.memory) and {tuple(pose) for pose in adapted.memory.pose.tolist()} <= poses
    assert errors["new"]["after"] == frame_errors(adapted, fast)
    assert errors["old"] == {
        "before": frame_errors(world, slow),
        "after": frame_errors(adapted.replaced(scene=world.scene), slow),
    }
    placed = world.replaced(scene=adapted.scene)
    assert errors["new"]["before"] == pytest.approx(frame_errors(placed, fast), rel=0.02), "with the new places"
    assert "On the old one" in facts["verdict"]
    assert adapt(world, new, tmp_path / "run", FEW, quiet, corridor)["errors"] == errors  # finished: as it was


def test_its_estimator_stays_for_the_same_camera(shared, corridor, posed_run, tmp_path):
    world, few = load_world(posed_run[0] / "world"), replace(FEW, steps=1)
    for data, same in ((corridor, True), (recorded(shared, "narrow", narrow()), False)):
        adapt(world, data, tmp_path / f"{same}", few, quiet)
        adapted = load_world(tmp_path / f"{same}" / "world")
        weights, kept = (one.estimator.state_dict() for one in (adapted, world))
        assert all(torch.equal(weights[name], kept[name]) for name in kept) == same
        assert adapted.estimator.config.camera == adapted.config.camera


def narrow() -> Corridor:
    """Seen by a camera with a narrower field of view."""
    world = Corridor()
    camera = replace(world.spec.cameras["rgb"], intrinsics=(0.7, 0.8, 0.5, 0.5))
    world.spec = replace(world.spec, cameras={"rgb": camera})
    return world


@pytest.mark.slow
def test_the_body_becomes_the_new_one(shared, bare_run, tmp_path, monkeypatch):
    monkeypatch.setattr(adapting, "settings_of", lambda world: replace(settings_of(world), motion_steps=1500))
    world, new = load_world(bare_run[0] / "world"), recorded(shared, "rushed", rushed(Corridor))
    adapt(world, new, tmp_path / "run", FEW, quiet)
    ahead = torch.tensor([[[1.0] + [0.0] * 5] * 9])
    body = load_world(tmp_path / "run" / "world").body
    assert isinstance(body, MotionBody)
    heading, step_m = torch.zeros(1), torch.zeros(1, 2)
    for _ in range(12):
        heading, step_m = body.motion(heading, step_m, ahead)
    assert float(step_m.norm()) == pytest.approx(0.5, rel=0.2), "0.25 m a step before"


def test_things_that_move_adapt_too(shared, haunted, haunted_run, tmp_path):
    world, new = load_world(haunted_run[0] / "world"), recorded(shared, "rushed-haunted", rushed(Haunted))
    facts = adapt(world, new, tmp_path / "run", FEW, quiet, haunted)
    adapted = load_world(tmp_path / "run" / "world")
    assert adapted.config.moving and adapted.config.vitals and set(facts["errors"]) == {"new", "old"}


def test_a_recording_without_what_marks_things_is_refused(corridor, haunted_run, tmp_path):
    with pytest.raises(DatasetError, match=r"holds no observation\.things"):
        adapt(load_world(haunted_run[0] / "world"), corridor, tmp_path / "run", FEW, quiet)
