"""Laws of physics: the truth passes, an injected violation does not, and bad input gets a sentence."""

import functools
import json
from dataclasses import replace
from typing import Any, Literal

import pytest
import torch

import terrella
from terrella.core import make_rng, rollout
from terrella.core.errors import ChannelError, TerrellaError
from terrella.physics import LAWS, PhysicalSystem, RigidBody, Rod, Slot, Wall, calibrate, certify, trajectory_of
from terrella.physics.constants import friction, gravity, restitution
from terrella.physics.gaps import body_gaps, wall_gaps
from terrella.physics.laws.energy import energy, energy_scale
from terrella.physics.tolerance import detection, false_alarm_rate
from terrella.sim.bodies import FAMILIES, BodiesConfig, BodiesWorld

STEPS = 40
FLOOR = Wall((0.0, 0.0, 0.0), normal=(0.0, 0.0, 1.0))
UPRIGHT = torch.tensor([1.0, 0, 0, 0]).double()


@functools.cache
def truth(family: str, seed: int, batch: int, split: Literal["in", "out"] = "in"):
    world = BodiesWorld(family, BodiesConfig(split, pictures=False))
    system = PhysicalSystem.from_json(world.spec.system)
    waits = torch.zeros(STEPS, batch, dtype=torch.long)
    seen = rollout(world, world.start(batch, make_rng(seed)), waits, make_rng(0), system.channels).observations
    return trajectory_of(system, seen, world.spec.dt_s)


@pytest.mark.parametrize("family", FAMILIES)
def test_the_truth_passes_and_injected_violations_of_twice_the_tolerance_do_not(family):
    held_out, count = truth(family, 2, 100), 0
    for tolerance in calibrate(truth(family, 1, 200)):
        assert not tolerance.wrong_here, tolerance
        assert false_alarm_rate(tolerance, held_out) <= 0.01, tolerance.law.name
        assert false_alarm_rate(tolerance, truth(family, 3, 100, "out")) <= 0.01, tolerance.law.name
        hits, tried = detection(tolerance, held_out)
        assert hits >= 0.95 * tried, tolerance.law.name
        count += tried > 0
    assert count >= 3


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mujoco:blocks", "physics:stacking"])
def test_tolerances_calibrated_on_mujoco_hold_and_detect(name):
    pytest.importorskip("mujoco")
    options: dict[str, Any] = {"cameras": (), "threads": 1} if name.startswith("mujoco") else {"pictures": False}
    world = terrella.load(name, **options)
    system = PhysicalSystem.from_json(world.spec.system)
    assert not system.hidden

    def motion(seed: int, batch: int):
        rng = make_rng(seed)
        actions = torch.stack([world.spec.sample_action(batch, rng) for _ in range(4)]).repeat_interleave(10, 0)
        seen = rollout(world, world.start(batch, rng), actions, rng, system.channels).observations
        return trajectory_of(system, seen, world.spec.dt_s)

    held_out = motion(2, 200)
    for tolerance in calibrate(motion(1, 200)):
        assert false_alarm_rate(tolerance, held_out) <= 0.015, tolerance.law.name
        hits, tried = detection(tolerance, held_out)
        near_others = (
            name == "physics:stacking" and tolerance.law.name == "support and friction"
        )  # a pull may touch a neighbour
        assert tolerance.wrong_here or hits >= (0.75 if near_others else 0.95) * tried, tolerance.law.name


@pytest.mark.parametrize(("family", "estimate", "value"), [
    ("parabola", gravity, 9.81), ("bouncing", gravity, 9.81), ("bouncing", restitution, 0.8), ("rolling", friction, 0.2),
])  # fmt: skip
def test_constants_are_recovered(family, estimate, value):
    values = estimate(truth(family, 1, 200))
    known = values[values.isfinite()]
    assert len(known) > 50
    assert float(known.mean()) == pytest.approx(value, rel=0.02)


