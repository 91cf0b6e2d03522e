"""check_world catches each way in which a world can break the contract: one broken world for each law."""

from __future__ import annotations

import random
from dataclasses import replace

import numpy as np
import pytest
import torch
from gymnasium import spaces

from terrella.core import Camera, Spec, State, check_world, make_rng
from terrella.core.errors import ContractError, ObservationError, StaleStateError, TerrellaError

REWARD, DONE = spaces.Box(-np.inf, np.inf, (), np.float32), spaces.Box(0, 1, (), np.bool_)
SPEC = Spec(
    name="walk",
    action=spaces.Box(-1, 1, (2,), np.float32),
    channels={"at": spaces.Box(-1e6, 1e6, (2,), np.float32), "reward": REWARD, "done": DONE},
    observes=("at",),
    dt_s=0.1,
    units={"at": "m"},
    keys={"ArrowUp": [0.0, 1.0]},
)


class Walk:
    """A world that keeps every law: a point that walks, with a little wind, and is home beyond 0.5 m."""

    spec = SPEC

    def start(self, batch, rng):
        if batch < 1:
            raise TerrellaError("at least one story")
        return self.at(torch.rand((batch, 2), generator=rng))

    def at(self, at):
        return State({"at": at, "reward": torch.zeros(len(at)), "done": torch.zeros(len(at), dtype=torch.bool)})

    def observe(self, observation, prior, rng):
        if "at" not in observation:
            raise ObservationError("give `at`")
        return self.at(observation["at"].clone())

    def imagine(self, state, action, rng):
        action = self.spec.check_action(action, state.batch)
        wind = torch.randn(action.shape, generator=rng) * 0.01
        done = state["done"]
        at = torch.where(done[:, None], state["at"], state["at"] + action + wind)
        return State({"at": at, "reward": torch.where(done, 0.0, 1.0), "done": done | (at.norm(dim=1) > 0.5)})

    def render(self, state, channels):
        self.spec.check_channels(channels)
        return {name: state[name] for name in channels}


class Ticketed(Walk):
    """The same walk as a process that cannot go back."""

    spec = replace(SPEC, forkable=False, max_batch=1, observes=())
    ticket = 0

    def at(self, at):
        return self.stamped(super().at(at))

    def stamped(self, state):
        self.ticket += 1
        return state.replace(ticket=torch.tensor([self.ticket]))

    def present(self, state):
        if int(state["ticket"]) != self.ticket:
            raise StaleStateError("gone")

    def start(self, batch, rng):
        if batch != 1:
            raise TerrellaError("one story")
        return super().start(batch, rng)

    def observe(self, observation, prior, rng):
        return self.start(1, rng) if prior is None else prior

    def imagine(self, state, action, rng):
        self.present(state)
        return self.stamped(super().imagine(state, action, rng))

    def render(self, state, channels):
        self.present(state)
        return super().render(state, channels)


def test_lawful_worlds_pass_and_the_laws_are_named():
    values, tickets = check_world(Walk(), steps=6), check_world(Ticketed(), steps=6)
    assert {
        "states_are_values",
        "states_can_be_saved",
        "batches",
        "a_batch_equals_its_singles",
        "forks_and_puts",
    } <= set(values)
    assert "stale_states_are_refused" in tickets and "batches" not in tickets


def test_a_world_that_promises_gradients_gives_them():
    world = Walk()
    world.spec = replace(SPEC, differentiable=True)
    assert "gradients_reach_the_action" in check_world(world)


def broken(message):
    """Registers a broken world with the words that must be in the complaint."""

    def register(world):
        BROKEN.append(pytest.param(world, message, id=world.__name__))
        return world

    return register


BROKEN = []


@broken("positive seconds")
class NoClock(Walk):
    spec = replace(SPEC, dt_s=0.0)


@broken("at least one channel")
class Blind(Walk):
    spec = replace(SPEC, channels={}, observes=(), units={})


@broken("spec.observes names")
class ObservesTheUnseen(Walk):
    spec = replace(SPEC, observes=("lidar",))


@broken("spec.units names")
class UnitsOfNothing(Walk):
    spec = replace(SPEC, units={"depth": "m"})


