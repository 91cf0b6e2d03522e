"""Exact steps of bodies in the vertical plane: free flight, collisions, bounces, a pendulum, and sliding into rolling."""

from collections.abc import Mapping

import torch
from torch import Tensor

GRAVITY = 9.81  # m/s2
PIVOT = 1.5  # height of a pendulum's pivot, m; its rod has 1 m
BOUNCES = 4  # in one step, after which a ball rests
_SUBSTEPS = 8  # of a pendulum's step

Values = Mapping[str, Tensor]  # position [B, N, 2], velocity [B, N, 2], radius [B, N], spin [B, N]


def advance_fall(now: Values, dt_s: float, gravity: float = GRAVITY) -> dict[str, Tensor]:
    """Flight under gravity."""
    down = now["position"].new_tensor([0.0, -gravity])
    position = now["position"] + now["velocity"] * dt_s + 0.5 * down * dt_s**2
    return {**now, "position": position, "velocity": now["velocity"] + down * dt_s}


def advance_collide(now: Values, dt_s: float) -> dict[str, Tensor]:
    """Two smooth elastic balls of one density, without gravity; they collide once in a step at most."""
    position, velocity, radius = now["position"], now["velocity"], now["radius"]
    apart, closing = position[:, 1] - position[:, 0], velocity[:, 1] - velocity[:, 0]
    reach = radius.sum(1)
    a, b, c = closing.square().sum(1), (apart * closing).sum(1), apart.square().sum(1) - reach.square()
    root = b * b - a * c
    at = (-b - root.clamp_min(0).sqrt()) / a.clamp_min(1e-12)
    hits = (b < 0) & (root > 0) & (at <= dt_s)
    before = torch.where(hits, at.clamp(0, dt_s), dt_s)[:, None]
    meeting = apart + closing * before
    normal = meeting / meeting.norm(dim=1, keepdim=True).clamp_min(1e-12)
    mass = radius.double() ** 3
    impulse = 2 * (closing * normal).sum(1) / (1 / mass[:, 0] + 1 / mass[:, 1])
    kick = torch.where(hits, impulse, 0.0)[:, None] * normal
    after = torch.stack([velocity[:, 0] + kick / mass[:, :1], velocity[:, 1] - kick / mass[:, 1:]], 1)
    after_step = position + velocity * before[:, None] + after * (dt_s - before)[:, None]
    return {**now, "position": after_step, "velocity": after}


def advance_bounce(now: Values, dt_s: float, restitution: float) -> dict[str, Tensor]:
    """A smooth ball between two walls, 1 m from the middle, above a floor."""
    (x, z), (vx, vz), radius = now["position"].unbind(-1), now["velocity"].unbind(-1), now["radius"]
    x, vx = x + vx * dt_s, vx
    edge = 1 - radius
    beyond = x.abs() > edge
    bounced = edge - (x.abs() - edge) * restitution
    x, vx = torch.where(beyond, x.sign() * bounced, x), torch.where(beyond & (x * vx > 0), -restitution * vx, vx)
    left = torch.full_like(z, dt_s)
    for _ in range(BOUNCES):
        height = (z - radius).clamp_min(0)
        until = (vz + (vz * vz + 2 * GRAVITY * height).sqrt()) / GRAVITY  # seconds to the floor
        lands = until < left
        step = torch.where(lands, until, left)
        z, vz = z + vz * step - 0.5 * GRAVITY * step**2, vz - GRAVITY * step
        z, vz = torch.where(lands, radius, z), torch.where(lands, -restitution * vz, vz)
        left = left - step
    z, vz = torch.where(left > 0, radius, z), torch.where(left > 0, 0.0, vz)
    return {**now, "position": torch.stack([x, z], -1), "velocity": torch.stack([vx, vz], -1)}


def advance_pendulum(now: Values, dt_s: float) -> dict[str, Tensor]:
    """A bob on a rod of 1 m, by the classical Runge-Kutta method."""
    x, z = now["position"].unbind(-1)
    angle = torch.atan2(x, PIVOT - z)
    turn = now["velocity"][..., 0] * angle.cos() + now["velocity"][..., 1] * angle.sin()
    step = dt_s / _SUBSTEPS
    for _ in range(_SUBSTEPS):
        pull = [-GRAVITY * angle.sin()]
        speeds = [turn]
        for share in (0.5, 0.5, 1.0):
            pull.append(-GRAVITY * (angle + share * step * speeds[-1]).sin())
            speeds.append(turn + share * step * pull[-2])
        angle = angle + step / 6 * (speeds[0] + 2 * speeds[1] + 2 * speeds[2] + speeds[3])
        turn = turn + step / 6 * (pull[0] + 2 * pull[1] + 2 * pull[2] + pull[3])
    sin, cos = angle.sin(), angle.cos()
    position, velocity = torch.stack([sin, PIVOT - cos], -1), torch.stack([turn * cos, turn * sin], -1)
    return {**now, "position": position, "velocity": velocity}


def advance_roll(now: Values, dt_s: float, friction: float) -> dict[str, Tensor]:
    """A solid ball on a floor: friction acts until its lowest point stands still."""
    x, speed, spin, radius = now["position"][..., 0], now["velocity"][..., 0], now["spin"], now["radius"]
    slip = speed - spin * radius
    until = slip.abs() / (3.5 * friction * GRAVITY)
    sliding = until.clamp_max(dt_s)
    pull = -friction * GRAVITY * slip.sign()
    x = x + speed * sliding + 0.5 * pull * sliding**2
    speed = speed + pull * sliding
    spin = spin - pull / (0.4 * radius) * sliding
    spin = torch.where(until <= dt_s, speed / radius, spin)
    x = x + speed * (dt_s - sliding)
    position = torch.stack([x, radius], -1)
    return {**now, "position": position, "velocity": torch.stack([speed, torch.zeros_like(speed)], -1), "spin": spin}
