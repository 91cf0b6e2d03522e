"""BodiesWorld: families of bodies that move by formula, after phyworld (Kang et al. 2024), as Worlds that can be set to any state.

Training and test ranges are apart: `split="out"` draws speeds, sizes and heights that `split="in"` never has."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import torch
from gymnasium import spaces
from torch import Tensor

from ..core import chance
from ..core.errors import ContractError, ObservationError, TerrellaError
from ..core.similar import did_you_mean
from ..core.spec import DONE, Spec
from ..core.state import State
from ..physics.system import EARTH, PhysicalSystem, RigidBody, Rod, Slot, Wall
from .bodies_motion import GRAVITY, PIVOT, advance_bounce, advance_collide, advance_fall, advance_pendulum, advance_roll

DT_S, STEPS = 0.025, 64
SIDE = 64  # pixels of a picture
_DENSITY = 1000.0  # kg/m3
_FLOOR, _SKY, _COLOURS = (70, 78, 92), (16, 20, 27), ((111, 211, 193), (227, 168, 87), (142, 166, 255))
_STREAM = 11

Ranges = Mapping[str, tuple[tuple[float, float], ...]]  # name -> (low, high) in and out of training
Values = Mapping[str, Tensor]  # position [B, N, 2], velocity [B, N, 2], radius [B, N], spin [B, N]


@dataclass(frozen=True)
class BodiesFamily:
    """A kind of motion in the vertical plane (x, z)."""

    what: str
    draw: Callable[[Mapping[str, Tensor]], Values]  # numbers of an episode, each [B] -> its first state
    advance: Callable[[Values, float], Values]
    ranges: Ranges
    bodies: int = 1
    gravity: tuple[float, float, float] = EARTH
    walls: tuple[Wall, ...] = ()
    rods: tuple[Rod, ...] = ()
    dissipates: bool = False
    friction: float | None = None
    restitution: float | None = None
    spins: bool = False
    view: tuple[float, float, float] = (-2.0, -2.0, 4.0)  # x and z of the picture's corner, and its width, m
    facts: Mapping[str, float] = field(default_factory=dict)  # constants of the truth

    @property
    def system(self) -> PhysicalSystem:
        """The bodies of the family in the channels of its World."""
        bodies = tuple(
            RigidBody(
                f"ball {at + 1}", Slot("position", 2 * at), Slot("velocity", 2 * at),
                spin=Slot("spin", at) if self.spins else None, radius_m=Slot("radius", at), density_kg_m3=_DENSITY,
                friction=self.friction, restitution=self.restitution,
            )
            for at in range(self.bodies)
        )  # fmt: skip
        return PhysicalSystem(
            bodies, self.walls, self.rods, gravity_m_s2=self.gravity, axes=(0, 2), spin_axes=(1,), dissipates=self.dissipates,
            bounds_m=((-100.0, -1.0, -100.0), (100.0, 1.0, 100.0)),
        )  # fmt: skip


def _values(x: Tensor, z: Tensor, vx: Tensor, vz: Tensor, radius: Tensor, spin: Tensor | None = None) -> Values:
    """A first state of one body from its numbers [B]."""
    spin = torch.zeros_like(radius) if spin is None else spin
    pair = torch.stack([x, z], -1)[:, None], torch.stack([vx, vz], -1)[:, None]
    return {"position": pair[0], "velocity": pair[1], "radius": radius[:, None], "spin": spin[:, None]}


def _fly(n: Mapping[str, Tensor]) -> Values:
    return _values(n["x"], n["z"], n["speed"] * n["angle"].cos(), n["speed"] * n["angle"].sin(), n["radius"])


def _meet(n: Mapping[str, Tensor]) -> Values:
    """Two balls that approach each other, not quite head-on."""
    one = _values(-n["x"], n["z"], n["speed"], 0 * n["x"], n["radius"])
    two = _values(n["x"], -n["z"], -n["speed2"], 0 * n["x"], n["radius2"])
    return {name: torch.cat([one[name], two[name]], 1) for name in one}


def _hang(n: Mapping[str, Tensor]) -> Values:
    sin, cos = n["angle"].sin(), n["angle"].cos()
    return _values(sin, PIVOT - cos, n["turn"] * cos, n["turn"] * sin, n["radius"])


def _roll(n: Mapping[str, Tensor]) -> Values:
    return _values(n["x"], n["radius"], n["speed"], 0 * n["x"], n["radius"], n["spin"])


_RADIUS = ((0.1, 0.2), (0.25, 0.35))
_SAME = (-0.5, 0.5), (-0.5, 0.5)
_GROUND = Wall((0.0, 0.0, 0.0), normal=(0.0, 0.0, 1.0))
_SIDES = Wall((-1.0, 0.0, 0.0), normal=(1.0, 0.0, 0.0)), Wall((1.0, 0.0, 0.0), normal=(-1.0, 0.0, 0.0))
_NONE = (0.0, 0.0, 0.0)
RESTITUTION, FRICTION = 0.8, 0.2

FAMILIES: Mapping[str, BodiesFamily] = {
    "uniform": BodiesFamily(
        "a ball that moves on and on", _fly, lambda now, dt_s: advance_fall(now, dt_s, 0.0),
        {"x": _SAME, "z": _SAME, "speed": ((0.5, 2.0), (2.5, 4.0)), "angle": ((-3.14, 3.14),) * 2, "radius": _RADIUS},
        gravity=_NONE,
    ),
    "parabola": BodiesFamily(
        "a ball that is thrown", _fly, advance_fall,
        {"x": _SAME, "z": ((0.0, 1.0), (1.5, 2.5)), "speed": ((1.0, 3.0), (4.0, 6.0)), "angle": ((0.3, 2.8),) * 2,
         "radius": _RADIUS}, view=(-3.0, -4.0, 6.0), facts={"gravity_m_s2": GRAVITY},
    ),
    "collision": BodiesFamily(
        "two balls that collide", _meet, advance_collide,
        {"x": ((0.6, 1.0),) * 2, "z": ((-0.08, 0.08),) * 2, "speed": ((0.5, 1.5), (2.0, 3.0)), "radius": _RADIUS,
         "speed2": ((0.5, 1.5), (2.0, 3.0)), "radius2": _RADIUS}, bodies=2, gravity=_NONE, facts={"restitution": 1.0},
    ),
    "bouncing": BodiesFamily(
        "a ball that bounces between walls", _fly, lambda now, dt_s: advance_bounce(now, dt_s, RESTITUTION),
        {"x": _SAME, "z": ((0.6, 1.2), (1.6, 2.4)), "speed": ((0.0, 1.0), (1.5, 2.5)), "angle": ((-3.14, 3.14),) * 2,
         "radius": ((0.08, 0.16), (0.2, 0.28))},
        walls=(_GROUND, *_SIDES), dissipates=True, friction=0.0, restitution=RESTITUTION, view=(-1.2, -0.2, 2.4),
        facts={"gravity_m_s2": GRAVITY, "restitution": RESTITUTION},
    ),
    "pendulum": BodiesFamily(
        "a bob on a rod of 1 m", _hang, advance_pendulum,
        {"angle": ((-1.0, 1.0), (1.3, 2.2)), "turn": ((-1.0, 1.0), (1.5, 2.5)), "radius": _RADIUS},
        rods=(Rod("ball 1", (0.0, 0.0, PIVOT), 1.0),), view=(-1.5, -0.2, 3.0),
    ),
    "rolling": BodiesFamily(
        "a ball that slides until it rolls", _roll, lambda now, dt_s: advance_roll(now, dt_s, FRICTION),
        {"x": _SAME, "speed": ((0.5, 1.5), (2.5, 4.0)), "spin": ((-5.0, 5.0), (-15.0, -8.0)), "radius": _RADIUS},
        walls=(_GROUND,), dissipates=True, friction=FRICTION, spins=True, view=(-1.5, -0.5, 4.0),
        facts={"friction": FRICTION},
    ),
}  # fmt: skip


@dataclass(frozen=True)
class BodiesConfig:
    """The settings of a BodiesWorld."""

    # "in": the ranges of training; "out": beyond them.
    split: Literal["in", "out"] = "in"
    # Show a picture, 64 x 64.
    pictures: bool = True
    # Show which ball is seen at each pixel, as segmentation.
    segmentation: bool = False


class BodiesWorld:
    """`BodiesWorld("bouncing")`: a family of FAMILIES. It has one action, to wait.

    Channels: position [2 N] (x, z of each ball, m), velocity [2 N] (m/s), radius [N] (m), spin [N] (rad/s, where the family has
    one), rgb, segmentation (the number of the ball at each pixel, -1 for none), done.
    A state follows from its channels: `observe` sets it. TerrellaError for an unknown family."""

    def __init__(self, family: str, config: BodiesConfig = BodiesConfig()):
        if family not in FAMILIES:
            raise TerrellaError(
                f"there is no family '{family}'{did_you_mean(family, FAMILIES) or '.'} There are {', '.join(FAMILIES)}."
            )
        if config.split not in ("in", "out"):
            raise TerrellaError(f"the split of a family is in or out; got '{config.split}'.")
        self.family, self.config, count = FAMILIES[family], config, FAMILIES[family].bodies
        self._held = ("position", "velocity", "radius", *(["spin"] if self.family.spins else []))
        widths = {"position": 2 * count, "velocity": 2 * count, "radius": count, "spin": count}
        channels: dict[str, spaces.Space] = {name: _numbers(widths[name]) for name in self._held}
        channels |= {"rgb": spaces.Box(0, 255, (SIDE, SIDE, 3), np.uint8)} if config.pictures else {}
        channels |= {"segmentation": spaces.Box(-1, count - 1, (SIDE, SIDE), np.int32)} if config.segmentation else {}
        units = {"position": "m", "velocity": "m/s", "radius": "m", "spin": "rad/s"}
        self.spec = Spec(
            name=f"physics:{family}" + (":out" if config.split == "out" else ""),
            action=spaces.Discrete(1),
            channels={**channels, "done": DONE},
            observes=self._held,
            dt_s=DT_S,
            units={name: units[name] for name in self._held},
            action_names=("wait",),
            max_episode_steps=STEPS,
            card={"what": self.family.what, "kind": "simulator", "constants": dict(self.family.facts)},
            system=self.family.system.to_json(),
        )

    def start(self, batch: int, rng: torch.Generator) -> State:
        if batch < 1:
            raise ContractError(f"start needs a batch of 1 or more; got {batch}.")
        drawn = chance.uniform(chance.seeds(batch, rng), (len(self.family.ranges),), _STREAM).double()
        numbers, out = {}, self.config.split == "out"
        for at, (name, limits) in enumerate(self.family.ranges.items()):
            low, high = limits[out]
            numbers[name] = low + (high - low) * drawn[:, at]
        return self._state(self.family.draw(numbers))

    def observe(self, observation: Mapping[str, Tensor], prior: State | None, rng: torch.Generator) -> State:
        """The state that the channels say."""
        if lacks := [name for name in self._held if name not in observation]:
            raise ObservationError(f"{self.spec.name} observes {', '.join(lacks)}, which the observation lacks.")
        given = {name: torch.as_tensor(observation[name]).double() for name in self._held}
        count = self.family.bodies
        whole = {name: part.reshape(len(part), count, -1) for name, part in given.items()}
        for name in ("radius", "spin"):
            whole[name] = whole[name][..., 0] if name in whole else torch.zeros_like(whole["radius"])
        return self._state(whole)

    def imagine(self, state: State, action: Tensor, rng: torch.Generator) -> State:
        self.spec.check_action(action, state.batch)
        return self._state(self.family.advance(state, DT_S))

    def render(self, state: State, channels: Sequence[str]) -> dict[str, Tensor]:
        self.spec.check_channels(channels)
        return {name: self._shown(state, name) for name in channels}

    def _state(self, values: Values) -> State:
        done = torch.zeros(len(values["position"]), dtype=torch.bool)
        return State({**{name: values[name] for name in ("position", "velocity", "radius", "spin")}, "done": done})

    def _shown(self, state: State, name: str) -> Tensor:
        if name == "done":
            return state["done"]
        if name == "segmentation":
            return self._segmentation(state)
        return self._picture(state) if name == "rgb" else state[name].flatten(1).float()

    def _pixels(self) -> tuple[float, Tensor, Tensor]:
        """(size of a pixel, x of the columns [SIDE], z of the rows [SIDE]), m."""
        left, bottom, width = self.family.view
        pixel = width / SIDE
        middle = pixel * (torch.arange(SIDE) + 0.5).double()
        return pixel, left + middle, bottom + width - middle

    def _cover(self, state: State, at: int) -> Tensor:
        """How much of each pixel a ball covers [B, SIDE, SIDE], 0 to 1."""
        pixel, x, z = self._pixels()
        centre, radius = state["position"][:, at], state["radius"][:, at, None, None]
        away = ((x - centre[:, :1])[:, None, :] ** 2 + (z - centre[:, 1:])[:, :, None] ** 2).sqrt()
        return ((radius - away) / pixel + 0.5).clamp(0, 1)

    def _segmentation(self, state: State) -> Tensor:
        """int32 [B, SIDE, SIDE]: the number of the ball that is seen, -1 for none."""
        seen = torch.full((state.batch, SIDE, SIDE), -1, dtype=torch.int32)
        for at in range(self.family.bodies):
            seen[self._cover(state, at) > 0.5] = at
        return seen

    def _picture(self, state: State) -> Tensor:
        """uint8 [B, SIDE, SIDE, 3], seen from the side."""
        _, x, z = self._pixels()
        picture = torch.tensor(_SKY).double().expand(state.batch, SIDE, SIDE, 3).clone()
        for wall in self.family.walls:
            normal, centre = wall.normal or _NONE, wall.centre_m
            behind = (x[None, :] - centre[0]) * normal[0] + (z[:, None] - centre[2]) * normal[2] < 0
            picture[:, behind] = torch.tensor(_FLOOR).double()
        for at in range(self.family.bodies):
            cover = self._cover(state, at)[..., None]
            picture = picture * (1 - cover) + cover * torch.tensor(_COLOURS[at % len(_COLOURS)])
        return picture.round().to(torch.uint8)


def _numbers(count: int) -> spaces.Box:
    return spaces.Box(-np.inf, np.inf, (count,), np.float32)