@broken("'reward' must be float32")
class WideReward(Walk):
    spec = replace(SPEC, channels={**SPEC.channels, "reward": spaces.Box(-np.inf, np.inf, (1,), np.float32)})


@broken("key 'KeyW' stands for")
class ShortKey(Walk):
    spec = replace(SPEC, keys={"KeyW": [1.0]})


@broken("key 'KeyW' stands for")
class StrongKey(Walk):
    spec = replace(SPEC, keys={"KeyW": [0.0, 9.0]})


@broken("max_batch")
class NoRoom(Walk):
    spec = replace(SPEC, max_batch=0)


PICTURED = {**SPEC.channels, "rgb": spaces.Box(0, 255, (6, 8, 3), np.uint8)}
LENS = Camera((0.5, 0.7, 0.5, 0.5), (6, 8), None)


@broken("four positive numbers")
class BrokenCamera(Walk):
    spec = replace(SPEC, channels=PICTURED, cameras={"rgb": replace(LENS, intrinsics=(0.0, 1.0, 0.5, 0.5))})


@broken("no picture channel")
class CameraOfNothing(Walk):
    spec = replace(SPEC, cameras={"rgb.wrist": LENS})


@broken("has size (8, 6), its pictures have (6, 8)")
class CameraOfAnotherSize(Walk):
    spec = replace(SPEC, channels=PICTURED, cameras={"rgb": replace(LENS, size=(8, 6))})


@broken("is mounted on 'pose.wrist', which is no pose channel")
class CameraOnNothing(Walk):
    spec = replace(SPEC, channels=PICTURED, cameras={"rgb": replace(LENS, pose="pose.wrist")})


@broken("quaternion w, x, y, z of length 1")
class BentMount(Walk):
    spec = replace(SPEC, channels=PICTURED, cameras={"rgb": replace(LENS, mount=(0, 0, 0, 1, 1, 0, 0))})


@broken("'rgb.wrist' must be uint8")
class FloatPicture(Walk):
    spec = replace(SPEC, channels={**SPEC.channels, "rgb.wrist": spaces.Box(0, 1, (6, 8, 3), np.float32)})


@broken("3 units; the space")
class UnitsThatDisagree(Walk):
    spec = replace(SPEC, action_units=("m", "m", "rad"))


@broken("which the action space")
class ModeThatDisagrees(Walk):
    spec = replace(SPEC, action_mode="buttons")


@broken("1 names for 2 actions")
class NamesThatDisagree(Walk):
    spec = replace(SPEC, action_names=("x",))


@broken("a batch differs from that of single episodes")
class SharedWind(Walk):
    def imagine(self, state, action, rng):
        after = super().imagine(state, action, rng)
        return after.replace(at=after["at"] + torch.randn(2, generator=rng) * ~state["done"][:, None])


@broken("no gradient reaches")
class FalsePromise(Walk):
    spec = replace(SPEC, differentiable=True)

    def imagine(self, state, action, rng):
        return super().imagine(state, self.spec.check_action(action, state.batch).detach(), rng)


@broken("spec.may_observe names ['sonar']")
class HeedsTheUnseen(Walk):
    spec = replace(SPEC, may_observe=("sonar",))


@broken("spec.may_observe names ['at']")
class HeedsTwice(Walk):
    spec = replace(SPEC, may_observe=("at",))


@broken("the prior that it was given unchanged")
class LearnsFromWhatItHeeds(Walk):
    spec = replace(SPEC, may_observe=("reward",))

    def observe(self, observation, prior, rng):
        if prior is not None and "reward" in observation:
            prior["at"].add_(1)
        return super().observe(observation, prior, rng)


@broken("State with batch 1")
class StartsTooMany(Walk):
    def start(self, batch, rng):
        return super().start(batch + 1, rng)


@broken("start(0, rng) must raise")
class StartsNothing(Walk):
    def start(self, batch, rng):
        return self.at(torch.rand((batch, 2), generator=rng))


@broken("start(4, rng) must raise")
class IgnoresItsOwnLimit(Walk):
    spec = replace(SPEC, max_batch=3)