def test_a_bounce_in_mid_air_does_not_move_gravity():
    """Balls fall from 50 m and turn round once in mid-air, as predictions do where no floor is."""
    time_s = 0.02 * torch.arange(24.0)[:, None, None]
    kick = torch.tensor([0.0, 0.0, 6.0]) * (time_s > 0.2)
    speed = torch.tensor([0.0, 0.0, -9.81]) * time_s + kick
    place = torch.tensor([0.0, 0.0, 50.0]) + torch.cat([torch.zeros(1, 1, 3), 0.02 * speed[:-1]]).cumsum(0)
    motion = trajectory_of(falling(), {"x": place, "v": speed}, 0.02)
    assert float(motion.velocity[..., 2].diff(dim=0).mean()) / 0.02 > 0, "the mean acceleration points upwards"
    assert float(gravity(motion)) == pytest.approx(9.81, rel=1e-3)


def test_a_bounce_that_is_blurred_over_two_steps_keeps_its_restitution():
    """Predictions have a slower ball in the instant after a bounce."""
    motion = truth("bouncing", 1, 200)
    speed = motion.velocity.clone()
    after = (speed[1:, ..., 2] > 0) & (speed[:-1, ..., 2] < 0)
    speed[1:][after] *= 0.2
    values = restitution(replace(motion, velocity=speed))
    assert float(values[values.isfinite()].mean()) == pytest.approx(0.8, rel=0.02)


def test_a_constant_that_a_family_does_not_show_is_not_a_number():
    assert gravity(truth("uniform", 1, 200)).isnan().all()
    assert friction(truth("pendulum", 2, 100)).isnan().all()


def falling(count: int = 1, **changes):
    """A system of balls over a floor, with its channels for T + 1 = 6 instants of 2 rollouts."""
    bodies = tuple(
        RigidBody(f"ball {at}", Slot("x", 3 * at), Slot("v", 3 * at), radius_m=0.1, friction=0.5) for at in range(count)
    )
    return PhysicalSystem(bodies, (FLOOR,), **changes)


def test_a_body_that_hangs_in_the_air_breaks_free_fall():
    place = torch.tensor([0.0, 0, 5]).expand(6, 2, 3)
    motion = trajectory_of(falling(), {"x": place, "v": torch.zeros(6, 2, 3)}, 0.02)
    residual = {law.name: law.residual(motion).amax() for law in LAWS if not law.missing(motion.system)}
    assert float(residual["free fall"]) == pytest.approx(9.81)
    assert float(residual["non-penetration"]) == 0


def test_a_body_at_rest_on_the_floor_breaks_nothing():
    place = torch.tensor([0.0, 0, 0.1]).expand(6, 2, 3)
    motion = trajectory_of(falling(), {"x": place, "v": torch.zeros(6, 2, 3)}, 0.02)
    for law in LAWS:
        if not law.missing(motion.system):
            assert float(law.residual(motion).max()) < 1e-6, law.name


def test_two_bodies_that_begin_inside_each_other_break_non_penetration_at_once():
    place = torch.tensor([0.0, 0, 5, 0.1, 0, 5]).expand(6, 2, 6)
    motion = trajectory_of(falling(2), {"x": place, "v": torch.zeros(6, 2, 6)}, 0.02)
    law = next(law for law in LAWS if law.name == "non-penetration")
    assert float(law.residual(motion)[0, 0]) == pytest.approx(0.1)


def test_a_certificate_says_where_and_for_how_long():
    held = truth("parabola", 2, 100)
    tolerances = calibrate(truth("parabola", 1, 200))
    velocity = held.velocity.clone()
    velocity[11:, 3] += 1.0  # from instant 11, the end of step 11, on
    found_out = certify(replace(held, velocity=velocity), tolerances)
    at = found_out.laws.index("free fall")
    assert bool(found_out.broken[3, at]) and int(found_out.first[3, at]) == 11 and int(found_out.horizon[3]) == 10
    assert int(found_out.horizon[4]) == STEPS
    assert not bool(found_out.broken[:3].any())


def test_a_truth_that_breaks_a_law_is_named_and_left_out():
    motion = truth("parabola", 1, 200)
    heavy = replace(motion, system=replace(motion.system, gravity_m_s2=(0.0, 0.0, -20.0)))
    tolerances = {one.law.name: one for one in calibrate(heavy)}
    assert "the truth itself breaks it" in tolerances["free fall"].wrong_here
    assert "free fall" not in certify(heavy, list(tolerances.values())).laws


