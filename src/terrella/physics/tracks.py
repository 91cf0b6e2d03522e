"""Tracked: the bodies of rollouts of pictures, followed by a Tracker and measured in metres, as the channels that the laws read."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import permutations

import torch
from torch import Tensor

from ..core.errors import TerrellaError
from .masks import tracker_of_masks
from .system import EARTH, PhysicalSystem, RigidBody, Slot
from .tracker import Tracker, Tracks, fit_tracker
from .trajectory import Trajectory, trajectory_of

PLACE, SPEED, RADIUS, HERE = "tracks.position", "tracks.velocity", "tracks.radius", "tracks.present"
OTHER = "another thing"  # that was not there at first
MOST = 6  # bodies that are matched with tracks by trying all orders
AGREES = 1.0  # pixels, RMS, between pictures and recorded positions at most
ROUGH, JUMP, APART = 4.0, 10.0, 4.0  # times the median change of velocity in a step: contacts; sides that are averaged
WINDOWS = (1, 2, 3, 4, 6, 9)  # steps from which a velocity is measured
LAG, STEADY = (
    4,
    0.5,
)  # steps of an acceleration; of gravity, the spread of accelerations of things that fall freely, at most


@dataclass(frozen=True)
class Scale:
    """Where pixels lie in the plane of motion: place = offset + turn (right, down)."""

    offset: Tensor  # [2], m
    turn: Tensor  # [2, 2], m a pixel
    source: str  # where it comes from, in words

    @property
    def metres_per_pixel(self) -> float:
        return float(torch.linalg.det(self.turn).abs().sqrt())

    def metres(self, pixels: Tensor) -> Tensor:
        """Places [..., 2] in metres of places in pixels."""
        return self.offset + pixels @ self.turn.T

    def pixels(self, metres: Tensor) -> Tensor:
        """The inverse of `metres`."""
        return (metres - self.offset) @ torch.linalg.inv(self.turn).T


@dataclass(frozen=True)
class Tracked:
    """`tracked.trajectory(pictures, dt_s)`: what the laws over states read, measured in pictures."""

    tracker: Tracker
    system: PhysicalSystem  # its channels are those of `observations`
    scale: Scale

    def observations(self, tracks: Tracks, dt_s: float, first: Tensor | None = None) -> dict[str, Tensor]:
        """The channels of the system [T + 1, B, ...], m and m/s. first [B, N, 2]: where the bodies are at first, in their order;
        by default things are in the order of the tracker."""
        count = len(self.system.bodies) - 1
        steps, batch, seen = tracks.area.shape
        place = self.scale.metres(tracks.place)
        order = torch.arange(count).clamp_max(seen - 1).expand(batch, count)
        if first is not None:
            order = _nearest(first.double(), place[0], tracks.present[0])
        pick = order.expand(steps, batch, count)
        here = tracks.present.gather(2, pick) & (torch.arange(count) < seen)
        place = place.gather(2, pick[..., None].expand(-1, -1, -1, 2))
        radius = (tracks.area.gather(2, pick) / torch.pi).sqrt() * self.scale.metres_per_pixel
        radius = torch.where(here, radius, torch.nan).nanmedian(0).values.nan_to_num().expand(steps, batch, count)
        pull = torch.tensor(self.system.gravity_m_s2, dtype=torch.float64)[list(self.system.axes)]
        free = torch.tensor([not body.driven for body in self.system.bodies[:count]])
        speed = velocities(place, pull * free[:, None], dt_s)
        none = place.new_zeros(steps, batch, 1)
        return {
            PLACE: torch.cat([place.flatten(2), none, none], 2),
            SPEED: torch.cat([speed.flatten(2), none, none], 2),
            RADIUS: torch.cat([radius, none], 2),
            HERE: torch.cat([here.double(), (tracks.others > 0).double()[..., None]], 2),
        }

    def trajectory(self, pictures: Tensor, dt_s: float, first: Tensor | None = None) -> tuple[Trajectory, Tensor]:
        """(the motion in uint8 pictures [T + 1, B, H, W, 3]; bool [B]: the rollouts in which no thing reaches the edge)."""
        tracks = self.tracker.follow(pictures)
        motion = trajectory_of(self.system, self.observations(tracks, dt_s, first), dt_s)
        return motion, ~tracks.cut.any(2).any(0)


def fit_tracked(
    pictures: Tensor,
    dt_s: float,
    system: PhysicalSystem | None = None,
    positions: Tensor | None = None,
    metres_per_pixel: float | None = None,
    masks: Tensor | None = None,
) -> Tracked:
    """What tracks a recording's things, from uint8 pictures [T + 1, B, H, W, 3] of it.

    masks int [T + 1, B, h, w], the number of what is seen at each pixel, say what moves, where they are recorded.
    The scale is `metres_per_pixel`, else of `positions` [T + 1, B, N, 2] of the system's bodies in their plane, else of gravity,
    where things fall freely. The bodies are the system's where it is from positions, else things of which nothing is known.
    TerrellaError where none of them gives a scale, or where nothing can be tracked."""
    if metres_per_pixel is not None and not metres_per_pixel > 0:
        raise TerrellaError(f"--metres-per-pixel is above 0; got {metres_per_pixel:g}.")
    if system is not None and len(system.axes) != 2:
        raise TerrellaError(
            "the bodies move in three dimensions, and pictures are judged where they move in a plane; record their positions."
        )
    flat = pictures.flatten(0, 1)
    tracker = fit_tracker(flat) if masks is None else tracker_of_masks(flat, masks.flatten(0, 1))
    tracks = tracker.follow(pictures)
    height = pictures.shape[2]
    if metres_per_pixel is not None:
        system, scale = _things(tracks.area.shape[2], False), _upright(metres_per_pixel, height, "as given")
    elif system is not None and positions is not None:
        scale = fit_scale(tracks, positions.double())
    else:
        system, scale = _things(tracks.area.shape[2], True), _scale_of_fall(tracks, dt_s, height)
    return Tracked(tracker, tracked_system(system), scale)


def tracked_system(system: PhysicalSystem) -> PhysicalSystem:
    """The system with the channels of tracks: bodies are balls of the area that they cover, their turning is not seen, and what
    was not there at first is another thing."""
    bodies = [
        replace(
            body, position=Slot(PLACE, 2 * at), velocity=Slot(SPEED, 2 * at), radius_m=Slot(RADIUS, at), present=Slot(HERE, at),
            rotation=None, spin=None, half_m=(0.0, 0.0, 0.0), inertia_kg_m2=None,
        )
        for at, body in enumerate(system.bodies)
    ]  # fmt: skip
    last = len(bodies)
    other = RigidBody(
        OTHER,
        Slot(PLACE, 2 * last),
        Slot(SPEED, 2 * last),
        present=Slot(HERE, last),
        radius_m=Slot(RADIUS, last),
        driven=True,
    )
    return replace(system, bodies=(*bodies, other), limits=(), tracked=True)


def fit_scale(tracks: Tracks, positions: Tensor) -> Scale:
    """The scale that fits tracks to positions [T + 1, B, N, 2], m. TerrellaError where they do not agree."""
    steps, batch, count = positions.shape[:3]
    seen = tracks.area.shape[2]
    good = (tracks.present & ~tracks.cut).all(2) & (tracks.others == 0)
    if seen != count or count > MOST or int(good.sum()) < 8:
        raise TerrellaError(
            f"the pictures show {seen} things that move and the recording has {count} bodies, so no scale can be fitted; give "
            "--metres-per-pixel."
        )
    orders = torch.tensor(list(permutations(range(count))))
    fits = [_plane(tracks.place, positions[:, :, order], good) for order in orders]
    turn, offset = fits[
        int(
            torch.stack(
                [_misfit(tracks.place, positions[:, :, order], good, fit) for order, fit in zip(orders, fits)]
            ).argmin()
        )
    ]
    for _ in range(3):  # things of one colour are in another order in each rollout
        misfits = torch.stack(
            [
                ((tracks.place @ turn.T + offset - positions[:, :, order]).norm(dim=-1).mean(2) * good).sum(0)
                for order in orders
            ]
        )
        order = orders[misfits.argmin(0)].expand(steps, batch, count)
        sorted_ = positions.gather(2, order[..., None].expand_as(positions))
        turn, offset = _plane(tracks.place, sorted_, good)
    scale = Scale(offset, turn, "fitted to recorded positions")
    size = scale.metres_per_pixel
    off = float(_misfit(tracks.place, sorted_, good, (turn, offset)) / size) if size > 1e-12 else float("inf")
    if not off < AGREES:
        raise TerrellaError(
            f"pictures and recorded positions disagree by {off:.1f} pixels, so no scale can be fitted; does the camera move? Else "
            "give --metres-per-pixel."
        )
    return scale


def velocities(place: Tensor, pull: Tensor, dt_s: float) -> Tensor:
    """Velocities [T + 1, ..., N, 2], m/s, at each instant of places in metres.

    They are measured from the steps before it, or from those after it, as many as change smoothly (as in essentially
    non-oscillatory schemes, Harten et al. 1987), so that contacts are not smeared; the mean of both where they agree. pull
    [..., 2]: the acceleration in flight, m/s2."""
    if len(place) < 2:
        return torch.zeros_like(place)
    if len(place) < 4:
        way = place.diff(dim=0) / dt_s
        return torch.cat([way[:1] - 0.5 * pull * dt_s, way + 0.5 * pull * dt_s])
    change = (place.diff(n=2, dim=0) / dt_s - pull * dt_s).norm(dim=-1, keepdim=True)
    noise = change.median(0).values.clamp_min(1e-6)
    beside = torch.zeros_like(change)  # a contact within a step shows at both its ends, or much at one
    beside[1:] = change[:-1]
    beside[:-1] = torch.maximum(beside[:-1], change[1:])
    rough = (change > JUMP * noise) | (torch.minimum(change, beside) > ROUGH * noise)
    smooth = ~rough.any(-2, keepdim=True).expand_as(change)  # a contact is one of several things
    before, spread = _sided(place, pull, dt_s, smooth)
    after, other = (part.flip(0) for part in _sided(place.flip(0), pull, -dt_s, smooth.flip(0)))
    agree = (before - after).norm(dim=-1, keepdim=True) < APART * noise * (spread.square() + other.square()).sqrt()
    weight = spread.square().reciprocal(), other.square().reciprocal()
    mean = (weight[0] * before + weight[1] * after) / (weight[0] + weight[1]).clamp_min(1e-12)
    speed = torch.where(agree & spread.isfinite() & other.isfinite(), mean, torch.where(spread <= other, before, after))
    nowhere = torch.minimum(spread, other)[2:-2] > 0.5  # no two steps agree at either side
    return torch.cat([speed[:2], torch.where(nowhere, (place[4:] - place[:-4]) / (4 * dt_s), speed[2:-2]), speed[-2:]])


def _sided(place: Tensor, pull: Tensor, dt_s: float, smooth: Tensor) -> tuple[Tensor, Tensor]:
    """(velocity at each instant by the steps before it; how much noise that has [..., 1], in changes of velocity from step to step,
    infinite where there is no step). smooth: bool [T - 1, ..., 1], of the changes."""
    speed, spread = torch.zeros_like(place), torch.full_like(place[..., :1], torch.inf)
    for count in WINDOWS:  # the longest one is kept
        if len(place) <= count:
            continue
        time_s = torch.arange(-count, 1, dtype=place.dtype) * dt_s
        window = place.unfold(0, count + 1, 1) - 0.5 * pull[..., None] * time_s**2  # [T + 1 - count, ..., 2, count + 1]
        centred = time_s - time_s.mean()
        slope = (window * centred).sum(-1) / centred.square().sum()
        fits = (
            smooth.unfold(0, count - 1, 1).all(-1) if count > 1 else torch.ones_like(slope[..., :1], dtype=torch.bool)
        )
        own = (
            2 / ((count + 1) * ((count + 1) ** 2 - 1))
        ) ** 0.5  # of a slope by least squares, over that of a second difference
        speed[count:] = torch.where(fits, slope, speed[count:])
        spread[count:] = torch.where(fits, own, spread[count:])
    return speed, spread


def _nearest(first: Tensor, place: Tensor, here: Tensor) -> Tensor:
    """The track of each body, int64 [B, N]: in order of distance, each track once while there are enough."""
    apart = torch.cdist(first, torch.where(here[..., None], place, 1e6))
    batch, count, seen = apart.shape
    order, rows = torch.zeros(batch, count, dtype=torch.long), torch.arange(batch)
    for _ in range(min(count, seen)):
        flat = apart.flatten(1).argmin(1)
        body, track = flat // seen, flat % seen
        order[rows, body] = track
        apart[rows, body] = torch.inf
        apart[rows, :, track] = apart[rows, :, track] + 1e9
    return order


def _plane(place: Tensor, positions: Tensor, good: Tensor) -> tuple[Tensor, Tensor]:
    """(turn, offset) of least squares."""
    pixels, metres = place[good].flatten(0, 1), positions[good].flatten(0, 1)
    solved = torch.linalg.lstsq(torch.cat([pixels, torch.ones_like(pixels[:, :1])], 1), metres).solution
    return solved[:2].T.contiguous(), solved[2]


def _misfit(place: Tensor, positions: Tensor, good: Tensor, fit: tuple[Tensor, Tensor]) -> Tensor:
    return (place @ fit[0].T + fit[1] - positions)[good].square().sum(-1).mean().sqrt()


def _upright(size: float, height: int, source: str) -> Scale:
    """Square pixels of `size` metres; the picture's lower left corner is the origin."""
    return Scale(
        torch.tensor([0.0, size * height]).double(), torch.tensor([[size, 0.0], [0.0, -size]]).double(), source
    )


