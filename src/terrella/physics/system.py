"""PhysicalSystem: which bodies, walls and limits a world has, and which numbers of its channels hold them."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ..core.errors import TerrellaError
from ..core.typed_values import typed

EARTH = (0.0, 0.0, -9.81)
UPRIGHT = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Slot:
    """Numbers of a channel, from number `first` of its flattened values on."""

    channel: str
    first: int = 0

    def __post_init__(self):
        if self.first < 0:
            raise TerrellaError(f"a slot of '{self.channel}' begins at number {self.first}; the first one is 0.")


@dataclass(frozen=True)
class RigidBody:
    """A box with rounded edges: half extents 0 make a sphere, a radius of 0 a box."""

    name: str
    position: Slot  # centre of mass, one number for each of the system's axes, m
    velocity: Slot | None = None  # one number for each axis, m/s
    rotation: Slot | None = None  # quaternion w, x, y, z
    spin: Slot | None = (
        None  # angular velocity in the body's frame, one number for each of the system's spin axes, rad/s
    )
    present: Slot | None = None  # one number, 0 where the body is not there; None: it is always there
    radius_m: float | Slot = 0.0  # of the rounding
    half_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    mass_kg: float = 1.0
    density_kg_m3: float | None = None  # of a sphere whose radius is a Slot; replaces the mass
    inertia_kg_m2: tuple[float, float, float] | None = None  # principal moments; default: a solid sphere's
    driven: bool = False  # an actuator, a player or a program moves it
    friction: float | None = None  # coefficient against walls, where it is known
    restitution: float | None = None  # speed after a bounce from a plane over that before, where it is known
    max_speed_m_s: float | None = None

    @property
    def channels(self) -> set[str]:
        slots = (self.position, self.velocity, self.rotation, self.spin, self.present, self.radius_m)
        return {slot.channel for slot in slots if isinstance(slot, Slot)}


@dataclass(frozen=True)
class Wall:
    """A fixed box, or with `normal` a half-space that bodies stay in front of."""

    centre_m: tuple[float, float, float]
    half_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation: tuple[float, float, float, float] = UPRIGHT
    normal: tuple[float, float, float] | None = None

    def __post_init__(self):
        if self.normal is not None and abs(math.hypot(*self.normal) - 1) > 1e-3:
            raise TerrellaError(f"a wall's normal is {self.normal}; give it the length 1.")


@dataclass(frozen=True)
class Rod:
    """Keeps a body's centre at a distance from a fixed point."""

    body: str
    pivot_m: tuple[float, float, float]
    length_m: float

    def __post_init__(self):
        if not self.length_m > 0:
            raise TerrellaError(f"the rod of '{self.body}' is {self.length_m:g} m long; give it a length above 0.")


@dataclass(frozen=True)
class Limit:
    """The range of one number of a channel: a joint, a speed, a torque."""

    name: str
    slot: Slot
    low: float
    high: float
    unit: str = ""

    def __post_init__(self):
        if not self.low < self.high:
            raise TerrellaError(f"the limit '{self.name}' is from {self.low:g} to {self.high:g}; low is below high.")


@dataclass(frozen=True)
class PhysicalSystem:
    """The bodies of a world. `axes`: the axes of space (x, y, z up) that a position has."""

    bodies: tuple[RigidBody, ...]
    walls: tuple[Wall, ...] = ()
    rods: tuple[Rod, ...] = ()
    limits: tuple[Limit, ...] = ()
    gravity_m_s2: tuple[float, float, float] = EARTH
    axes: tuple[int, ...] = (0, 1, 2)
    spin_axes: tuple[int, ...] = (0, 1, 2)
    dissipates: bool = True  # False: mechanical energy is constant
    bounds_m: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None
    """The box (low corner, high corner) that bodies never leave."""
    hidden: tuple[str, ...] = ()  # moving parts that touch bodies and that no channel holds
    tracked: bool = (
        False  # velocities are measured from positions, so those beside a contact may be of either side of it
    )

    def __post_init__(self):
        names = [body.name for body in self.bodies]
        if not names or len(set(names)) < len(names):
            raise TerrellaError("a physical system has one body or more, each with a name of its own.")
        if any(len({*axes}) < len(axes) or not {*axes} <= {0, 1, 2} for axes in (self.axes, self.spin_axes)):
            raise TerrellaError(
                f"axes {self.axes} and spin_axes {self.spin_axes} are of 0 (x), 1 (y) and 2 (z), each once."
            )
        if strangers := sorted({rod.body for rod in self.rods} - set(names)):
            raise TerrellaError(f"a rod holds {', '.join(strangers)}, which is no body; there are {', '.join(names)}.")

    @property
    def channels(self) -> tuple[str, ...]:
        """The channels that hold the system."""
        names = {name for body in self.bodies for name in body.channels} | {one.slot.channel for one in self.limits}
        return tuple(sorted(names))

    def to_json(self) -> dict[str, Any]:
        """As JSON values."""
        return asdict(self)

    @staticmethod
    def from_json(facts: Mapping[str, Any]) -> PhysicalSystem:
        """The inverse of `to_json`; TerrellaError for other facts."""
        return typed(PhysicalSystem, dict(facts), "the physical system")

    @staticmethod
    def read(file: str | Path) -> PhysicalSystem:
        """The system in a JSON file; TerrellaError where it cannot be read."""
        try:
            facts = json.loads(Path(file).read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise TerrellaError(f"{file} is no JSON file of a physical system ({error}).") from error
        try:
            return typed(PhysicalSystem, facts, "the physical system")
        except TerrellaError as error:
            raise TerrellaError(f"{file}: {error} docs/physics.md shows one.") from error
