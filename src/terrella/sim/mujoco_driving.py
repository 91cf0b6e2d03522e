"""The task of driving along the lanes of a town among cars and walkers, which it moves."""

from __future__ import annotations

import torch
from torch import Tensor

from ..core import chance
from ..core.spec import EVENT
from .mujoco_tasks import Evaluation, RobotLayout, Spaces, Tensors, motion, numbers, rotate
from .mujoco_town import CARS, PAVEMENT_M, WALKERS
from .road_network import LANE_M, POINTS, REACH_M, RoadNetwork

ROUTE, STEP_M = 10, 0.2  # points of the route ahead, and their distances
FREE_M = ROUTE * STEP_M  # gap where nothing is in the way
PACE = (0.7, 1.2)  # m/s, of cars
BRAKES_M, STOPS_M = 0.8, 0.3  # gaps at which cars begin to slow down, and at which they stand
WIDE_M = {"car": 0.26, "walker": 0.2}  # from the route, within which something is in the way
LATER_S = (0.3, 0.6)  # at which crossing traffic is expected where it then will be
CIRCLES_M, CAR_M, WALKER_M = (
    (-0.13, 0.0, 0.13),
    0.1,
    0.04,
)  # a car's outline: centres of circles, their radius; a walker's
CYCLE_S, CROSSING = 28.0, 0.15  # of a walker: to both sides and back, and the share of it for each crossing
MARGIN_M = 0.05  # by which the middle of the car may leave the road
_PLACES, _TURNS, _PACES, _STRIDES = 11, 12, 13, 14  # streams of random numbers
_TURNED = 0.1  # m², of a heading to the contrary, when a lane is chosen by its distance
_PLANNED = 0.05  # m², by which pieces of the route are preferred


