"""Guarded: a World that detects, corrects, counts and dumps; a correction that freezes motion is caught."""

import math
from contextlib import nullcontext
from dataclasses import replace

import pytest
import torch

import terrella
from terrella.core import State, check_world, make_rng, rollout
from terrella.core.backend import tensor_programs
from terrella.core.errors import TerrellaError
from terrella.physics import PhysicalSystem, calibrate, trajectory_of
from terrella.physics.guarded import GuardConfig, Guarded, replay_case
from terrella.physics.judge import Judge, changed_rollouts
from terrella.physics.laws.limits import Limits
from terrella.physics.system import Limit, RigidBody, Slot, Wall
from terrella.physics.tolerance import Tolerance
from terrella.sim.bodies import BodiesConfig, BodiesWorld

STEPS = 24


class Biased:
    """A family whose predictions are off: gravity is halved, and bodies stick in the floor."""

    def __init__(self, family: str, noise: float = 0.0):
        self.world, self.noise = BodiesWorld(family, BodiesConfig(pictures=False)), noise
        self.spec = replace(self.world.spec, name=f"{family} biased")

    def start(self, batch, rng):
        return self.world.start(batch, rng)

    def observe(self, observation, prior, rng):
        return self.world.observe(observation, prior, rng)

    def imagine(self, state: State, action, rng) -> State:
        after = self.world.imagine(state, action, rng)
        lift = torch.tensor([0.0, 0.5 * 9.81 * self.spec.dt_s]).double() * bool(self.world.family.gravity[2])
        velocity = after["velocity"] + lift
        if self.noise:
            velocity = velocity + self.noise * torch.randn(velocity.shape, generator=rng)
        return after.replace(velocity=velocity)

    def render(self, state, channels):
        return self.world.render(state, channels)


def truth(family: str, seed: int, batch: int):
    world = terrella.load(f"physics:{family}", pictures=False)
    system = PhysicalSystem.from_json(world.spec.system)
    idle = terrella.load_policy("idle", world.spec)
    start = world.start(batch, make_rng(seed))
    seen = rollout(world, start, idle, make_rng(0), system.channels, steps=STEPS).observations
    return system, seen, trajectory_of(system, seen, world.spec.dt_s)


def predicted(world, seen, batch: int, system):
    state = world.observe({name: seen[name][0] for name in world.spec.observes}, None, make_rng(0))
    done = rollout(world, state, torch.zeros(STEPS, batch, dtype=torch.long), make_rng(0), system.channels)
    return done.final, trajectory_of(system, done.observations, world.spec.dt_s)


@pytest.mark.parametrize(
    ("family", "noise"), [("parabola", 0.0), ("bouncing", 0.0), ("pendulum", 0.0), ("collision", 0.02)]
)
def test_a_guard_removes_most_violations_and_most_of_the_error(family, noise):
    system, _, known = truth(family, 1, 120)
    _, seen, true = truth(family, 2, 20)
    tolerances, bare = calibrate(known), Biased(family, noise)
    guarded = Guarded(bare, system, tolerances)
    (final, mine), (_, plain) = predicted(guarded, seen, 20, system), predicted(bare, seen, 20, system)
    report = guarded.report(final)
    assert report.steps == 20 * STEPS
    assert report.broken["free fall"] > 0.5
    assert sum(report.left.values()) < 0.1 * sum(report.broken.values())
    errors = [float((one.position[-1] - true.position[-1]).norm(dim=-1).mean()) for one in (mine, plain)]
    assert errors[0] < 0.2 * errors[1]
    assert not report.frozen and report.simulated == 0


def shaken(family: str, batch: int, seed: int):
    """(a judge of a family; two instants and a third one that noise spoils in most rollouts, one after the other in `widths`)."""
    system, seen, known = truth(family, seed, batch)
    widths = {name: seen[name][0, 0].numel() for name in system.channels}
    flat = torch.cat([seen[name].double().reshape(STEPS + 1, batch, -1) for name in system.channels], 2)
    rng = make_rng(seed)
    spoiled = torch.rand(batch, 1, generator=rng) < 0.8
    noise = 0.02 * torch.randn(STEPS + 1, batch, flat.shape[2], generator=rng).double() * spoiled
    judge = Judge(system, [one for one in calibrate(known) if not one.wrong_here], known.dt_s, widths)
    return judge, flat, flat + noise