@broken("and gave")
class RendersAll(Walk):
    def render(self, state, channels):
        self.spec.check_channels(channels)
        return {name: state[name] for name in self.spec.channels}


@broken("ChannelError")
class RendersAnything(Walk):
    def render(self, state, channels):
        return {name: state[name] if name in state else torch.zeros(1) for name in channels}


@broken("ChannelError")
class ComplainsInItsOwnWords(Walk):
    def render(self, state, channels):
        return {name: state[name] for name in channels}


@broken("rendered alone differs")
class FlickersWhenAlone(Walk):
    def render(self, state, channels):
        return {
            name: value + (len(channels) == 1 and name == "at")
            for name, value in super().render(state, channels).items()
        }


@broken("is not a tensor")
class RendersArrays(Walk):
    def render(self, state, channels):
        return {
            name: value if name != "at" else FakeTensor(value)
            for name, value in super().render(state, channels).items()
        }


class FakeTensor:
    def __init__(self, tensor):
        self.tensor = tensor

    def clone(self):
        return self


@broken("has shape (1, 1, 2)")
class ExtraAxis(Walk):
    def render(self, state, channels):
        return {name: value[None] if name == "at" else value for name, value in super().render(state, channels).items()}


@broken("is float64")
class DoublePrecision(Walk):
    def render(self, state, channels):
        return {
            name: value.double() if name == "at" else value for name, value in super().render(state, channels).items()
        }


@broken("leaves its space")
class LeavesItsSpace(Walk):
    spec = replace(SPEC, channels={**SPEC.channels, "at": spaces.Box(5, 6, (2,), np.float32)})


@broken("leaves its space")
class NotANumber(Walk):
    def imagine(self, state, action, rng):
        moved = super().imagine(state, action, rng)
        return moved.replace(at=moved["at"] * float("nan"))


@broken("quaternion")
class LongQuaternion(Walk):
    spec = replace(SPEC, channels={**SPEC.channels, "pose": spaces.Box(-np.inf, np.inf, (7,), np.float32)})

    def render(self, state, channels):
        self.spec.check_channels(channels)
        return {name: torch.full((state.batch, 7), 2.0) if name == "pose" else state[name] for name in channels}


@broken("same episode")
class HiddenClock(Walk):
    lives = 0

    def start(self, batch, rng):
        self.lives += 1
        return self.at(super().start(batch, rng)["at"] + self.lives)


@broken("global generators")
class GlobalTorch(Walk):
    def imagine(self, state, action, rng):
        torch.rand(1)
        return super().imagine(state, action, rng)


@broken("global generators")
class GlobalPython(Walk):
    def imagine(self, state, action, rng):
        random.random()
        return super().imagine(state, action, rng)


@broken("global generators")
class GlobalNumpy(Walk):
    def imagine(self, state, action, rng):
        np.random.random()
        return super().imagine(state, action, rng)


@broken("global generators")
class SeedsOthers(Walk):
    def start(self, batch, rng):
        np.random.seed(7)
        return super().start(batch, rng)


@broken("must stay done")
class Rises(Walk):
    def imagine(self, state, action, rng):
        moved = super().imagine(state, action, rng)
        return moved.replace(done=moved["done"] & ~state["done"])


@broken("no more reward")
class PaysForever(Walk):
    def imagine(self, state, action, rng):
        return super().imagine(state, action, rng).replace(reward=torch.ones(state.batch))


@broken("gives a State of the batch")
class GrowsOnTheWay(Walk):
    def imagine(self, state, action, rng):
        return super().imagine(state, action, rng).fork(2)


@broken("ActionError")
class TakesAnyAction(Walk):
    def imagine(self, state, action, rng):
        try:
            return super().imagine(state, action, rng)
        except TerrellaError:
            return state


@broken("ActionError")
class TakesStrongActions(Walk):
    def imagine(self, state, action, rng):
        tame = action.clamp(-1, 1) if isinstance(action, torch.Tensor) else action
        return super().imagine(state, tame, rng)


@broken("ActionError")
class RoundsActions(Walk):
    spec = replace(SPEC, action=spaces.MultiBinary(2), action_mode="")

    def imagine(self, state, action, rng):
        whole = action.floor() if isinstance(action, torch.Tensor) and action.is_floating_point() else action
        return super().imagine(state, whole, rng)


