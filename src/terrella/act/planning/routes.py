"""Routes to a place beyond a planner's horizon, over places where a camera has been or where one can stand."""

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
    """No route to a place is known."""


NEAR_M, FACING = 0.5, 0.35  # metres, and radians of heading, within which a place is reached
STRIDE_S = 0.115  # for which each move is held when walking
STRIDE_M = 1.6  # largest gap between two camera places that count as connected; walls are rarely between them
STEP_M, AHEAD_M = 0.45, 0.9  # largest gap between two connected walkable places; distance to the next target
CELL_M = 0.4  # nearer camera places are merged
_STUCK_STEPS, _STUCK_M = 45, 0.35  # less progress than this over these steps: take another route
_DETOUR_M = 4.0  # penalty for passing a place that could not be reached
_TURNS_M = 0.6  # distance to the place within which to turn to the heading
_REROUTE_STEPS = 70  # between two searches for a route, as more places become known


@dataclass(frozen=True)
class Routes:
    """Shortest routes from known places to a goal."""

    places: np.ndarray  # [N, 2] metres
    left_m: np.ndarray  # [N] to the goal along the route; inf: no route
    onward: np.ndarray = field(repr=False)  # [N] index of the next place, -1 for the goal itself
    stride_m: float = STRIDE_M  # between two places, at most
    ahead_m: float = math.inf  # along the route to the next target, at most

    def target(self, here: np.ndarray, goal: np.ndarray) -> tuple[np.ndarray, float]:
        """The next target [2] from `here`, as far along the best route as a stride reaches, and the metres left to go."""
        straight = float(np.linalg.norm(goal - here))
        if straight <= self.stride_m or not len(self.places):
            return goal, straight
        away = np.linalg.norm(self.places - here, axis=1)
        leads = np.isfinite(self.left_m)
        if not leads.any():
            return goal, math.inf
        near = leads & (away <= self.stride_m)
        if not near.any():
            near = leads & (away <= away[leads].min() + 1e-6)  # off all routes: to the nearest place on one
        total = np.where(near, away + self.left_m, np.inf)
        at = int(total.argmin())
        left = float(total[at])
        while (on := self.onward[at]) >= 0 and away[on] <= STRIDE_M and left - self.left_m[on] <= self.ahead_m:
            at = int(on)
        return (goal if self.onward[at] < 0 and away[at] < 2 * CELL_M else self.places[at]), left


@dataclass(frozen=True)
class NavigatorMemory:
    """The navigator's memory of one episode; places are x and y in metres."""

    planner: PlannerMemory
    routes: Routes | None = None
    target: tuple[float, float] | None = None
    step: int = 0
    progress_at: tuple[float, float] = (math.inf, math.inf)  # where it last made progress
    progress_step: int = 0  # when
    avoided: tuple[tuple[float, float], ...] = ()  # targets that could not be reached


def routes_to(goal: np.ndarray, known: np.ndarray, avoided: tuple[tuple[float, float], ...] = ()) -> Routes:
    """Dijkstra (1959) from the goal [2] over known places [N, 4] (x, y, heading, kind), with a penalty near `avoided` ones."""
    walkable = bool(len(known)) and bool((known[:, 3] == WALKABLE).all())
    stride, ahead = (STEP_M, AHEAD_M) if walkable else (STRIDE_M, math.inf)
    known = known[:, :2]
    if not walkable:
        _, first = np.unique(np.round(known / CELL_M).astype(np.int64), axis=0, return_index=True)
        known = known[np.sort(first)]
    places = known.astype(np.float64)
    penalty = np.zeros(len(places))
    for spot in avoided:
        penalty += _DETOUR_M * (np.linalg.norm(places - np.asarray(spot), axis=1) < 0.8)
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
            further = far + apart[other] + penalty[other]
            if further < left[other]:
                heapq.heappush(queue, (float(further), other, at))
    return Routes(places, left, onward, stride, ahead)


