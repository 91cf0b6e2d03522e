"""Judge: the last step of each rollout against the laws, and its projection onto them. On a CPU a kernel of numba does it;
`judge_slowly` is the same by the laws themselves."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..core.backend import kernels_do
from ..core.errors import ChannelError
from ..space.views import arrays, over_views
from .gaps import rotated
from .kernels_numba import columns
from .kernels_numba.guard import guard_rows
from .laws import LAWS
from .laws.free_fall import rods_alone
from .system import PhysicalSystem, RigidBody, Slot
from .tolerance import Tolerance
from .trajectory import REACH, SKIN, Trajectory, channels_of, trajectory_of

ORDER = (
    "permanence", "free fall", "momentum", "support and friction", "limits", "energy", "continuity", "non-penetration",
)  # fmt: skip
ROUNDS = 3  # of projections: one may break a law that was kept before
_PLACED = ("position", "velocity", "rotation", "spin", "present", "radius")


@dataclass(frozen=True)
class Judged:
    """What `Judge` says of B rollouts; ratios are violations of the last step in tolerances [B, L]."""

    seen: Tensor  # the channels [B, K], corrected
    changed: Tensor  # bool [B]
    before: Tensor  # ratios as predicted
    left: Tensor  # ratios after the correction
    way: Tensor  # [B, 2], of all bodies in the step, as predicted and as corrected, m; a jump counts as far as speeds reach


class Judge:
    """`judge(held, seen, fresh, allowed)`: held [B, 2, K], the two instants before, and seen [B, K], float64, hold the channels of
    the system one after the other, `widths` numbers each. fresh: episodes of one step only. allowed: rollouts to correct."""

    def __init__(self, system: PhysicalSystem, tolerances: Sequence[Tolerance], dt_s: float, widths: Mapping[str, int]):
        self.system, self.dt_s, self.widths = system, dt_s, dict(widths)
        self.tolerances = sorted(tolerances, key=lambda one: ORDER.index(one.law.name))
        self._laws = torch.tensor([ORDER.index(one.law.name) for one in self.tolerances], dtype=torch.long)
        kinds = {type(law) for law in LAWS}
        self._compiled = all(type(one.law) in kinds for one in self.tolerances)
        self._limits = np.zeros(len(ORDER))
        for one in self.tolerances:
            self._limits[ORDER.index(one.law.name)] = one.value
        self._matrix = matrix_of(system, dt_s, self.widths)

    def __call__(self, held: Tensor, seen: Tensor, fresh: Tensor, allowed: Tensor) -> Judged:
        if not self._compiled or not kernels_do(seen):
            return judge_slowly(self, held, seen, fresh, allowed)
        batch, own = len(seen), seen.clone()
        ratios = torch.zeros(batch, 2, len(ORDER), dtype=torch.float64)
        way, changed = torch.zeros(batch, 2, dtype=torch.float64), torch.zeros(batch, dtype=torch.bool)
        parts = arrays(held, own, fresh, allowed, ratios, way, changed)

        def work(first: int, last: int) -> None:
            guard_rows(self._matrix, self._limits, ROUNDS, *parts, first, last)  # pyright: ignore[reportCallIssue]

        over_views(batch, work)
        before, left = ratios.index_select(2, self._laws).unbind(1)
        return Judged(own, changed, before, left, way)

    def parts(self, flat: Tensor) -> dict[str, Tensor]:
        """The channels in numbers [..., K]."""
        return dict(zip(self.widths, flat.split(list(self.widths.values()), -1)))


def matrix_of(system: PhysicalSystem, dt_s: float, widths: Mapping[str, int]) -> np.ndarray:
    """The system as the kernels read it, float64 [1 + bodies + walls + rods + limits, columns]. ChannelError where a channel is
    too short."""
    first = dict(zip(widths, np.cumsum([0, *widths.values()]).tolist()))

    def at(slot: Slot | None, count: int) -> int:
        if slot is None:
            return -1
        if slot.first + count > widths[slot.channel]:
            raise ChannelError(
                f"the channel '{slot.channel}' has {widths[slot.channel]} numbers; the system needs {slot.first + count} of it."
            )
        return first[slot.channel] + slot.first

    def body_row(body: RigidBody) -> list[float]:
        given, unknown = body.radius_m, math.nan
        axes, half = len(system.axes), body.half_m
        row = [
            at(body.position, axes),
            at(body.velocity, axes),
            at(body.rotation, 4),
            at(body.spin, len(system.spin_axes)),
        ]
        row += [at(body.present, 1), at(given, 1) if isinstance(given, Slot) else -1]
        row += [0.0 if isinstance(given, Slot) else given, *half, math.hypot(*half), min(half)]
        row += [unknown if body.density_kg_m3 is None else body.density_kg_m3, body.mass_kg]
        row += [*(body.inertia_kg_m2 or (unknown,) * 3), body.driven, body.name in {rod.body for rod in system.rods}]
        row += [unknown if value is None else value for value in (body.friction, body.restitution)]
        return [float(value) for value in [*row, body.max_speed_m_s or unknown]]

    walls = []
    for wall in system.walls:
        normal, turn = wall.normal or (0.0, 0.0, 0.0), rotated(torch.tensor(wall.rotation, dtype=torch.float64))
        height = sum(a * b for a, b in zip(normal, wall.centre_m))
        walls.append(
            [float(wall.normal is not None), *normal, height, *wall.centre_m, *wall.half_m, *turn.flatten().tolist()]
        )
    names, alone = [body.name for body in system.bodies], rods_alone(system)
    rods = [[names.index(rod.body), *rod.pivot_m, rod.length_m, float(rod in alone)] for rod in system.rods]
    limits = [[at(one.slot, 1), one.low, one.high] for one in system.limits]
    low, high = system.bounds_m or ((0.0,) * 3, (0.0,) * 3)
    pull = system.gravity_m_s2
    facts = [
        dt_s,
        *pull,
        math.hypot(*pull),
        system.dissipates,
        system.tracked,
        system.bounds_m is not None,
        *low,
        *high,
    ]
    axes = [[*part, *[-1] * (3 - len(part))] for part in (system.axes, system.spin_axes)]
    facts += [SKIN, REACH, *axes[0], *axes[1], len(system.bodies), len(walls), len(rods), len(limits)]
    rows = [facts, *(body_row(body) for body in system.bodies), *walls, *rods, *limits]
    matrix = np.zeros((len(rows), columns.SYSTEM))
    for row, values in zip(matrix, rows):
        row[: len(values)] = values
    return matrix


# -- the same by the laws themselves ----------------------------------------------------------------------------------


def judge_slowly(judge: Judge, held: Tensor, seen: Tensor, fresh: Tensor, allowed: Tensor) -> Judged:
    """The same as `Judge`, for any laws."""
    rows = torch.cat([held, seen[:, None]], 1).transpose(0, 1)
    predicted = trajectory_of(judge.system, judge.parts(rows), judge.dt_s)
    before = left = _ratios(judge, predicted, fresh)
    motion = predicted
    for _ in range(ROUNDS):
        rows = ((left > 1).any(1) & allowed).nonzero()[:, 0]
        if not len(rows):
            break
        part, wrong = motion.at(rows), left[rows] > 1
        for one, broken in zip(judge.tolerances, wrong.T):
            if broken.any():  # an earlier projection may have mended it
                broken = broken & (_ratio(one, part, fresh[rows]) > 1)
            if broken.any():
                part = _mixed(part, one.law.correct(part), broken)
        motion = motion.put(rows, part)
        left = left.index_copy(0, rows, _ratios(judge, part, fresh[rows]))
    changed = changed_rollouts(predicted, motion)
    flat = channels_of(motion)
    whole = torch.where(changed[:, None], torch.cat([flat[name] for name in judge.widths], 1), seen)
    return Judged(whole, changed, before, left, torch.stack([_way(predicted), _way(motion)], 1))


def _ratios(judge: Judge, motion: Trajectory, fresh: Tensor) -> Tensor:
    """The violation of the last step by each law [B, L], in tolerances."""
    none = [motion.position.new_zeros(motion.batch, 0)]
    return torch.cat([*none, *(_ratio(one, motion, fresh)[:, None] for one in judge.tolerances)], 1)


def _ratio(one: Tolerance, motion: Trajectory, fresh: Tensor) -> Tensor:
    whole = one.law.residual(motion)[-1]
    if fresh.any():
        whole = torch.where(fresh, one.law.residual(motion.between(1, 3))[-1], whole)
    return (whole / one.value).nan_to_num(nan=torch.inf)


def _way(motion: Trajectory) -> Tensor:
    """The way of all bodies in the last step [B], m; a jump counts as far as the larger speed reaches."""
    reach = motion.velocity[-2:].norm(dim=-1).amax(0) * motion.dt_s
    return torch.minimum((motion.position[-1] - motion.position[-2]).norm(dim=-1), reach).sum(-1)


def changed_rollouts(before: Trajectory, after: Trajectory) -> Tensor:
    """bool [B]: the rollouts whose last instant differs."""
    if before is after:
        return torch.zeros(before.batch, dtype=torch.bool)
    parts = [(getattr(before, name), getattr(after, name)) for name in _PLACED]
    parts += [(part, after.channels[name]) for name, part in before.channels.items()]
    apart = [(one != other) & ((one == one) | (other == other)) for one, other in ((a[-1], b[-1]) for a, b in parts)]
    return torch.stack([part.flatten(1).any(1) for part in apart]).any(0)


def _mixed(motion: Trajectory, other: Trajectory, rows: Tensor) -> Trajectory:
    """The rollouts `rows` (bool [B]) of `other`, the rest of `motion`."""
    parts: dict[str, Any] = {}
    for name in _PLACED:
        mine, theirs = getattr(motion, name), getattr(other, name)
        parts[name] = torch.where(rows.view(1, -1, *[1] * (mine.ndim - 2)), theirs, mine)
    channels = {
        name: torch.where(rows[None, :, None], other.channels[name], part) for name, part in motion.channels.items()
    }
    return replace(motion, **parts, channels=channels)
