"""A small world that can be computed exactly, a recording of it, and dreams of it that are wrong in known ways."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, replace
from functools import lru_cache
from types import SimpleNamespace

import numpy as np
import torch
from gymnasium import spaces

from terrella.core import Spec, State, make_rng
from terrella.core.errors import ObservationError, TerrellaError
from terrella.measure import CLIPS, Clip, Exam, ExamConfig, clips_from_cache, examine
from terrella.space.camera import planar_pose, yaw

HEIGHT, WIDTH, STEP_M, TURN_RAD = 24, 32, 0.1, math.radians(3)


def look(pose: torch.Tensor) -> torch.Tensor:
    """What is seen from poses [B, 7]: a textured panorama that shifts with the heading and slides with the place."""
    columns = (torch.arange(WIDTH) / WIDTH - 0.5) * math.pi / 2
    around = yaw(pose)[:, None, None] - columns[None, None, :]
    rows = torch.arange(HEIGHT)[None, :, None] / HEIGHT
    x, y = pose[:, 0, None, None], pose[:, 1, None, None]
    waves = [
        0.5 + 0.3 * torch.sin(around + 3 * rows) + 0.2 * torch.sin(7 * around + x),
        0.5 + 0.3 * torch.cos(3 * around + y) + 0.2 * torch.sin(11 * around + 5 * rows),
        0.5 + 0.5 * torch.sin(5 * around + x + y) * torch.cos(2 * rows),
    ]
    return (torch.stack(torch.broadcast_tensors(*waves), -1) * 255).round().clamp(0, 255).to(torch.uint8)


def move(pose: torch.Tensor, action: torch.Tensor, stride: float = STEP_M) -> torch.Tensor:
    """Poses after the buttons [B, 3]: forward, turn left, turn right."""
    heading = yaw(pose) + TURN_RAD * (action[:, 1] - action[:, 2])
    gone = stride * action[:, 0]
    x, y = pose[:, 0] + gone * heading.cos(), pose[:, 1] + gone * heading.sin()
    return planar_pose(x, y, pose[:, 2], heading)


@lru_cache
def _spec_of(flaw: str, height: int, width: int) -> Spec:
    posed = flaw != "blind"
    return Spec(
        name=f"panorama {flaw}".strip(),
        action=spaces.MultiBinary(3),
        channels={
            "rgb": spaces.Box(0, 255, (height, width, 3), np.uint8),
            **({"pose": spaces.Box(-np.inf, np.inf, (7,), np.float32)} if posed else {}),
        },
        observes=("rgb", "pose") if posed else ("rgb",),
        dt_s=1 / 35,
        action_names=("FORWARD", "LEFT", "RIGHT"),
    )


@dataclass(frozen=True)
class Panorama:
    """Knows the truth. flaw: "static" shows its last frame for ever; "deaf" ignores the actions; "long" strides 10%
    too far; "fading" loses contrast at each step; "shy" takes no pose alone; "blind" shows and takes no pose;
    "forgetful" draws junk after turning."""

    flaw: str = ""

    @property
    def spec(self) -> Spec:
        shared = _spec_of(self.flaw, HEIGHT, WIDTH)
        return replace(shared, channels=dict(shared.channels))  # subclasses add channels to it

    def start(self, batch: int, rng: torch.Generator) -> State:
        if batch < 1:
            raise TerrellaError("start at least one story")
        heading = torch.rand(batch, generator=rng) * 2 * math.pi
        return self._state(planar_pose(*torch.zeros(3, batch), heading))

    def observe(self, observation, prior: State | None, rng: torch.Generator) -> State:
        if "rgb" in observation:
            pose = observation.get("pose", planar_pose(*torch.zeros(4, len(observation["rgb"]))))
            return self._state(pose).replace(frame=observation["rgb"])
        if self.flaw == "shy" or prior is None:
            raise ObservationError("this world needs rgb")
        return self._next(prior, observation["pose"])

    def imagine(self, state: State, action: torch.Tensor, rng: torch.Generator) -> State:
        action = self.spec.check_action(action, state.batch).float()
        if self.flaw == "deaf":
            action = torch.tensor([1.0, 0.0, 0.0]).expand(state.batch, 3)
        return self._next(state, move(state["pose"], action, STEP_M * (1.1 if self.flaw == "long" else 1)))

    def render(self, state: State, channels) -> dict[str, torch.Tensor]:
        self.spec.check_channels(channels)
        return {name: state["frame" if name == "rgb" else name] for name in channels}

    def _state(self, pose: torch.Tensor) -> State:
        return State({"pose": pose, "frame": look(pose), "age": torch.zeros(len(pose))})

    def _next(self, state: State, pose: torch.Tensor) -> State:
        age = state["age"] + 1
        if self.flaw == "static":
            return state.replace(pose=pose, age=age)
        frame = look(pose)
        if self.flaw == "fading":
            kept = torch.exp(-age / 50)[:, None, None, None]
            frame = (127 + (frame.float() - 127) * kept).round().to(torch.uint8)
        if self.flaw == "forgetful" and age[0] > 60:
            frame = 255 - frame
        return State({"pose": pose, "frame": frame, "age": age})


def recording(episodes: int = 4, length: int = 200, seed: int = 0) -> SimpleNamespace:
    """What a clip cache of a player in the panorama looks like; keys are held for five to twenty steps."""
    return copy.deepcopy(_recorded(episodes, length, seed, HEIGHT, WIDTH))


@lru_cache
def _recorded(episodes: int, length: int, seed: int, height: int, width: int) -> SimpleNamespace:
    rng, world = make_rng(seed), Panorama()
    poses, actions, ranges = [], [], []
    for episode in range(episodes):
        state, action, left = world.start(1, rng), torch.zeros(1, 3), 0
        for _ in range(length):
            if left == 0:
                action = (torch.rand(1, 3, generator=rng) < 0.5).float()
                left = int(torch.randint(5, 20, (1,), generator=rng))
            poses.append(state["pose"])
            actions.append(action)
            state, left = world.imagine(state, action, rng), left - 1
        ranges.append((episode * length, (episode + 1) * length))
    total = episodes * length
    pose = torch.cat(poses)
    valid = np.ones(total, bool)
    valid[length - 1 :: length] = False
    return SimpleNamespace(
        further={},
        arrays={},
        keys={},
        action_names=Panorama().spec.action_names,
        rgb=look(pose).numpy(),
        depth=None,
        pose=pose.numpy(),
        action=torch.cat(actions).numpy(),
        action_valid=valid,
        reward=np.zeros(total, np.float32),
        done=np.zeros(total, bool),
        episodes=ranges,
        world={},
    )


def some_clips(count: int = 12, horizon: int = 32, context: int = 3, seed: int = 0) -> list[Clip]:
    return clips_from_cache(recording(seed=seed), range(4), context, horizon, count, make_rng(seed))


SHORT = {
    "drop": (8, 32),
    "batch": 5,
    "strips": 2,
    "closure_deg": (),
    "closure_walk": 0,
    "long_steps": 0,
    "still_steps": 0,
    "speed_steps": 0,
}


def exam_of(arms, places=None, config=None, seed: int = 0, **more) -> Exam:
    """An exam of worlds by name, on clips of the panorama."""
    config = config or ExamConfig((1, 8, 32), (8, 32), **SHORT)
    sets = {CLIPS: places or {"recorded": some_clips()}, **more.pop("sets", {})}
    return Exam(arms, sets, config, seed, **more)


def card_of(arms, places=None, config=None, seed: int = 0, **more):
    """The card of an exam of the panorama."""
    return examine(exam_of(arms, places, config, seed, **more))