class Navigator:
    """Walks to `place`, x and y in metres, in a world with the channel `pose`, and there turns to `heading` radians, if given.

    planner: its goal in `pose` is replaced by the next target on the route. Routes lead over the channel `places`, observed or
    remembered by the planner's world; without it, straight on. NoRoute if no route is known.
    """

    def __init__(self, planner: Planner, place: tuple[float, float], heading: float | None = None):
        if "pose" not in planner.cost.channels:
            raise PlanningError("walking to a place needs a planner with a goal in 'pose'.")
        self.planner, self.place, self.heading = planner, np.asarray(place, np.float64), heading

    def begin(self, batch: int, rng: torch.Generator) -> list[NavigatorMemory]:
        return [NavigatorMemory(planner) for planner in self.planner.begin(batch, rng)]

    def act(
        self, observation: Observation, memory: list[NavigatorMemory], rng: torch.Generator
    ) -> tuple[torch.Tensor, list[NavigatorMemory]]:
        walks = [self._lead(walk, observation, entry) for entry, walk in enumerate(memory)]
        actions, planned = self.planner.act(observation, [walk.planner for walk in walks], rng)
        return actions, [replace(walk, planner=planner) for walk, planner in zip(walks, planned)]

    def _lead(self, walk: NavigatorMemory, observation: Observation, entry: int) -> NavigatorMemory:
        """The memory with the next target as the planner's goal."""
        here = observation["pose"][entry, :2].double().cpu().numpy()
        walk = self._check_progress(walk, here)
        if walk.routes is None or walk.step % _REROUTE_STEPS == 0 or not len(walk.routes.places):
            known = self._known(observation, walk, entry)
            walk = replace(walk, routes=routes_to(self.place, known, walk.avoided))
        assert walk.routes is not None
        target, left = walk.routes.target(here, self.place)
        if not math.isfinite(left):
            raise NoRoute("no route to that place is known; choose one near recorded places.")
        pose = torch.full_like(walk.planner.goal["pose"], torch.nan)
        pose[0, :2] = torch.from_numpy(target).to(pose)
        if self.heading is not None and left < _TURNS_M:
            pose[0, 3], pose[0, 6] = math.cos(self.heading / 2), math.sin(self.heading / 2)
        planner = replace(walk.planner, goal={**walk.planner.goal, "pose": pose})
        return replace(walk, planner=planner, target=(float(target[0]), float(target[1])), step=walk.step + 1)

    def _known(self, observation: Observation, walk: NavigatorMemory, entry: int) -> np.ndarray:
        """The known places [N, 4], observed or remembered by the planner's world."""
        if "places" in observation:
            held = observation["places"][entry]
        elif "places" in self.planner.world.spec.channels and walk.planner.prior is not None:
            held = self.planner.world.render(walk.planner.prior, ("places",))["places"][0]
        else:
            return np.zeros((0, 4))
        return held[held[:, 3] > 0].double().cpu().numpy()

    def _check_progress(self, walk: NavigatorMemory, here: np.ndarray) -> NavigatorMemory:
        """Without progress for some steps, the target is avoided from now on."""
        if math.dist(here, walk.progress_at) > _STUCK_M:
            return replace(walk, progress_at=(float(here[0]), float(here[1])), progress_step=walk.step)
        if walk.step - walk.progress_step < _STUCK_STEPS or walk.target is None:
            return walk
        return replace(walk, routes=None, avoided=(*walk.avoided, walk.target), progress_step=walk.step)


@dataclass(frozen=True)
class Destination:
    """A place to walk to, reached within `near_m` metres and FACING radians."""

    pose: torch.Tensor  # [7]: x and y in metres, and the heading as a rotation, NaN for any
    near_m: float = NEAR_M

    @property
    def place(self) -> tuple[float, float]:
        return float(self.pose[0]), float(self.pose[1])

    @property
    def heading(self) -> float | None:
        return float(yaw(self.pose)) if bool(torch.isfinite(self.pose[3:]).all()) else None

    def cost(self, world: World) -> Cost:
        """The planner's cost: the distance to the place."""
        goal = torch.full((7,), torch.nan)
        goal[:2] = self.pose[:2]
        return distance_to(world, {"pose": goal})

    def navigator(self, planner: Planner) -> Navigator:
        return Navigator(planner, self.place, self.heading)

    def distance_m(self, pose: torch.Tensor) -> torch.Tensor:
        """The distance [B] of poses [B, 7] in metres; a near pose with another heading counts as a little more than `near_m`."""
        far = (pose[:, :2] - self.pose[:2].to(pose)).norm(dim=1)
        if self.heading is None:
            return far
        off = torch.remainder(yaw(pose) - self.heading + math.pi, math.tau).sub(math.pi).abs()
        return torch.where((far > self.near_m) | (off < FACING), far, self.near_m + 0.1 * off)
