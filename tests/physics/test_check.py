"""`check` from outside: the truth passes, a world that invents is accused, and bad input gets a sentence."""

import dataclasses
import json
import re

import numpy as np
import pytest
import torch

from terrella.core import make_rng, rollout
from terrella.core.errors import DatasetError, TerrellaError
from terrella.core.policy import Idle
from terrella.data import record
from terrella.measure.page_parts import COLOURS
from terrella.measure.physics import examine_physics, physics_verdict
from terrella.measure.physics_film import film_of_bodies, framed
from terrella.measure.physics_page import physics_page
from terrella.measure.plot import Line, line_chart
from terrella.physics import PhysicalSystem, trajectory_of
from terrella.physics.laws.non_penetration import begins_inside
from terrella.sim.bodies import BodiesConfig, BodiesWorld
from terrella.workflows.check import CheckConfig, check


def motion(family: str, seed: int, batch: int, steps: int = 24):
    world = BodiesWorld(family, BodiesConfig(pictures=False))
    system = PhysicalSystem.from_json(world.spec.system)
    waits = torch.zeros(steps, batch, dtype=torch.long)
    seen = rollout(world, world.start(batch, make_rng(seed)), waits, make_rng(0), system.channels).observations
    return system, dict(seen), world.spec.dt_s


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bodies") / "rec"
    world = BodiesWorld("bouncing", BodiesConfig(pictures=False))
    record(world, Idle(world.spec), folder, 520, make_rng(0))
    return folder


def test_the_truth_keeps_its_own_laws(recording, tmp_path):
    result = check("physics:bouncing", CheckConfig(recording, out=tmp_path, steps=16, rollouts=8, fresh=True))
    assert result.report.coarse_horizon.value == 16
    assert all(one.broken.value == 0 for one in result.report.laws)
    facts = json.loads((tmp_path / "check.json").read_text())
    assert facts["verdict"][0].startswith("Keeps the laws for 16 of 16 steps")
    assert {one["name"] for one in facts["laws"]} >= {"energy", "free fall", "non-penetration"}
    assert "momentum" in facts["missing"]
    page = (tmp_path / "check.html").read_text()
    assert "The truth above, the world below" in page and "restitution" in page


def test_half_the_gravity_is_seen_and_measured():
    system, seen, dt_s = motion("parabola", 1, 150)
    known = trajectory_of(system, seen, dt_s)
    system, seen, dt_s = motion("parabola", 2, 30)
    truth = trajectory_of(system, seen, dt_s)
    time_s = torch.arange(25)[:, None] * dt_s
    seen["position"] = seen["position"].clone()
    seen["velocity"] = seen["velocity"].clone()
    seen["position"][..., 1] += 0.25 * 9.81 * time_s**2
    seen["velocity"][..., 1] += 0.5 * 9.81 * time_s
    report = examine_physics("half", known, truth, trajectory_of(system, seen, dt_s))
    fall = next(one for one in report.laws if one.name == "free fall")
    assert fall.broken.value == 1 and fall.violation.value == pytest.approx(4.9, rel=0.01)
    assert report.constants[0].dream.value == pytest.approx(4.905, rel=0.01)
    assert report.coarse_horizon.value == 0
    assert any("free fall: broken in 100%" in line for line in physics_verdict(report))
    assert "free fall" in physics_page("half", report)
    worst = report.worst
    assert worst is not None and worst.law == "free fall" and max(worst.by_step) > worst.tolerance
    assert "breaks free fall by most, by 4.9 m/s2 in step" in physics_page("half", report)
    same = physics_page("truth", examine_physics("truth", known, truth, truth))
    assert "No rollout visibly breaks a law. Shown: the one that comes nearest" in same


def test_a_frozen_world_is_seen_by_how_far_its_bodies_go():
    system, seen, dt_s = motion("uniform", 2, 120)
    truth = trajectory_of(system, seen, dt_s)
    still = {name: part[:1].expand_as(part) for name, part in seen.items()}
    still["velocity"] = torch.zeros_like(still["velocity"])
    report = examine_physics("frozen", truth, truth, trajectory_of(system, still, dt_s))
    assert report.change is not None and report.change.value == 0


def test_films_show_the_body_where_it_is():
    system, seen, dt_s = motion("bouncing", 2, 4)
    frames = film_of_bodies(trajectory_of(system, seen, dt_s))
    assert frames.shape == (25, 220, 220, 3)
    assert len({frame.tobytes() for frame in frames}) > 20


def test_frames_that_break_the_law_are_red_at_the_edge():
    frames = np.zeros((3, 20, 20, 3), np.uint8)
    marked = framed(frames, [False, True, False])
    assert marked[1, 0, 0].tolist() == [214, 69, 69] and not marked[1, 10, 10].any() and not marked[[0, 2]].any()


def test_labels_of_small_values_are_not_cut():
    x, y = [1.0, 2.0, 3.0], [1e-4, 2e-4, 3e-4]
    line = Line("a", x, y, y, y, COLOURS[0])
    svg = line_chart([line], [], "steps", "m", y_range=(0.0, 6e-4))
    ends = [float(at) for at in re.findall(r'<text x="([0-9.]+)" y="[0-9.]+" text-anchor="end">0.0006', svg)]
    assert ends and ends[0] >= 7 * len("0.0006")


def test_bodies_that_begin_inside_each_other_are_named(recording, tmp_path):
    truth = trajectory_of(*motion("collision", 1, 6))
    assert begins_inside(truth, 1e-3) == ""
    inside = truth.position.clone()
    inside[0, 2, 1] = inside[0, 2, 0] + 0.01
    words = begins_inside(dataclasses.replace(truth, position=inside), 1e-3)
    assert words.startswith("ball 1 begins 0.") and "m inside ball 2, and 1 of 6 true rollouts" in words
    system = BodiesWorld("bouncing").family.system
    large = dataclasses.replace(system.bodies[0], radius_m=0.7)
    (tmp_path / "large.json").write_text(json.dumps(dataclasses.replace(system, bodies=(large,)).to_json()))
    config = CheckConfig(recording, system=str(tmp_path / "large.json"), out=tmp_path, steps=8, rollouts=4)
    result = check("physics:bouncing", config)
    assert "inside a wall, and" in result.summary() and "the truth itself breaks it" in result.summary()


def test_bad_input_gets_a_sentence(recording, tmp_path):
    with pytest.raises(TerrellaError, match="--rollouts and --steps are 2 or more"):
        check("physics:bouncing", CheckConfig(recording, steps=1))
    with pytest.raises(TerrellaError, match="--seed is 0 or more; got -1"):
        check("physics:bouncing", CheckConfig(recording, seed=-1))
    with pytest.raises(TerrellaError, match="is no JSON file"):
        check("physics:bouncing", CheckConfig(recording, system=str(tmp_path / "none.json")))
    with pytest.raises(DatasetError, match="no window of 104 rows .* take fewer --steps, or record longer"):
        check("physics:bouncing", CheckConfig(recording, steps=100))
    with pytest.raises(TerrellaError, match="cannot render"):
        check("physics:bouncing", CheckConfig(recording, system="physics:rolling"))