def _scale_of_fall(tracks: Tracks, dt_s: float, height: int) -> Scale:
    """The scale at which the median thing accelerates by g, where most fall freely."""
    lag = max(1, min(LAG, (len(tracks.place) - 1) // 2))
    steady = (tracks.present & ~tracks.cut).unfold(0, 2 * lag + 1, 1).all(-1)
    change = (tracks.place[2 * lag :] - 2 * tracks.place[lag:-lag] + tracks.place[: -2 * lag])[steady] / lag**2
    down = float(change[:, 1].median()) if len(change) else 0.0
    spread = float((change - change.new_tensor([0.0, down])).norm(dim=-1).median()) if len(change) else torch.inf
    if down <= 0 or spread > STEADY * down:
        raise TerrellaError(
            "nothing says how large a pixel is: there are no recorded positions, and the things in the pictures do not fall "
            "freely; give --metres-per-pixel."
        )
    size = -EARTH[2] * dt_s**2 / down
    return _upright(size, height, "so that things fall with 9.81 m/s2")


def _things(count: int, falls: bool) -> PhysicalSystem:
    """Things of which nothing is known: a program may drive them, but where they fall."""
    bodies = tuple(RigidBody(f"thing {at + 1}", Slot(PLACE, 2 * at), driven=not falls) for at in range(count))
    return PhysicalSystem(bodies, gravity_m_s2=EARTH if falls else (0.0, 0.0, 0.0), axes=(0, 2))