@pytest.mark.parametrize("family", ["collision", "bouncing", "pendulum", "rolling", "stacking"])
def test_the_kernel_is_the_laws_themselves(family):
    """Violations, corrections and ways, in flight and in contacts, of first steps and of later ones."""
    judge, flat, spoiled = shaken(family, 40 if family == "stacking" else 120, 3)
    rows = torch.arange(flat.shape[1])
    fresh, allowed = rows % 5 == 0, rows % 7 != 0
    broken = 0
    for step in (1, 8, 15):
        held = flat[step - 1 : step + 1].transpose(0, 1).clone()
        held[fresh, 0] = held[fresh, 1]
        mine = judge(held, spoiled[step + 1], fresh, allowed)
        with tensor_programs():
            slow = judge(held, spoiled[step + 1], fresh, allowed)
        for name in ("before", "left", "seen", "way"):
            assert torch.allclose(getattr(mine, name), getattr(slow, name), rtol=1e-6, atol=1e-7), (name, step)
        assert torch.equal(mine.changed, slow.changed) and not mine.changed[~allowed].any()
        broken += int((mine.before > 1).any(1).sum())
    assert broken > 100 or family == "stacking" and broken > 30


@pytest.mark.parametrize("value", [math.nan, math.inf])
@pytest.mark.parametrize("family", ["collision", "pendulum", "rolling", "stacking"])
def test_a_body_whose_numbers_are_not_finite_is_not_there(family, value):
    """Kernel and laws say the same of each number in turn, in the step and in the instant before; a vanished body goes on."""
    judge, flat, spoiled = shaken(family, 40 if family == "stacking" else 60, 3)
    rows = torch.arange(flat.shape[1])
    fresh, allowed, number = rows % 5 == 0, rows % 7 != 0, rows % flat.shape[2]
    for early in (False, True):
        held, seen = flat[7:9].transpose(0, 1).clone(), spoiled[9].clone()
        (held[:, 1] if early else seen)[rows, number] = value
        held[fresh, 0] = held[fresh, 1]
        mine = judge(held, seen, fresh, allowed)
        with tensor_programs():
            slow = judge(held, seen, fresh, allowed)
        for name in ("before", "left", "seen", "way"):
            pair = getattr(mine, name), getattr(slow, name)
            assert torch.allclose(*pair, rtol=1e-6, atol=1e-7, equal_nan=True), (name, early)
        assert torch.equal(mine.changed, slow.changed)
        assert (mine.before[:, 0] > 1).all() or early and (mine.before[~fresh, 0] == 0).any()
        assert early or mine.seen[allowed].isfinite().all() and mine.seen[~allowed].isfinite().all(1).sum() == 0


def test_a_joint_that_is_not_a_number_stays_broken():
    ball = RigidBody("ball", Slot("state"), Slot("state", 3), radius_m=0.1)
    system = PhysicalSystem((ball,), limits=(Limit("elbow", Slot("state", 6), -1.0, 1.0, "rad"),))
    judge = Judge(system, [Tolerance(Limits(), 0.01, 100, 0.01)], 0.02, {"state": 7})
    rows = torch.zeros(3, 3, 7, dtype=torch.float64)
    rows[:, 2, 6] = torch.tensor([math.nan, 2.0, 0.5])
    every = torch.ones(3, dtype=torch.bool)
    for way in (nullcontext(), tensor_programs()):
        with way:
            found = judge(rows[:, :2], rows[:, 2], ~every, every)
        assert found.before[:, 0].isinf().tolist() == [True, False, False] and found.left[0, 0].isinf()
        assert found.seen[:2, 6].isnan().tolist() == [True, False] and found.seen[1, 6] == 1.0
        assert found.changed.tolist() == [False, True, False]


def test_the_truth_is_left_as_it_is():
    system, _, known = truth("collision", 1, 120)
    _, seen, true = truth("collision", 2, 10)
    guarded = Guarded(BodiesWorld("collision", BodiesConfig(pictures=False)), system, calibrate(known))
    final, mine = predicted(guarded, seen, 10, system)
    assert guarded.report(final).corrected == 0
    assert torch.allclose(mine.position, true.position, atol=1e-5)


def test_what_was_observed_beyond_the_range_of_a_world_is_held_as_observed():
    class Clipping(Biased):
        """A world that knows places within 0.3 m alone."""

        def observe(self, observation, prior, rng):
            near = {**observation, "position": observation["position"].clamp(-0.3, 0.3)}
            return super().observe(near, prior, rng)

    system, _, known = truth("parabola", 1, 120)
    _, seen, true = truth("parabola", 2, 10)
    guarded = Guarded(Clipping("parabola"), system, calibrate(known))
    final, mine = predicted(guarded, seen, 10, system)
    assert torch.allclose(mine.position, true.position, atol=1e-3)
    assert not guarded.report(final).frozen, "the jump from what was clipped is no motion"


def test_only_what_was_changed_counts_as_corrected():
    """A world may predict quaternions whose length is not quite 1."""
    ball = RigidBody("ball", Slot("pose"), Slot("speed"), rotation=Slot("pose", 3), radius_m=0.1)
    system = PhysicalSystem((ball,), (Wall((0.0, 0.0, 0.0), normal=(0.0, 0.0, 1.0)),))
    rows = {"pose": torch.tensor([0.0, 0, 5, 1.01, 0, 0, 0]).repeat(3, 1, 1), "speed": torch.zeros(3, 1, 3)}
    motion = trajectory_of(system, rows, 0.02)
    assert not changed_rollouts(motion, trajectory_of(system, rows, 0.02)).any()
    assert changed_rollouts(motion, replace(motion, position=motion.position + 1e-3)).all()


