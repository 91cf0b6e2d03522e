"""Turns are found by what actions do, for buttons, choices and axes, in the world or in its recording."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from gymnasium import spaces
from panorama import SHORT, STEP_M, TURN_RAD, Panorama, card_of, exam_of, look, move, recording, some_clips

from terrella.core import Spec, State, check_world, make_rng
from terrella.measure import CLIPS, Exam, ExamConfig, clips_from_cache, examine, verdict
from terrella.measure.turning import scrolling_actions, turning_actions

KINDS = {
    "buttons": spaces.MultiBinary(3),
    "choice": spaces.Discrete(4),
    "axes": spaces.Box(-1, 1, (3,), np.float32),
}


@dataclass(frozen=True)
class Steered(Panorama):
    """The panorama under buttons, choices or axes whose names say nothing."""

    kind: str = "buttons"
    posed: bool = True

    @property
    def spec(self) -> Spec:
        whole = super().spec
        names = tuple("abcd"[: 4 if self.kind == "choice" else 3])
        channels = whole.channels if self.posed else {"rgb": whole.channels["rgb"]}
        return replace(
            whole, action=KINDS[self.kind], action_names=names, action_mode="", channels=channels, observes=("rgb",)
        )

    def imagine(self, state, action, rng) -> State:
        action = self.spec.check_action(action, state.batch)
        if self.kind == "choice":  # nothing, forward, right, left
            pressed = torch.eye(4)[action][:, [1, 3, 2]]
        elif self.kind == "axes":  # forward, something that does nothing, turn left
            pressed = torch.stack([action[:, 0], action[:, 2].clamp(min=0), (-action[:, 2]).clamp(min=0)], -1)
        else:
            pressed = action.float()
        return self._next(state, move(state["pose"], pressed))


def steered(kind: str):
    """Clips of a player who holds random actions of that kind; the same panorama."""
    world, rng, rows = Steered(kind=kind), make_rng(0), []
    state, action = world.start(1, rng), None
    for step in range(400):
        if step % 7 == 0:
            action = world.spec.sample_action(1, rng)
        rows.append((state["pose"][0].numpy(), action.reshape(-1).float().numpy()))
        state = world.imagine(state, action, rng)
    pose, actions = (np.stack(part) for part in zip(*rows))
    cache = SimpleNamespace(**{**vars(recording(1, 400)), "pose": pose, "action": actions})
    cache.rgb = look(torch.from_numpy(pose)).numpy()
    return clips_from_cache(cache, [0], 3, 32, 8, make_rng(0))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("posed", (True, False))
def test_the_actions_that_turn_are_found_in_the_world_or_in_the_recording(kind, posed):
    found = turning_actions(Steered(kind=kind, posed=posed), steered(kind), make_rng(0))
    assert found is not None
    left, right, name, speed = found
    assert name == {"buttons": "b and c", "choice": "d and c", "axes": "+c and -c"}[kind]
    assert speed == pytest.approx(TURN_RAD, rel=0.05)
    wanted = {"buttons": ([0, 1, 0], [0, 0, 1]), "choice": (3, 2), "axes": ([0, 0, 1], [0, 0, -1])}[kind]
    assert (left.tolist(), right.tolist()) == wanted


def test_nothing_that_turns_is_no_error():
    class Rail(Panorama):
        def imagine(self, state, action, rng):
            return self._next(state, move(state["pose"], action.float() * torch.tensor([1.0, 0, 0])))

    assert turning_actions(Rail(), some_clips(2), make_rng(0)) is None
    assert (
        turning_actions(
            Panorama("blind"), [replace(c, channels={"rgb": c.channels["rgb"]}) for c in some_clips(2)], make_rng(0)
        )
        is None
    )


def test_a_world_that_takes_no_pose_is_asked_to_turn_by_its_own_actions():
    config = ExamConfig((1, 8), (8,), **{**SHORT, "drop": (1, 8), "closure_deg": (90.0,), "closure_clips": 4})
    exam = Exam({"a": Steered(kind="axes")}, {CLIPS: {"recorded": steered("axes")}}, config)
    card = examine(exam)
    (back,) = [row for row in card.rows if row.probe == "memory" and "again" not in row.what]
    assert back.what == "turning by +c and -c, 60 steps" and back.motion == "predicted"
    assert "90 degrees away" in back.note and "memory" not in {one.probe for one in card.missing}


@dataclass(frozen=True)
class Strip:
    """A flat strip of noise that scrolls by three pixels a step, to the right with b, to the left with c; what is scrolled back to
    is darker by `fades`."""

    fades: int = 0

    @property
    def spec(self) -> Spec:
        shows = {"rgb": spaces.Box(0, 255, (24, 32, 3), np.uint8), "mosaic": spaces.Box(0, 255, (72, 128, 4), np.uint8)}
        return Spec("strip", spaces.MultiBinary(3), shows, ("rgb",), 0.1, action_names=("a", "b", "c"))

    def start(self, batch: int, rng: torch.Generator) -> State:
        return State({"at": torch.zeros(batch, dtype=torch.int64), "age": torch.zeros(batch, dtype=torch.int64)})

    def observe(self, observation, prior: State | None, rng: torch.Generator) -> State:
        return prior or self.start(len(observation["rgb"]), rng)

    def imagine(self, state: State, action: torch.Tensor, rng: torch.Generator) -> State:
        return State({"at": state["at"] + 3 * (action[:, 1].long() - action[:, 2].long()), "age": state["age"] + 1})

    def render(self, state: State, channels) -> dict[str, torch.Tensor]:
        wide = torch.randint(100, 256, (24, 400, 3), dtype=torch.uint8, generator=make_rng(7))
        seen = torch.stack([wide[:, 200 - at : 232 - at] for at in state["at"].tolist()])
        return {"rgb": seen - self.fades * (state["age"] > 30).to(torch.uint8)[:, None, None, None]}


def test_the_actions_that_scroll_a_flat_world_and_undo_each_other_are_found():
    found = scrolling_actions(Strip(), some_clips(2), make_rng(0))
    assert found is not None
    one, other, name, speed = found
    assert (one.tolist(), other.tolist(), name) == ([0, 1, 0], [0, 0, 1], "b and c") and speed == pytest.approx(3)

    class Frozen(Strip):
        def imagine(self, state, action, rng):
            return state

    assert scrolling_actions(Frozen(), some_clips(2), make_rng(0)) is None


@pytest.mark.parametrize("fades, worst, best", [(0, 60, 99), (20, 20, 25)])
def test_a_flat_world_is_asked_to_scroll_away_and_back(fades, worst, best):
    config = ExamConfig((1, 8), (8,), **{**SHORT, "drop": (1, 8), "closure_walk": 40, "closure_clips": 2})
    clips = [replace(clip, channels={"rgb": clip.channels["rgb"]}) for clip in some_clips(2)]
    card = examine(Exam({"a": Strip(fades)}, {CLIPS: {"recorded": clips}}, config))
    back, again = [row for row in card.rows if row.probe == "memory"]
    assert back.what == "scrolling by b and c, 40 steps" and not back.void
    assert worst <= back.figure.value <= best


@dataclass(frozen=True)
class TwoEyed(Panorama):
    """Two cameras, the second looks to the left and is smaller, and is drawn upside down where `flaw` is "wrist"."""

    @property
    def spec(self) -> Spec:
        whole = super().spec
        return replace(whole, channels={**whole.channels, "rgb.wrist": spaces.Box(0, 255, (12, 16, 3), np.uint8)})

    def render(self, state, channels):
        seen = super().render(state, [name for name in channels if name != "rgb.wrist"])
        if "rgb.wrist" in channels:
            small = look(state["pose"])[:, ::2, ::2]
            seen["rgb.wrist"] = small.flip(1) if self.flaw == "wrist" else small
        return seen


def test_every_camera_is_scored():
    cache = recording()
    cache.further = {"rgb.wrist": cache.rgb[:, ::2, ::2]}
    clips = clips_from_cache(cache, range(4), 3, 32, 6, make_rng(0))
    card = card_of({"a": TwoEyed(), "b": TwoEyed("wrist")}, {"recorded": clips})
    found = {
        (row.channel, row.arm): row.figure.value for row in card.find("pixels", "PSNR", motion="predicted", horizon=8)
    }
    assert (
        found["rgb", "a"] > 50
        and found["rgb.wrist", "a"] > 50
        and found["rgb", "b"] > 50 > 20 > found["rgb.wrist", "b"]
    )
    assert any(line.startswith("rgb.wrist PSNR") for line in verdict(card))
    assert "truth, rgb.wrist" in card.pictures[0].rows


def test_the_steered_worlds_keep_the_contract():
    for kind in KINDS:
        check_world(Steered(kind=kind))
    assert STEP_M > 0 and math.isfinite(TURN_RAD) and exam_of({}).config.batch == 5