def test_few_rollouts_say_how_many_false_alarms_to_expect():
    few = truth("parabola", 1, 200).at(torch.arange(9))
    assert {round(one.false_alarms, 3) for one in calibrate(few)} == {0.1}


def test_missing_channels_and_short_ones_are_named():
    with pytest.raises(ChannelError, match="need the channels v"):
        trajectory_of(falling(), {"x": torch.zeros(2, 1, 3)}, 0.02)
    with pytest.raises(ChannelError, match="has 2 numbers; the system needs 3"):
        trajectory_of(falling(), {"x": torch.zeros(2, 1, 2), "v": torch.zeros(2, 1, 3)}, 0.02)


def test_a_law_names_what_it_lacks():
    lone = PhysicalSystem((RigidBody("ball", Slot("x"), driven=True),))
    needs = {law.name: law.missing(lone) for law in LAWS}
    assert needs["energy"] == "needs a body that nothing drives"
    assert needs["momentum"] == "needs two bodies that nothing drives"
    assert needs["continuity"] == ""
    assert "gripper" in LAWS[1].missing(falling(hidden=("gripper",)))


def test_a_system_survives_json_and_refuses_nonsense():
    for family in FAMILIES.values():
        facts = json.loads(json.dumps(family.system.to_json()))
        assert PhysicalSystem.from_json(facts) == family.system
    with pytest.raises(TerrellaError, match="body 0 has an unknown key 'colour'"):
        PhysicalSystem.from_json({"bodies": [{"name": "a", "position": {"channel": "x"}, "colour": "red"}]})
    with pytest.raises(TerrellaError, match="one body or more"):
        PhysicalSystem.from_json({"bodies": []})
    body = {"name": "a", "position": {"channel": "x"}}
    for part, said in (
        ({"bodies": [{**body, "mass_kg": "heavy"}]}, "body 0 mass_kg = 'heavy' should be of type float"),
        ({"bodies": [body], "gravity_m_s2": [0, 0]}, "gravity_m_s2 has 2 values; it needs 3"),
        ({"bodies": [body], "walls": [{"centre_m": [0, 0, 0], "normal": [0, 0, 2]}]}, "the length 1"),
        ({"bodies": [body], "axes": [0, 0]}, "each once"),
        ({"bodies": [body], "limits": [{"name": "l", "slot": {"channel": "x"}, "low": 1, "high": 0}]}, "low is below"),
    ):
        with pytest.raises(TerrellaError, match=said):
            PhysicalSystem.from_json(part)
    with pytest.raises(TerrellaError, match="a rod holds"):
        PhysicalSystem((RigidBody("a", Slot("x")),), rods=(Rod("b", (0.0, 0.0, 0.0), 1.0),))


def test_gaps_of_boxes_and_spheres_are_exact():
    half = torch.tensor([[0.1, 0.2, 0.3], [0.0, 0.0, 0.0], [0.1, 0.1, 0.1]]).double()
    place = torch.tensor([[0.0, 0, 0], [0.0, 0, 0.55], [0.25, 0, 0]]).double()[None, None]
    radius = torch.tensor([0.0, 0.2, 0.0]).double()[None, None]
    gaps = body_gaps(place, UPRIGHT.expand(1, 1, 3, 4), half, radius)[0, 0]
    assert float(gaps[0, 1]) == pytest.approx(0.05)
    assert float(gaps[0, 2]) == pytest.approx(0.05)
    turned = torch.stack([UPRIGHT, UPRIGHT, torch.tensor([0.9238795, 0, 0, 0.3826834]).double()])[None, None]
    assert float(body_gaps(place, turned, half, radius)[0, 0, 0, 2]) == pytest.approx(0.15 - 0.1 * 2**0.5, abs=1e-5)
    walls = wall_gaps(place, turned, half, radius, (FLOOR, Wall((0.0, 0.0, 2.0), (5.0, 5.0, 1.0))))[0, 0]
    assert float(walls[0, 0]) == pytest.approx(-0.3) and 0 < float(walls[0, 1]) <= 0.7  # far away a lower bound
    assert walls[1].tolist() == pytest.approx([0.35, 0.25])