def test_a_guarded_world_keeps_the_contract():
    system, _, known = truth("bouncing", 1, 60)
    check_world(Guarded(Biased("bouncing"), system, calibrate(known)), steps=3)


def test_a_simulator_takes_the_broken_steps():
    system, _, known = truth("collision", 1, 120)
    _, seen, true = truth("collision", 2, 10)
    bare, sim = Biased("collision", noise=0.05), BodiesWorld("collision", BodiesConfig(pictures=False))
    guarded = Guarded(bare, system, calibrate(known), sim)
    final, mine = predicted(guarded, seen, 10, system)
    assert guarded.report(final).simulated > 0.9
    assert torch.allclose(mine.position, true.position, atol=1e-3)


def test_the_best_of_several_predictions_breaks_less():
    system, _, known = truth("uniform", 1, 120)
    _, seen, _ = truth("uniform", 2, 10)
    tolerances = [replace(one, value=0.5 * one.law.ceiling(known)) for one in calibrate(known)]
    bare = Biased("uniform", noise=0.1)
    shares = []
    for draws in (1, 8):
        guarded = Guarded(bare, system, tolerances, config=GuardConfig(project=False, draws=draws))
        report = guarded.report(predicted(guarded, seen, 10, system)[0])
        shares.append(sum(report.broken.values()) if draws == 1 else sum(report.left.values()))
    assert shares[1] < 0.7 * shares[0]


def test_detecting_alone_changes_nothing():
    system, _, known = truth("parabola", 1, 120)
    _, seen, _ = truth("parabola", 2, 5)
    bare = Biased("parabola")
    guarded = Guarded(bare, system, calibrate(known), config=GuardConfig(project=False))
    (final, mine), (_, plain) = predicted(guarded, seen, 5, system), predicted(bare, seen, 5, system)
    assert torch.allclose(mine.position, plain.position, atol=1e-6)
    assert guarded.report(final).broken["free fall"] > 0.9 and guarded.report(final).corrected == 0


def test_a_correction_that_freezes_motion_is_caught():
    class Freezing:
        """A law whose projection puts everything back."""

        def __init__(self, law):
            self.name, self.unit, self._law = law.name, law.unit, law

        def residual(self, motion):
            return self._law.residual(motion)

        def correct(self, motion):
            still = {
                name: torch.cat([getattr(motion, name)[:-1], getattr(motion, name)[-2:-1]])
                for name in ("position", "velocity")
            }
            return replace(motion, **still)

    system, _, known = truth("parabola", 1, 120)
    _, seen, _ = truth("parabola", 2, 5)
    fall = next(one for one in calibrate(known) if one.law.name == "free fall")
    guarded = Guarded(Biased("parabola"), system, [replace(fall, law=Freezing(fall.law))])
    report = guarded.report(predicted(guarded, seen, 5, system)[0])
    assert report.frozen and "FROZEN" in str(report)


def test_a_broken_step_is_dumped_and_can_be_replayed(tmp_path):
    system, _, known = truth("parabola", 1, 120)
    _, seen, _ = truth("parabola", 2, 3)
    bare = Biased("parabola")
    guarded = Guarded(bare, system, calibrate(known), config=GuardConfig(dumps=tmp_path))
    predicted(guarded, seen, 3, system)
    files = sorted(tmp_path.glob("case-*.safetensors"))
    assert len(files) == 8
    before, after = replay_case(bare, files[0])
    assert torch.allclose(before["position"].flatten(1).float(), seen["position"][0], atol=1e-5)
    assert float((after["velocity"] - before["velocity"])[..., 1].mean()) == pytest.approx(
        -0.5 * 9.81 * 0.025, rel=1e-3
    )


def test_bad_guards_get_a_sentence():
    system, _, known = truth("parabola", 1, 60)
    tolerances = calibrate(known)
    blind = Biased("parabola")
    blind.spec = replace(blind.spec, observes=())
    with pytest.raises(TerrellaError, match="cannot be set from its channels"):
        Guarded(blind, system, tolerances)
    slow = BodiesWorld("parabola", BodiesConfig(pictures=False))
    slow.spec = replace(slow.spec, dt_s=0.1)
    with pytest.raises(TerrellaError, match="steps by 0.1 s and the world by 0.025 s"):
        Guarded(Biased("parabola"), system, tolerances, slow)
    feet = BodiesWorld("parabola", BodiesConfig(pictures=False))
    feet.spec = replace(feet.spec, units={"position": "ft"})
    with pytest.raises(TerrellaError, match="is in m in the world and in ft in the simulator"):
        Guarded(Biased("parabola"), system, tolerances, feet)
    with pytest.raises(TerrellaError, match="needs a world that leaps"):
        Guarded(Biased("parabola"), system, tolerances, config=GuardConfig(disagreement=0.1))