@broken("observe gives a State")
class ObservesNothing(Walk):
    def observe(self, observation, prior, rng):
        return None


@broken("must raise ObservationError")
class NeedsNoEvidence(Walk):
    def observe(self, observation, prior, rng):
        return self.start(1, rng)


@broken("leave the prior")
class ObservesInPlace(Walk):
    def observe(self, observation, prior, rng):
        if prior is not None:
            prior["at"].add_(1)
        return super().observe(observation, prior, rng)


@broken("imagine must leave the state")
class MovesInPlace(Walk):
    def imagine(self, state, action, rng):
        moved = super().imagine(state, action, rng)
        state["at"].copy_(moved["at"])
        return moved


@broken("branch twice alike")
class CountsSteps(Walk):
    steps = 0

    def start(self, batch, rng):
        self.steps = 0
        return super().start(batch, rng)

    def imagine(self, state, action, rng):
        moved = super().imagine(state, action, rng)
        self.steps += 1
        return moved.replace(at=moved["at"] + self.steps)


class Drawers(Walk):
    """Keeps the truth in itself and only a key to it in the state."""

    def __init__(self):
        self.drawers = {}

    def put(self, inside):
        key = 1.0 + len(self.drawers)
        self.drawers[key] = inside
        return State({"key": torch.full((inside.batch,), key), "entry": torch.arange(inside.batch)})

    def take(self, state):
        pairs = zip(state["key"].tolist(), state["entry"].tolist(), strict=True)
        return State.stack([self.drawers[key].at(entry) for key, entry in pairs])

    def start(self, batch, rng):
        self.drawers.clear()
        return self.put(super().start(batch, rng))

    def observe(self, observation, prior, rng):
        return self.put(super().observe(observation, prior, rng))

    def imagine(self, state, action, rng):
        return self.put(super().imagine(self.take(state), action, rng))

    def render(self, state, channels):
        return super().render(self.take(state), channels)


@broken("a saved and restored state")
class EmptiesItsDrawers(Drawers):
    def take(self, state):
        stand_in = Walk.start(self, 1, make_rng(99))
        pairs = zip(state["key"].tolist(), state["entry"].tolist(), strict=True)
        return State.stack([self.drawers[key].at(entry) if key in self.drawers else stand_in for key, entry in pairs])


@broken("go on as the original")
class ForgetsItsMomentum(Walk):
    def start(self, batch, rng):
        self.momentum = torch.rand((1, 2), generator=rng)
        return super().start(batch, rng)

    def imagine(self, state, action, rng):
        moved = super().imagine(state, action, rng)
        return moved.replace(at=moved["at"] + self.momentum)


@broken("batch 2")
class OneOnly(Walk):
    def start(self, batch, rng):
        return super().start(batch, rng).at(0)


@broken("depends on its neighbour")
class HerdInstinct(Walk):
    def render(self, state, channels):
        return {
            name: value - value.mean(0) + 0.1 if name == "at" and state.batch > 1 else value
            for name, value in super().render(state, channels).items()
        }


@broken("imagine: a world with forkable=False")
class ImaginesThePast(Ticketed):
    def imagine(self, state, action, rng):
        return self.stamped(Walk.imagine(self, state, action, rng))


@broken("render: a world with forkable=False")
class RendersThePast(Ticketed):
    def render(self, state, channels):
        return Walk.render(self, state, channels)


@broken("imagine: a world with forkable=False")
class RestartsInPlace(Ticketed):
    def start(self, batch, rng):
        state = super().start(batch, rng)
        self.ticket = 0
        return state.replace(ticket=torch.tensor([0]))


@pytest.mark.parametrize(("world", "message"), BROKEN)
def test_a_broken_world_is_caught(world, message):
    with pytest.raises(ContractError) as caught:
        check_world(world(), steps=6)
    assert message in str(caught.value)


def test_what_is_no_world_is_said_to_be_none():
    with pytest.raises(ContractError, match="four verbs|the verbs"):
        check_world(object())
