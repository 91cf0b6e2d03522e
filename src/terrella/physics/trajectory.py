"""Trajectory: the bodies of a rollout as tensors, read from any World's channels."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, wraps
from typing import Any, TypeVar

import torch
from torch import Tensor

from ..core.errors import ChannelError
from .gaps import body_gaps, wall_gaps
from .system import PhysicalSystem, RigidBody, Slot

SKIN = 0.02  # of a body's size: gaps below it count as contact
Value = TypeVar("Value")
REACH = 1.25  # times the way of a step, within which two bodies may have touched in between


@dataclass(frozen=True)
class Trajectory:
    """T + 1 instants of B rollouts of N bodies, float64."""

    system: PhysicalSystem
    dt_s: float
    position: Tensor  # [T + 1, B, N, 3], m
    velocity: Tensor  # [T + 1, B, N, 3], m/s; differences of positions where no channel holds it
    rotation: Tensor  # [T + 1, B, N, 4], quaternion w, x, y, z
    spin: Tensor  # [T + 1, B, N, 3], rad/s, body frame; 0 where no channel holds it
    present: Tensor  # bool [T + 1, B, N]
    radius: Tensor  # [T + 1, B, N], m
    channels: Mapping[str, Tensor]  # [T + 1, B, K], as rendered
    memo: dict[Any, Any] = field(default_factory=dict, init=False, repr=False, compare=False)  # of `once`

    @property
    def steps(self) -> int:
        return len(self.position) - 1

    @property
    def batch(self) -> int:
        return self.position.shape[1]

    @cached_property
    def half(self) -> Tensor:
        """Half extents [N, 3] of the boxes inside the bodies, m."""
        return self.position.new_tensor([body.half_m for body in self.system.bodies])

    @cached_property
    def size(self) -> Tensor:
        """The smallest distance from a body's centre to its surface [T + 1, B, N], m."""
        return (self.radius + self.half.amin(-1)).clamp_min(1e-6)

    @cached_property
    def mass(self) -> Tensor:
        """[T + 1, B, N], kg."""
        columns = [
            body.density_kg_m3 * 4 / 3 * math.pi * self.radius[..., at] ** 3
            if body.density_kg_m3 is not None
            else torch.full_like(self.radius[..., at], body.mass_kg)
            for at, body in enumerate(self.system.bodies)
        ]
        return torch.stack(columns, -1)

    @cached_property
    def inertia(self) -> Tensor:
        """Principal moments [T + 1, B, N, 3], kg m2; of a solid sphere where the system gives none."""
        columns = [
            self.position.new_tensor(body.inertia_kg_m2).expand(*self.radius.shape[:2], 3)
            if body.inertia_kg_m2 is not None
            else (0.4 * self.mass[..., at] * self.size[..., at] ** 2)[..., None].expand(-1, -1, 3)
            for at, body in enumerate(self.system.bodies)
        ]
        return torch.stack(columns, 2)

    @cached_property
    def gravity(self) -> Tensor:
        return self.position.new_tensor(self.system.gravity_m_s2)

    @cached_property
    def driven(self) -> Tensor:
        """bool [N]."""
        return torch.tensor([body.driven for body in self.system.bodies])

    @cached_property
    def tied(self) -> Tensor:
        """bool [N]: bodies on a rod."""
        held = {rod.body for rod in self.system.rods}
        return torch.tensor([body.name in held for body in self.system.bodies])

    @cached_property
    def wall_gaps(self) -> Tensor:
        """Distances of bodies to walls [T + 1, B, N, W], m, below 0 where they overlap."""
        return wall_gaps(self.position, self.rotation, self.half, self.radius, self.system.walls)

    @cached_property
    def body_gaps(self) -> Tensor:
        """Distances between bodies [T + 1, B, N, N], m; infinite to itself and to bodies that are not there."""
        gaps = body_gaps(self.position, self.rotation, self.half, self.radius)
        here = self.present[..., :, None] & self.present[..., None, :]
        return gaps.masked_fill(~here, math.inf)

    @cached_property
    def _way(self) -> Tensor:
        """The way [T, B, N] that a body may have gone in each step, with a skin, m."""
        speed = self.velocity.norm(dim=-1)
        fall = 0.5 * self.gravity.norm() * self.dt_s**2
        skin = SKIN * torch.maximum(self.size[1:], self.size[:-1])
        return REACH * self.dt_s * torch.maximum(speed[1:], speed[:-1]) + fall + skin

    @cached_property
    def walls_touched(self) -> Tensor:
        """bool [T, B, N, W]: a body may have touched a wall within the step."""
        gaps = self.wall_gaps
        return (gaps[1:] + gaps[:-1] < self._way[..., None]) | (torch.minimum(gaps[1:], gaps[:-1]) < 0)

    @cached_property
    def bodies_touched(self) -> Tensor:
        """bool [T, B, N, N]: two bodies may have touched within the step."""
        gaps, way = self.body_gaps, self._way[..., :, None] + self._way[..., None, :]
        return (gaps[1:] + gaps[:-1] < way) | (torch.minimum(gaps[1:], gaps[:-1]) < 0)

    @cached_property
    def both_present(self) -> Tensor:
        """bool [T, B, N]: there before and after the step."""
        return self.present[1:] & self.present[:-1]

    @cached_property
    def clear(self) -> Tensor:
        """bool [T, B, N]: nothing but gravity acts on the body within the step."""
        touched = self.walls_touched.any(-1) | self.bodies_touched.any(-1)
        if self.system.tracked:
            beside = touched.clone()
            beside[1:] |= touched[:-1]
            beside[:-1] |= touched[1:]
            touched = beside
        return ~touched & self.both_present & ~self.driven & ~self.tied

    @cached_property
    def left_alone(self) -> Tensor:
        """bool [T, B]: no driven body may have touched another one within the step."""
        driven = self.driven
        pushes = self.bodies_touched & driven[:, None] & ~driven[None, :]
        return ~pushes.flatten(2).any(-1)

    def at(self, rows: Tensor) -> Trajectory:
        """The rollouts `rows` (int64 or bool) alone."""
        parts = {name: getattr(self, name)[:, rows] for name in _PARTS}
        return replace(self, **parts, channels={name: part[:, rows] for name, part in self.channels.items()})

    def put(self, rows: Tensor, part: Trajectory) -> Trajectory:
        """The same with `part` in place of the rollouts `rows` (int64)."""
        if len(rows) == self.batch:
            return part
        parts = {name: getattr(self, name).index_copy(1, rows, getattr(part, name)) for name in _PARTS}
        channels = {name: own.index_copy(1, rows, part.channels[name]) for name, own in self.channels.items()}
        return replace(self, **parts, channels=channels)

    def instants(self, instants: Tensor) -> Trajectory:
        """One instant of each rollout (int64 [B]) alone."""
        rows = torch.arange(self.batch)
        parts = {name: getattr(self, name)[instants, rows][None] for name in _PARTS}
        return replace(
            self, **parts, channels={name: part[instants, rows][None] for name, part in self.channels.items()}
        )

    def between(self, first: int, stop: int) -> Trajectory:
        """The instants first to stop - 1 alone."""
        parts = {name: getattr(self, name)[first:stop] for name in _PARTS}
        return replace(self, **parts, channels={name: part[first:stop] for name, part in self.channels.items()})


