"""Routes to a place that is further off than a planner sees: over places where a camera was before, or where one can stand, planned
stretch by stretch."""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from ...core.errors import PlanningError
from ...core.spec import WALKABLE
from ...core.world import Observation, World
from ...space.camera import yaw
from .costs import Cost, distance_to
from .planner import Planner, PlannerMemory


class NoRoute(PlanningError):
    """No way to a place is known."""


NEAR_M, FACING = 0.5, 0.35  # metres, and radians of heading, within which a place is reached
STRIDE_S = 0.115  # for which a walker holds a move
STRIDE_M = 1.6  # between two places that a camera knows and that lie on one way; walls seldom stand between such
STEP_M, AHEAD_M = 0.45, 0.9  # places where one can stand: from one to the next, nothing between; walked to at once
CELL_M = 0.4  # places nearer to each other are one
_STUCK_STEPS, _STUCK_M = 45, 0.35  # who has not come further than this in so many steps tries another way
_DETOUR_M = 4.0  # by which a place that could not be walked to counts as further
_TURNS_M = 0.6  # from the place, within which who has arrived turns to the heading
_ANEW_STEPS = 70  # after which ways are looked for among the places that are known by now


@dataclass(frozen=True)
class Routes:
    """Known places [N, 2] in metres, how far each is from the goal along them [N] (inf: no way is known), and the next one on the
    way there, -1 for the goal itself. stride_m: between two of them at most; ahead_m: of a way, what is walked to at once."""

    places: np.ndarray
    left_m: np.ndarray
    onward: np.ndarray = field(repr=False)
    stride_m: float = STRIDE_M
    ahead_m: float = math.inf

    def target(self, here: np.ndarray, goal: np.ndarray) -> tuple[np.ndarray, float]:
        """The place [2] to walk to next from `here`: as far along the best way as a stride reaches; and what is left to go."""
        straight = float(np.linalg.norm(goal - here))
        if straight <= self.stride_m or not len(self.places):
            return goal, straight
        away = np.linalg.norm(self.places - here, axis=1)
        leads = np.isfinite(self.left_m)
        if not leads.any():
            return goal, math.inf
        near = leads & (away <= self.stride_m)
        if not near.any():
            near = leads & (away <= away[leads].min() + 1e-6)  # off all ways: to the nearest place on one
        total = np.where(near, away + self.left_m, np.inf)
        at = int(total.argmin())
        left = float(total[at])
        while (on := self.onward[at]) >= 0 and away[on] <= STRIDE_M and left - self.left_m[on] <= self.ahead_m:
            at = int(on)
        return (goal if self.onward[at] < 0 and away[at] < 2 * CELL_M else self.places[at]), left


@dataclass(frozen=True)
class NavigatorMemory:
    """The memory of one episode: the planner's, the ways, the place walked to next, and where the walker was some steps ago."""

    thought: PlannerMemory
    routes: Routes | None = None
    next: tuple[float, float] | None = None
    step: int = 0
    before: tuple[float, float] = (math.inf, math.inf)
    noted: int = 0
    avoided: tuple[tuple[float, float], ...] = ()


def routes_to(goal: np.ndarray, known: np.ndarray, avoided: tuple[tuple[float, float], ...] = ()) -> Routes:
    """Dijkstra (1959) from the goal [2] over known places [N, 4] (x, y, heading, kind); places near `avoided` ones count as further
    off."""
    walkable = bool(len(known)) and bool((known[:, 3] == WALKABLE).all())
    stride, ahead = (STEP_M, AHEAD_M) if walkable else (STRIDE_M, math.inf)
    known = known[:, :2]
    if not walkable:
        _, first = np.unique(np.round(known / CELL_M).astype(np.int64), axis=0, return_index=True)
        known = known[np.sort(first)]
    places = known.astype(np.float64)
    toll = np.zeros(len(places))
    for spot in avoided:
        toll += _DETOUR_M * (np.linalg.norm(places - np.asarray(spot), axis=1) < 0.8)
    start = np.linalg.norm(places - goal, axis=1)
    left, onward = np.full(len(places), np.inf), np.full(len(places), -1)
    queue = [(float(start[at]), at, -1) for at in np.flatnonzero(start <= stride).tolist()]
    heapq.heapify(queue)
    while queue:
        far, at, after = heapq.heappop(queue)
        if far >= left[at]:
            continue
        left[at], onward[at] = far, after
        apart = np.linalg.norm(places - places[at], axis=1)
        for other in np.flatnonzero(apart <= stride).tolist():
            further = far + apart[other] + toll[other]
            if further < left[other]:
                heapq.heappush(queue, (float(further), other, at))
    return Routes(places, left, onward, stride, ahead)


