"""A generator that never shows a place the same way twice, and what it becomes with a memory."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from gymnasium import spaces
from tests.worlds.test_frame_history import made

import terrella
from terrella.core import Camera, Spec, State, check_world, make_rng
from terrella.core.errors import ContractError, ObservationError, TerrellaError
from terrella.space.camera import planar_pose, yaw
from terrella.space.estimator import Estimator, EstimatorConfig
from terrella.space.keyframes import Glimpse
from terrella.space.memory import DREAMT, OBSERVED
from terrella.space.remembering import Remembering, blend, remember
from terrella.worlds.controls import Controls

from .rooms import CAMERA, SIZE, painted, room_depth

TURN = math.radians(6)


class Fickle:
    """Stands in a box room and repaints it at every step, in colours of its own choice; what it is shown it believes.

    `channels`: which of depth and pose it tells. Its picture says in three corner pixels where it stands, for the estimator.
    """

    def __init__(self, channels=("depth", "pose"), length: int = 10**6):
        self.length = length
        told = {
            "depth": spaces.Box(0, 100, SIZE, np.float32),
            "pose": spaces.Box(-np.inf, np.inf, (7,), np.float32),
        }
        self.spec = Spec(
            name="fickle",
            action=spaces.MultiBinary(3),
            channels={
                "rgb": spaces.Box(0, 255, (*SIZE, 3), np.uint8),
                **{name: told[name] for name in channels},
                "reward": spaces.Box(-np.inf, np.inf, (), np.float32),
                "done": spaces.Box(0, 1, (), np.bool_),
            },
            observes=("rgb",),
            dt_s=0.1,
            action_names=("FORWARD", "TURN_LEFT", "TURN_RIGHT"),
            cameras={"rgb": Camera(CAMERA, SIZE)},
        )

    def start(self, batch, rng):
        if batch < 1:
            raise ContractError("a story or more")
        zero = torch.zeros(batch)
        return self._painted(planar_pose(zero, zero, zero + 1.3, zero), torch.zeros(batch, 3), zero.long())

    def observe(self, observation, prior, rng):
        if "rgb" not in observation:
            raise ObservationError("it looks at rgb")
        frame = torch.as_tensor(observation["rgb"])
        return (self.start(len(frame), rng) if prior is None else prior).replace(frame=frame.clone())

    def imagine(self, state, action, rng):
        action = self.spec.check_action(action, state.batch).float()
        pose = state["pose"]
        heading = yaw(pose) + TURN * (action[:, 1] - action[:, 2])
        x, y = pose[:, 0] + 0.1 * action[:, 0] * heading.cos(), pose[:, 1] + 0.1 * action[:, 0] * heading.sin()
        tint = torch.rand(state.batch, 3, generator=rng) - 0.5
        return self._painted(planar_pose(x, y, pose[:, 2], heading), tint, state["age"] + 1)

    def render(self, state, channels):
        self.spec.check_channels(channels)
        show = {
            "rgb": lambda: state["frame"],
            "depth": lambda: room_depth(state["pose"]),
            "pose": lambda: state["pose"],
            "reward": lambda: torch.where(state["age"] > self.length, 0.0, 1.0),
            "done": lambda: state["age"] >= self.length,
        }
        return {name: show[name]() for name in channels}

    def _painted(self, pose, tint, age):
        frame = painted(pose, room_depth(pose)).float() * (1 + tint[:, :, None, None])
        frame = frame.clamp(0, 255).to(torch.uint8).permute(0, 2, 3, 1).contiguous()
        return State({"pose": pose, "frame": frame, "age": age})


class Told:
    """An estimator for Fickle: it knows the room, and adds up the motions that a list of its own holds."""

    def __init__(self):
        self.moves: list[tuple[float, float, float]] = []
        self.pose = planar_pose(*torch.tensor([[0.0], [0.0], [1.3], [0.0]]))

    def depth(self, rgb):
        return room_depth(self.pose).expand(len(rgb), -1, -1)

    def motion(self, before, after, depth=None):
        move = torch.tensor([self.moves.pop(0)])
        heading = yaw(self.pose) + move[:, 2]
        self.pose = planar_pose(self.pose[:, 0], self.pose[:, 1], self.pose[:, 2], heading)
        return move


def likeness(a, b) -> float:
    return float(10 * torch.log10(255**2 / (a.float() - b.float()).square().mean().clamp_min(1e-6)))


def hold(world, state, button: int, steps: int, rng=None):
    rng, action = rng or make_rng(5), torch.zeros(state.batch, 3)
    action[:, button] = 1
    for _ in range(steps):
        state = world.imagine(state, action, rng)
    return state


def there_and_back(world, steps: int = 15):
    """First picture, the one at the far end of a turn, and the last one, back again."""
    state = world.start(1, make_rng(0))
    far = hold(world, state, 1, steps)
    last = hold(world, far, 2, steps)
    return [world.render(one, ("rgb",))["rgb"] for one in (state, far, last)]


@pytest.mark.parametrize("channels", [("depth", "pose"), ("pose",)])
def test_it_keeps_the_contract(channels):
    assert "states_can_be_saved" in check_world(Remembering(Fickle(channels), memory_mb=1), steps=4)
    assert "acts_deterministically" in check_world(Remembering(Fickle(channels, length=2), memory_mb=1), steps=5)


@pytest.mark.parametrize("channels", [("depth", "pose"), ("pose",)])
def test_what_was_shown_is_shown_again(channels):
    """Turning needs no depth: a sphere will do."""
    first, far, last = there_and_back(Fickle(channels))
    assert likeness(last, first) < 20 and likeness(far, first) < 20
    first, far, last = there_and_back(Remembering(Fickle(channels)))
    assert likeness(last, first) > 33 and likeness(far, first) < 20


def test_what_it_invented_stays_as_it_was_invented():
    world, rng = Remembering(Fickle()), make_rng(3)
    away = hold(world, world.start(1, rng), 1, 25, rng)
    there = world.render(away, ("rgb", "known"))
    again = hold(world, hold(world, away, 2, 12, rng), 1, 12, rng)
    assert likeness(world.render(again, ("rgb",))["rgb"], there["rgb"]) > 24
    kinds = world.render(again, ("places",))["places"][0, :, 3]
    assert (kinds == OBSERVED).sum() == 1 and (kinds == DREAMT).sum() > 5


def test_walking_shows_the_room_from_elsewhere():
    world = Remembering(Fickle())
    state = hold(world, world.start(1, make_rng(0)), 0, 10)
    truth = painted(state["pose"], room_depth(state["pose"])).permute(0, 2, 3, 1)
    seen = world.render(state, ("rgb", "known"))
    sure = seen["known"] > 0.9
    assert sure.float().mean() > 0.7
    assert (seen["rgb"].float() - truth.float()).abs()[sure].mean() < 6


def test_the_inner_world_goes_on_from_the_blend():
    world = Remembering(Fickle())
    state = hold(world, world.start(1, make_rng(0)), 1, 3)
    assert torch.equal(state["world_frame"].permute(0, 3, 1, 2), state["rgb"])


def test_known_says_what_is_invented():
    world = Remembering(Fickle())
    state = world.start(1, make_rng(0))
    assert world.render(state, ("known",))["known"].min() == 1, "evidence is not invented"
    known = world.render(hold(world, state, 1, 4), ("known",))["known"]  # on the left the view is new
    assert known[0, :, :9].mean() < 0.1 and known[0, :, 36:60].mean() > 0.85
    assert 0.05 < ((known > 0.05) & (known < 0.95)).float().mean() < 0.5, "with a soft seam between"


def test_memory_is_part_of_the_state(tmp_path):
    world = Remembering(Fickle(), memory_mb=1)
    state = hold(world, world.start(1, make_rng(0)), 1, 9)
    state.save(tmp_path / "s.safetensors")
    again = State.load(tmp_path / "s.safetensors")
    assert again == state and hold(world, again, 2, 5) == hold(world, state, 2, 5)
    both = state.fork(2)
    one, other = hold(world, state, 2, 5), hold(world, both, 2, 5)
    assert torch.equal(other["memory_pose"][:1], one["memory_pose"])


def test_an_estimator_gives_pose_and_depth_to_a_world_that_has_none():
    estimator = Told()
    estimator.moves = [(0.0, 0.0, turn) for turn in [TURN] * 15 + [-TURN] * 15]
    world = Remembering(Fickle(channels=()), estimator=estimator)
    assert {"pose", "depth"} <= set(world.spec.channels)
    first, far, last = there_and_back(world)
    assert likeness(last, first) > 33 and likeness(far, first) < 20


def test_a_story_that_is_done_stays_done():
    world = Remembering(Fickle(length=3))
    over = hold(world, world.start(2, make_rng(0)), 0, 3)
    later = hold(world, over, 1, 2)
    assert later["done"].all() and later["reward"].max() == 0 and torch.equal(later["rgb"], over["rgb"])


def test_evidence_is_kept_and_a_world_that_cannot_look_says_so():
    world = Remembering(Fickle())
    state = hold(world, world.start(1, make_rng(0)), 1, 12)
    seen = torch.full((1, *SIZE, 3), 90, dtype=torch.uint8)
    told = world.observe({"rgb": seen}, state, make_rng(0))
    assert torch.equal(world.render(told, ("rgb",))["rgb"], seen)
    assert (told["memory_kind"] == OBSERVED).sum() == 2
    back = hold(world, hold(world, told, 1, 12), 2, 12)
    assert likeness(world.render(back, ("rgb",))["rgb"], seen) > 25  # at the rim older keyframes have their say
    with pytest.raises(ObservationError, match="observes rgb"):
        world.observe({"depth": torch.ones(1, *SIZE)}, state, make_rng(0))


def test_who_cannot_be_given_a_memory_is_told_why():
    with pytest.raises(ContractError, match="give an estimator"):
        Remembering(Fickle(channels=("depth",)))
    lens = Fickle()
    lens.spec = replace(lens.spec, cameras={})
    with pytest.raises(ContractError, match="no camera"):
        Remembering(lens)
    assert Remembering(lens, camera=CAMERA).spec.camera == CAMERA
    with pytest.raises(ContractError, match="show and observe rgb"):
        Remembering(terrella.load("gym:CartPole-v1"))
    world = Remembering(Fickle())
    assert remember(world) is world and isinstance(remember(Fickle()), Remembering)
    with pytest.raises(ContractError, match="remembers by itself"):
        Remembering(world)


def test_a_seam_between_memory_and_invention_does_not_show():
    """Memory knows the left half of a grey wall, the invention is a tenth brighter: no pixel may jump."""
    size = (48, 64)
    known = torch.zeros(1, *size)
    known[:, :, :32] = 1
    glimpse = Glimpse(torch.full((1, 1, 3, *size), 0.5), known[:, None], torch.ones(1, *size), known)
    mixed, share = blend(glimpse, torch.full((1, 3, *size), 153, dtype=torch.uint8))
    row = mixed[0, 0, 24].float()
    assert (row[:28] - 128).abs().max() <= 1 and (row[-8:] - 153).abs().max() <= 1
    assert row.diff().abs().max() < 0.5 * 25, "half of the step at most"
    assert share[0, 24, :28].min() == 1 and share[0, 24, 32:].max() == 0


def test_the_bundled_world_remembers_by_itself():
    world = terrella.load("doom-maze", remember=True, memory_mb=2)
    assert world.scene.own.nbytes <= 2 * 2**20
    with pytest.raises(TerrellaError, match="There is no world"):
        terrella.load("doom-maze", estimator="no such file")


def test_the_budget_reaches_the_memory_around_a_world(monkeypatch):
    asked = {}
    monkeypatch.setattr("terrella.library.folder_of", lambda name: name)
    monkeypatch.setattr("terrella.library._open_checkpoint", lambda folder, options: asked.update(options) or Fickle())
    world = terrella.load("fickle", remember=True, memory_mb=1)
    assert isinstance(world, Remembering) and 0 < world.memory.nbytes <= 2**20 and asked["memory_mb"] == 1


@pytest.mark.parametrize("budget", (0, 0.01, -1, math.nan))
def test_a_budget_without_room_is_refused(budget):
    with pytest.raises(ContractError, match="budget"):
        Remembering(Fickle(), memory_mb=budget)


def test_the_budget_that_is_advised_has_room():
    with pytest.raises(ContractError) as refused:
        Remembering(Fickle(), memory_mb=0)
    advised = float(str(refused.value).split("give ")[1].split()[0])
    assert Remembering(Fickle(), memory_mb=advised).memory.capacity >= 1


def test_the_truth_has_no_budget_of_its_own():
    with pytest.raises(TerrellaError, match="remembers nothing"):
        terrella.load("gym:CartPole-v1", memory_mb=4)


class Glancing(Fickle):
    """It draws from chance when it observes, too."""

    def observe(self, observation, prior, rng):
        told = super().observe(observation, prior, rng)
        return told.replace(frame=(told["frame"].float() * torch.rand(len(told["frame"]), 3, generator=rng)[:, None, None])
                            .to(torch.uint8))  # fmt: skip


def test_a_batch_equals_its_singles_though_the_inner_world_observes_by_chance():
    assert "a_batch_equals_its_singles" in check_world(Remembering(Glancing(), memory_mb=1))
    world = Remembering(Glancing(), memory_mb=1)
    start, turn, rng = world.start(2, make_rng(0)), torch.tensor([[0, 1, 0], [1, 0, 0]]), make_rng(1)
    both = hold(world, world.imagine(start, turn, make_rng(1)), 1, 1, make_rng(2))
    singles = State.stack([world.imagine(start.at(n), turn[n : n + 1], rng) for n in range(2)])
    assert torch.equal(hold(world, singles, 1, 1, make_rng(2))["rgb"], both["rgb"])


def test_a_learned_world_of_frames_alone_with_a_memory_keeps_the_contract():
    estimator = Estimator(EstimatorConfig((16, 24))).eval().requires_grad_(False)
    world = Remembering(made(Controls.buttons(3)), 1.0, estimator, CAMERA)
    assert "a_batch_equals_its_singles" in check_world(world)


def test_a_state_of_another_memory_around_a_world_is_adopted_or_refused():
    world, twin, other = (Remembering(Fickle(), memory_mb=size) for size in (2, 2, 1))
    state = hold(world, world.start(1, make_rng(0)), 1, 5)
    assert torch.equal(hold(twin, state, 2, 3)["rgb"], hold(world, state, 2, 3)["rgb"])
    for verb in (lambda: other.render(state, ("places",)), lambda: hold(other, state, 1, 1)):
        with pytest.raises(ContractError, match="layout"):
            verb()


def test_the_estimators_gradients_are_the_callers_choice():
    world = Remembering(Fickle(channels=()), 1.0, Estimator(EstimatorConfig(SIZE)).eval())
    state = hold(world, world.start(1, make_rng(0)), 1, 1)
    assert state["depth"].requires_grad and not state["depth"].is_inference()