def once(function: Callable[[Trajectory], Value]) -> Callable[[Trajectory], Value]:
    """The same function of a motion, computed once for each motion: several laws need it."""

    @wraps(function)
    def kept(motion: Trajectory) -> Value:
        if function not in motion.memo:
            motion.memo[function] = function(motion)
        return motion.memo[function]

    return kept


_PARTS = ("position", "velocity", "rotation", "spin", "present", "radius")


def trajectory_of(system: PhysicalSystem, observations: Mapping[str, Tensor], dt_s: float) -> Trajectory:
    """The bodies in observations [T + 1, B, ...] of steps of `dt_s` seconds. ChannelError names channels that are missing or too
    short."""
    if missing := [name for name in system.channels if name not in observations]:
        raise ChannelError(
            f"the laws need the channels {', '.join(missing)}, which are not there; there are {', '.join(observations)}."
        )
    whole = {name: observations[name].cpu().double() for name in system.channels}
    flat = {name: part.flatten(2) if part.ndim > 2 else part[..., None] for name, part in whole.items()}
    each = [_body(system, body, flat, dt_s) for body in system.bodies]
    position, velocity, rotation, spin, present, radius = (torch.stack(part, 2) for part in zip(*each))
    return Trajectory(system, dt_s, position, velocity, rotation, spin, present, radius, flat)