def test_a_mujoco_model_describes_its_bodies_walls_and_limits(tmp_path):
    pytest.importorskip("mujoco")
    (tmp_path / "nested.xml").write_text(
        "<mujoco><worldbody><geom type='plane' size='1 1 1'/><body pos='0 0 1'><body pos='0 2 0'><geom type='box' size='1 1 1'/>"
        "</body></body><body name='ball' pos='0 0 4'><freejoint/><geom size='0.1' mass='2'/></body>"
        "<body name='flap'><joint name='hinge' range='-30 60' limited='true'/><geom type='capsule' size='0.1 1'/></body>"
        "</worldbody></mujoco>"
    )
    system = PhysicalSystem.from_json(terrella.load(f"mujoco:{tmp_path / 'nested.xml'}", cameras=()).spec.system)
    assert [(body.name, body.radius_m, body.mass_kg) for body in system.bodies] == [("ball", 0.1, 2.0)]
    assert [wall.centre_m for wall in system.walls] == [(0.0, 0.0, 0.0), (0.0, 2.0, 1.0)]
    assert system.hidden == ("flap",) and "flap" in LAWS[1].missing(system)
    assert [(one.name, round(one.high, 3)) for one in system.limits] == [("hinge", 1.047)]


def without_velocities(motion):
    """The same motion, from positions alone."""
    bodies = tuple(replace(body, velocity=None) for body in motion.system.bodies)
    return trajectory_of(replace(motion.system, bodies=bodies), motion.channels, motion.dt_s)


def test_a_body_at_rest_has_no_speed_where_only_its_position_is_known():
    seen = {"position": torch.tensor([0.0, 0.2]).expand(12, 3, 2)}
    ball = RigidBody("ball", Slot("position"), radius_m=0.2)
    motion = trajectory_of(PhysicalSystem((ball,), (FLOOR,), axes=(0, 2)), seen, 0.025)
    assert float(motion.velocity.abs().max()) == 0
    assert float(energy(motion).std(0).max()) == 0


@pytest.mark.parametrize("family, most", [("pendulum", 0.002), ("parabola", 1e-6)])
def test_energy_is_constant_where_only_positions_are_known(family, most):
    motion = without_velocities(truth(family, 2, 100))
    assert float((energy(motion).std(0) / energy_scale(motion)[-1]).max()) < most


def test_positions_alone_give_the_speed_of_flight():
    motion = truth("parabola", 2, 100)
    assert torch.allclose(without_velocities(motion).velocity, motion.velocity, atol=1e-4)


def test_energy_is_taken_from_a_rise_without_speed():
    """A ball that creeps upwards on the floor, as weak worlds have it, sinks back; its mates do not move."""
    bodies = tuple(
        RigidBody(name, Slot("place", 3 * at), Slot("speed", 3 * at), radius_m=0.1) for at, name in enumerate("ab")
    )
    place = torch.tensor([0.0, 0, 0.1, 5, 0, 0.1]).repeat(3, 1, 1)
    place[2, 0, 2] += 0.01
    motion = trajectory_of(PhysicalSystem(bodies, (FLOOR,)), {"place": place, "speed": torch.zeros(3, 1, 6)}, 0.02)
    law = next(one for one in LAWS if one.name == "energy")
    assert float(law.residual(motion)[-1]) > 0.01
    mended = law.correct(motion)
    assert float(law.residual(mended)[-1]) < 1e-6
    assert torch.allclose(mended.position[-1], motion.position[-2], atol=1e-6)


def test_turning_is_energy_too():
    ball = RigidBody("a", Slot("place"), Slot("speed"), spin=Slot("spin"), radius_m=0.1)
    rows = {"place": torch.zeros(3, 1, 3) + 5, "speed": torch.zeros(3, 1, 3), "spin": torch.ones(3, 1, 3)}
    rows["spin"][2] = 3.0
    motion = trajectory_of(PhysicalSystem((ball,), gravity_m_s2=(0.0, 0.0, 0.0)), rows, 0.02)
    law = next(one for one in LAWS if one.name == "energy")
    assert torch.allclose(law.correct(motion).spin[-1], motion.spin[-2], atol=1e-6)