class Navigator:
    """Walks to `place`, x and y in metres, in a world with the channel `pose`; there it turns to `heading` radians, if one is
    given.

    planner: plans for a goal in `pose`, that of the next place on the way in place of its own. Routes lead over those of the
    channel `places`, seen or remembered by the planner's world; without any, straight on. PlanningError where none is known.
    """

    def __init__(self, planner: Planner, place: tuple[float, float], heading: float | None = None):
        if "pose" not in planner.cost.channels:
            raise PlanningError("who walks to a place plans for a goal in 'pose'.")
        self.planner, self.place, self.heading = planner, np.asarray(place, np.float64), heading

    def begin(self, batch: int, rng: torch.Generator) -> list[NavigatorMemory]:
        return [NavigatorMemory(thought) for thought in self.planner.begin(batch, rng)]

    def act(
        self, observation: Observation, memory: list[NavigatorMemory], rng: torch.Generator
    ) -> tuple[torch.Tensor, list[NavigatorMemory]]:
        walks = [self._led(walk, observation, entry) for entry, walk in enumerate(memory)]
        actions, thoughts = self.planner.act(observation, [walk.thought for walk in walks], rng)
        return actions, [replace(walk, thought=thought) for walk, thought in zip(walks, thoughts)]

    def _led(self, walk: NavigatorMemory, observation: Observation, entry: int) -> NavigatorMemory:
        """The walk with the next place as its planner's goal."""
        here = observation["pose"][entry, :2].double().cpu().numpy()
        walk = self._noted(walk, here)
        if walk.routes is None or walk.step % _ANEW_STEPS == 0 or not len(walk.routes.places):
            known = self._known(observation, walk, entry)
            walk = replace(walk, routes=routes_to(self.place, known, walk.avoided))
        assert walk.routes is not None
        target, left = walk.routes.target(here, self.place)
        if not math.isfinite(left):
            raise NoRoute("no way to that place is known; choose one near where somebody has been.")
        pose = torch.full_like(walk.thought.goal["pose"], torch.nan)
        pose[0, :2] = torch.from_numpy(target).to(pose)
        if self.heading is not None and left < _TURNS_M:
            pose[0, 3], pose[0, 6] = math.cos(self.heading / 2), math.sin(self.heading / 2)
        thought = replace(walk.thought, goal={**walk.thought.goal, "pose": pose})
        return replace(walk, thought=thought, next=(float(target[0]), float(target[1])), step=walk.step + 1)

    def _known(self, observation: Observation, walk: NavigatorMemory, entry: int) -> np.ndarray:
        """The places [N, 4] that are known, as they are seen, or as the planner's world remembers them."""
        if "places" in observation:
            held = observation["places"][entry]
        elif "places" in self.planner.world.spec.channels and walk.thought.prior is not None:
            held = self.planner.world.render(walk.thought.prior, ("places",))["places"][0]
        else:
            return np.zeros((0, 4))
        return held[held[:, 3] > 0].double().cpu().numpy()

    def _noted(self, walk: NavigatorMemory, here: np.ndarray) -> NavigatorMemory:
        """Notices who does not get on: the place walked to is then avoided."""
        if math.dist(here, walk.before) > _STUCK_M:
            return replace(walk, before=(float(here[0]), float(here[1])), noted=walk.step)
        if walk.step - walk.noted < _STUCK_STEPS or walk.next is None:
            return walk
        return replace(walk, routes=None, avoided=(*walk.avoided, walk.next), noted=walk.step)


@dataclass(frozen=True)
class Destination:
    """Where to walk: a `pose` [7]: its first two numbers, metres, are the place, its rotation the heading, unless that is NaN. It
    is reached within `near_m` metres and FACING radians."""

    pose: torch.Tensor
    near_m: float = NEAR_M

    @property
    def place(self) -> tuple[float, float]:
        return float(self.pose[0]), float(self.pose[1])

    @property
    def heading(self) -> float | None:
        return float(yaw(self.pose)) if bool(torch.isfinite(self.pose[3:]).all()) else None

    def cost(self, world: World) -> Cost:
        """For the walker's planner: the distance to the place."""
        asked = torch.full((7,), torch.nan)
        asked[:2] = self.pose[:2]
        return distance_to(world, {"pose": asked})

    def walker(self, planner: Planner) -> Navigator:
        return Navigator(planner, self.place, self.heading)

    def away(self, pose: torch.Tensor) -> torch.Tensor:
        """How many metres [B] poses [B, 7] are away; who is near and faces elsewhere is a little more than `near_m` away."""
        far = (pose[:, :2] - self.pose[:2].to(pose)).norm(dim=1)
        if self.heading is None:
            return far
        off = torch.remainder(yaw(pose) - self.heading + math.pi, math.tau).sub(math.pi).abs()
        return torch.where((far > self.near_m) | (off < FACING), far, self.near_m + 0.1 * off)