def _body(system: PhysicalSystem, body: RigidBody, flat: Mapping[str, Tensor], dt_s: float) -> tuple[Tensor, ...]:
    """A body is there where each number that the channels hold of it is finite; what is not reads as 0, or as no rotation."""
    read = [_numbers(flat, body.position, len(system.axes))]
    position = _spread(read[0], system.axes)
    if body.velocity is not None:
        read.append(_numbers(flat, body.velocity, len(system.axes)))
        velocity = _spread(read[-1], system.axes)
    elif len(position) > 1:
        way = position.diff(dim=0)
        half = _gained(system, body, way, dt_s)  # from the middle of each step to its end
        velocity = torch.cat([way[:1] / dt_s - half[:1], way / dt_s + half])
    else:
        velocity = torch.zeros_like(position)
    upright = position.new_tensor([1.0, 0, 0, 0]).expand(*position.shape[:2], 4)
    rotation, spin = upright, torch.zeros_like(position)
    if body.rotation is not None:
        read.append(_numbers(flat, body.rotation, 4))
        turned = read[-1] / read[-1].norm(dim=-1, keepdim=True).clamp_min(1e-9)
        rotation = torch.where(read[-1].isfinite().all(-1, keepdim=True), turned, upright)
    if body.spin is not None:
        read.append(_numbers(flat, body.spin, len(system.spin_axes)))
        spin = _spread(read[-1], system.spin_axes)
    given = body.radius_m
    radius = torch.full_like(position[..., 0], 0.0 if isinstance(given, Slot) else given)
    if isinstance(given, Slot):
        read.append(_numbers(flat, given, 1))
        radius = read[-1][..., 0]
    here = torch.cat(read, -1).isfinite().all(-1)
    if body.present is not None:
        here = here & (_numbers(flat, body.present, 1)[..., 0] != 0)
    position, velocity, spin, radius = (part.nan_to_num(0, 0, 0) for part in (position, velocity, spin, radius))
    return position, velocity, rotation, spin, here, radius


def _gained(system: PhysicalSystem, body: RigidBody, way: Tensor, dt_s: float) -> Tensor:
    """The velocity [T, B, 3] that gravity adds in half of each step to a body that goes `way`: none where it is driven, on a rod,
    or at rest, which is two steps in a row with less than a quarter of g dt2 along gravity (in flight they differ by g dt2)."""
    gravity = way.new_tensor(system.gravity_m_s2)
    if body.driven or body.name in {rod.body for rod in system.rods}:
        return torch.zeros_like(way)
    slow = (way @ gravity).abs() < 0.25 * gravity.square().sum() * dt_s**2
    beside = torch.zeros_like(slow)
    beside[1:] |= slow[:-1]
    beside[:-1] |= slow[1:]
    return torch.where((slow & beside)[..., None], 0.0, 0.5 * dt_s * gravity)


def _numbers(flat: Mapping[str, Tensor], slot: Slot, count: int) -> Tensor:
    values = flat[slot.channel]
    if values.shape[-1] < slot.first + count:
        raise ChannelError(
            f"the channel '{slot.channel}' has {values.shape[-1]} numbers; the system needs {slot.first + count} of it."
        )
    return values[..., slot.first : slot.first + count]


def _spread(values: Tensor, axes: tuple[int, ...]) -> Tensor:
    """Numbers [..., len(axes)] as vectors [..., 3]."""
    if axes == (0, 1, 2):
        return values
    whole = values.new_zeros(*values.shape[:-1], 3)
    whole[..., list(axes)] = values
    return whole


def channels_of(motion: Trajectory) -> dict[str, Tensor]:
    """The channels of the last instant [B, K], with the bodies that are there written into them: the inverse of `trajectory_of`."""
    flat = {name: part[-1].clone() for name, part in motion.channels.items()}
    axes, spin_axes = list(motion.system.axes), list(motion.system.spin_axes)
    for at, body in enumerate(motion.system.bodies):
        parts = [(body.position, motion.position[-1, :, at][:, axes])]
        parts += [(body.velocity, motion.velocity[-1, :, at][:, axes])] if body.velocity else []
        parts += [(body.rotation, motion.rotation[-1, :, at])] if body.rotation else []
        parts += [(body.spin, motion.spin[-1, :, at][:, spin_axes])] if body.spin else []
        parts += [(body.radius_m, motion.radius[-1, :, at, None])] if isinstance(body.radius_m, Slot) else []
        here = motion.present[-1, :, at]
        for slot, values in parts:
            held = flat[slot.channel][:, slot.first : slot.first + values.shape[1]]
            held.copy_(torch.where(here[:, None], values, held))
        if body.present is not None:
            held = flat[body.present.channel][:, body.present.first]
            was = motion.channels[body.present.channel][-2, :, body.present.first] if motion.steps else held
            held.copy_(torch.where(here, torch.where(held != 0, held, was), 0.0))
    return flat