class Lanes:
    """Tables of a RoadNetwork as tensors, and where things on its pieces are."""

    def __init__(self, roads: RoadNetwork):
        self.points, self.headings = torch.from_numpy(roads.points), torch.from_numpy(roads.headings)
        self.lengths, self.choices = torch.from_numpy(roads.lengths), torch.from_numpy(roads.choices)
        self.next_pieces = torch.from_numpy(roads.next_pieces).long()
        self.count = roads.lanes

    def after(self, piece: Tensor, seed: Tensor) -> Tensor:
        """The piece that follows `piece` on the route of an actor of this seed; all int64 of one shape."""
        drawn = chance.uniform((seed + piece * chance.GOLDEN).flatten(), (), _TURNS).view(piece.shape)
        choice = (drawn.double() * self.choices[piece]).long()
        return self.next_pieces[piece, choice]

    def advance(self, piece: Tensor, along: Tensor, seed: Tensor) -> tuple[Tensor, Tensor]:
        """The piece and the distance along it in m, where `along` leads over the end of `piece` by up to three pieces."""
        for _ in range(3):
            over = along > self.lengths[piece]
            along = torch.where(over, along - self.lengths[piece], along)
            piece = torch.where(over, self.after(piece, seed), piece)
        return piece, along

    def place(self, piece: Tensor, along: Tensor) -> tuple[Tensor, Tensor]:
        """Position [..., 2] in m and unit heading [..., 2]."""
        at = (along / self.lengths[piece]).clamp(0, 1) * (POINTS - 1)
        low = at.long().clamp_max(POINTS - 2)
        share = (at - low)[..., None]
        both = ((table[piece, low], table[piece, low + 1]) for table in (self.points, self.headings))
        position, heading = (torch.lerp(one, other, share) for one, other in both)
        return position, heading / heading.norm(dim=-1, keepdim=True)

    def nearest(self, position: Tensor, heading: Tensor, planned: Tensor) -> Tensor:
        """The nearest piece [B] to positions and headings [B, 2], preferring those `planned` [B, n]."""
        x, y = ((position[:, at, None, None] - self.points[..., at]).square() for at in (0, 1))
        east, north = (heading[:, at, None, None] * self.headings[..., at] for at in (0, 1))
        cost = (x + y + _TURNED * (1 - east - north)).amin(2)
        cost.scatter_add_(1, planned, torch.full_like(cost[:, : planned.shape[1]], -_PLANNED))
        return cost.argmin(1)

    def project(self, position: Tensor, piece: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Of positions [B, 2] the distance along pieces [B] and how far to the left of them they are, both in m, and the direction
        [B, 2] of the piece there."""
        offset = position[:, None] - self.points[piece]
        point = offset.square().sum(2).argmin(1, keepdim=True)
        tangent, offset = (
            part.gather(1, point[..., None].expand(-1, -1, 2))[:, 0] for part in (self.headings[piece], offset)
        )
        along = point[:, 0] * self.lengths[piece] / (POINTS - 1) + (offset * tangent).sum(1)
        return along.clamp_min(0), tangent[:, 0] * offset[:, 1] - tangent[:, 1] * offset[:, 0], tangent


class Driving:
    """Reward: metres along the lane. The episode ends in a collision, or when the middle of the car has left the road. Observation:
    speed, yaw rate, steering, offset from the lane (left is positive), gap, and the route.

    Cars keep to their lanes, and brake for what is in their way. Walkers walk along the pavement, and cross the street. The route
    turns at random at junctions; it is advice, a car that turns otherwise gets another."""

    rewards = True

    def __init__(self, roads: RoadNetwork):
        self.lanes = Lanes(roads)
        self.surface = torch.from_numpy(roads.surface)
        ends = torch.from_numpy(roads.nodes)[torch.from_numpy(roads.streets)]
        streets = torch.arange(WALKERS) * len(ends) // WALKERS
        long = (ends[:, 1] - ends[:, 0]).norm(dim=1, keepdim=True)
        self._direction = ((ends[:, 1] - ends[:, 0]) / long)[streets]
        self._corner = ends[streets, 0] + (REACH_M + 0.1) * self._direction
        self._walk = (long[:, 0] - 2 * REACH_M - 0.2)[streets].clamp_max(1.2)  # m along the pavement

    def __repr__(self) -> str:  # of a world's fingerprint
        return "Driving()"

    def channels(self, layout: RobotLayout) -> Spaces:
        return {
            "observation": (numbers(5 + 2 * ROUTE), ""), "route": (numbers(ROUTE, 2), "m ahead, m to the left"),
            "gap": (numbers(), "m"), "lane": (numbers(), "m"), "speed": (numbers(), "m/s"), "progress": (numbers(), "m"),
            "offroad": (EVENT, ""), "collision": (EVENT, ""),
        }  # fmt: skip

    def initialise(self, layout: RobotLayout, seeds: Tensor, qpos: Tensor, qvel: Tensor) -> dict[str, Tensor]:
        batch = len(seeds)
        lane = chance.uniform(seeds, (self.lanes.count,), _PLACES).argsort(1)[:, : CARS + 1]
        share = chance.uniform(seeds, (CARS + 1,), _STRIDES).double()
        along = (0.1 + 0.6 * share) * self.lanes.lengths[lane]
        position, heading = self.lanes.place(lane[:, -1], along[:, -1])
        half = torch.atan2(heading[:, 1], heading[:, 0]) / 2
        qpos[:, :2] = position
        qpos[:, 3:7] = torch.stack([half.cos(), 0 * half, 0 * half, half.sin()], 1)
        kept = {
            "seed": seeds, "piece": lane, "along": along[:, :-1], "pace": torch.zeros(batch, CARS, dtype=torch.float64),
            "stride": chance.uniform(seeds, (WALKERS,), _PACES).double(), "striding": torch.zeros(batch, WALKERS, dtype=torch.bool),
            "progress": torch.zeros(batch), "offroad": torch.zeros(batch, dtype=torch.bool),
            "collision": torch.zeros(batch, dtype=torch.bool),
        }  # fmt: skip
        around = self._traffic(kept, position, heading, 0 * position)
        self._put(layout, kept | around, qpos, qvel)
        return kept | around

    def evaluate(self, layout: RobotLayout, before: Tensors, after: Tensors) -> Evaluation:
        physics = after["physics"].clone()
        qpos, qvel = physics[:, layout.qpos], physics[:, layout.qvel]
        position, heading = self._pose(qpos)
        seeds = self._seeds(before["seed"])
        piece, along = self.lanes.advance(
            before["piece"][:, :-1], before["along"] + before["pace"] * layout.step_s, seeds[:, :-1]
        )
        own = before["piece"][:, -1]
        second = self.lanes.after(own, seeds[:, -1])
        planned = torch.stack([own, second, self.lanes.after(second, seeds[:, -1])], 1)
        own = self.lanes.nearest(position, heading, planned)
        tangent = self.lanes.project(position, own)[2]
        gained = ((position - self._pose(before["physics"][:, layout.qpos])[0]) * tangent).sum(1)
        kept = {
            "seed": before["seed"], "piece": torch.cat([piece, own[:, None]], 1), "along": along,
            "stride": (before["stride"] + before["striding"] * layout.step_s / CYCLE_S).remainder(1),
            "progress": before["progress"] + gained.float(), "offroad": ~self._on_road(position),
        }  # fmt: skip
        kept |= self._traffic(kept, position, heading, qvel[:, :2])
        self._put(layout, kept, qpos, qvel)
        kept["collision"] = self._collides(kept, position, heading)
        tipped = motion(layout, physics)[2][:, 2] < 0.5
        kept["physics"] = physics
        return gained.float(), kept["collision"] | kept["offroad"] | tipped, kept

    def render(self, layout: RobotLayout, state: Tensors, name: str) -> Tensor:
        if name in ("gap", "progress", "offroad", "collision"):
            return state[name]
        physics = state["physics"]
        position, heading = self._pose(physics[:, layout.qpos])
        velocity, spin, _ = motion(layout, physics)
        if name == "speed":
            return velocity[:, 0].float()
        own = state["piece"][:, -1:]
        along, lane, _ = self.lanes.project(position, own[:, 0])
        if name == "lane":
            return lane.float()
        left = torch.stack([-heading[:, 1], heading[:, 0]], 1)
        ahead = self._ahead(own, along[:, None], self._seeds(state["seed"])[:, -1:])[:, 0] - position[:, None]
        route = torch.stack([(ahead * heading[:, None]).sum(-1), (ahead * left[:, None]).sum(-1)], -1).float()
        if name == "route":
            return route
        steering = physics[:, layout.qpos][:, 7]
        facts = [velocity[:, 0], spin[:, 2], steering, lane, state["gap"]]
        return torch.cat([torch.stack([fact.float() for fact in facts], 1), route.flatten(1)], 1)

    # -- traffic ------------------------------------------------------------------------------------------------------

    def _traffic(self, now: Tensors, position: Tensor, heading: Tensor, velocity: Tensor) -> dict[str, Tensor]:
        """pace [B, cars] m/s and striding bool [B, walkers] of the next step, and the gap [B] in m before the car."""
        lanes, seeds = self.lanes, self._seeds(now["seed"])
        piece, along = now["piece"][:, :-1], now["along"]
        cars, headings = lanes.place(piece, along)
        desired = PACE[0] + (PACE[1] - PACE[0]) * chance.uniform(now["seed"], (CARS,), _PACES).double()
        own_along = lanes.project(position, now["piece"][:, -1])[0]
        paths = self._ahead(
            torch.cat([piece, now["piece"][:, -1:]], 1), torch.cat([along, own_along[:, None]], 1), seeds
        )
        headings = torch.cat([headings, heading[:, None]], 1)
        every = torch.cat([cars, position[:, None]], 1)
        speeds = torch.cat([desired[..., None] * headings[:, :-1], velocity[:, None]], 1)
        among = _gaps(paths, every, WIDE_M["car"])
        crossing = (headings[:, :, None] * headings[:, None]).sum(-1).abs() < 0.8
        for later in LATER_S:
            soon = _gaps(paths, every + later * speeds, WIDE_M["car"])
            soon[:, -1] = soon[:, -1] if later == LATER_S[0] else FREE_M  # the car itself looks less far ahead
            among = torch.minimum(among, soon.masked_fill(~crossing, FREE_M))
        mutual = (among < FREE_M) & (among.mT < FREE_M) & crossing
        among = among.masked_fill(
            mutual.tril() | torch.eye(CARS + 1, dtype=torch.bool), FREE_M
        )  # the later one goes first
        walkers = self._walkers(now["stride"])
        gaps = torch.minimum(among.amin(2), _gaps(paths, walkers, WIDE_M["walker"]).amin(2))
        pace = desired * ((gaps[:, :-1] - STOPS_M) / (BRAKES_M - STOPS_M)).clamp(0, 1)
        away = (walkers[:, :, None] - every[:, None]).norm(dim=-1).amin(2)
        phase = now["stride"].remainder(0.5)
        waits = (phase > 0.47 - CROSSING) & (phase < 0.5 - CROSSING)  # before it steps onto the road
        striding = torch.where(waits, away > 1.0, (away > 0.32) | (phase < 0.5 - CROSSING))
        return {"pace": pace, "striding": striding, "gap": gaps[:, -1].float()}

    def _ahead(self, piece: Tensor, along: Tensor, seeds: Tensor) -> Tensor:
        """[B, n, ROUTE, 2] m: the points of the routes ahead of `along` on pieces [B, n]."""
        step = STEP_M * torch.arange(1, ROUTE + 1, dtype=torch.float64)
        wide = (*piece.shape, ROUTE)
        piece, along = self.lanes.advance(
            piece[..., None].expand(wide), along[..., None] + step, seeds[..., None].expand(wide)
        )
        return self.lanes.place(piece, along)[0]

    def _walkers(self, stride: Tensor) -> Tensor:
        """[B, walkers, 2] m: along the pavement and back, over the street, and the same on the other side."""
        phase, other = stride.remainder(0.5), (stride >= 0.5).double()
        walk = (phase / (0.5 - CROSSING)).clamp_max(1)
        cross = ((phase - 0.5 + CROSSING) / CROSSING).clamp_min(0)
        long = self._walk * (1 - (2 * walk - 1).abs())
        aside = (LANE_M + PAVEMENT_M / 2) * (1 - 2 * (other + (1 - 2 * other) * cross))
        left = torch.stack([-self._direction[:, 1], self._direction[:, 0]], 1)
        return self._corner + long[..., None] * self._direction + aside[..., None] * left

    def _put(self, layout: RobotLayout, now: Tensors, qpos: Tensor, qvel: Tensor) -> None:
        """Sets the places of traffic, and the speeds with which it gets to those of the next step."""
        step, seeds = layout.step_s, self._seeds(now["seed"])[:, :-1]
        piece = now["piece"][:, :-1]
        rows = []
        for at in ((piece, now["along"]), self.lanes.advance(piece, now["along"] + step * now["pace"], seeds)):
            place, heading = self.lanes.place(*at)
            rows.append(torch.cat([place, torch.atan2(heading[..., 1:], heading[..., :1])], -1))
        speed = rows[1] - rows[0]
        speed[..., 2] = (speed[..., 2] + torch.pi).remainder(2 * torch.pi) - torch.pi
        walkers = self._walkers(now["stride"])
        walking = self._walkers((now["stride"] + now["striding"] * step / CYCLE_S).remainder(1)) - walkers
        count = 3 * CARS + 2 * WALKERS
        qpos[:, -count:] = torch.cat([rows[0].flatten(1), walkers.flatten(1)], 1)
        qvel[:, -count:] = torch.cat([speed.flatten(1), walking.flatten(1)], 1) / step

    def _collides(self, now: Tensors, position: Tensor, heading: Tensor) -> Tensor:
        """bool [B]: whether the car's outline touches a car's or a walker's."""
        ahead = torch.tensor(CIRCLES_M, dtype=torch.float64)[:, None]
        own = position[:, None] + ahead * heading[:, None]
        cars, headings = self.lanes.place(now["piece"][:, :-1], now["along"])
        others = (cars[:, :, None] + ahead * headings[:, :, None]).flatten(1, 2)
        walkers = self._walkers(now["stride"])
        hit = torch.cdist(own, others).flatten(1).amin(1) < 2 * CAR_M
        return hit | (torch.cdist(own, walkers).flatten(1).amin(1) < CAR_M + WALKER_M)

    def _on_road(self, position: Tensor) -> Tensor:
        x, y = position[:, :1], position[:, 1:]
        x0, y0, x1, y1 = self.surface.T
        inside = (x > x0 - MARGIN_M) & (x < x1 + MARGIN_M) & (y > y0 - MARGIN_M) & (y < y1 + MARGIN_M)
        return inside.any(1)

    def _seeds(self, seed: Tensor) -> Tensor:
        """int64 [B, cars + 1]: one of each actor, the car itself last."""
        return seed[:, None] + torch.arange(CARS + 1) * chance.SECOND

    def _pose(self, qpos: Tensor) -> tuple[Tensor, Tensor]:
        """Position and unit heading [B, 2] on the ground."""
        ahead = torch.zeros(len(qpos), 3, dtype=qpos.dtype)
        ahead[:, 0] = 1
        heading = rotate(qpos[:, 3:7], ahead)[:, :2]
        return qpos[:, :2], heading / heading.norm(dim=1, keepdim=True).clamp_min(1e-6)


def _gaps(paths: Tensor, things: Tensor, wide_m: float) -> Tensor:
    """[B, n, m] m: how far along paths [B, n, ROUTE, 2] things [B, m, 2] are in the way; FREE_M where they are not."""
    near = torch.cdist(paths.flatten(1, 2), things).unflatten(1, paths.shape[1:3]) < wide_m
    step = STEP_M * torch.arange(1, ROUTE + 1, dtype=torch.float64)[:, None]
    return torch.where(near, step - STEP_M, FREE_M).amin(2)
