"""Explorer: a scripted policy that covers a first-person world, for recordings of all of it."""

from __future__ import annotations

import math
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path

import torch

from ..core.spec import Spec
from ..core.world import Observation
from ..space.camera import yaw
from .count_based import CountBased, random_int, random_unit

LEGS = ("MOVE_FORWARD", "MOVE_BACKWARD", "MOVE_LEFT", "MOVE_RIGHT", "TURN_LEFT", "TURN_RIGHT")
_BODY_M = 0.55  # half the width that must be free to walk through
_CELL_M = 1.5  # side of a cell of the visit counts
_Moves = Generator[tuple[str, ...], "_View", "_View"]  # yields the buttons of a step, and is sent the view after it


@dataclass(frozen=True)
class _View:
    """The part of an observation that walking uses: the position, and the distances in each direction of the picture."""

    x: float
    y: float
    yaw: float  # radians, counter-clockwise
    bearing: torch.Tensor  # [C] radians from straight ahead, left positive
    free_m: torch.Tensor  # [C] level distance to the first obstacle
    thing_m: torch.Tensor  # [C] distance to the nearest object that may move or be picked up, inf for none
    target_m: torch.Tensor  # [C] the same, of objects at eye height

    def walkable_m(self) -> torch.Tensor:
        """[C] metres that a body with width can go in each direction, as far as it sees."""
        apart = self.bearing[None, :] - self.bearing[:, None]
        along, across = self.free_m * torch.cos(apart), (self.free_m * torch.sin(apart)).abs()
        blocks = (across < _BODY_M) | (apart == 0)
        return torch.where(blocks, along, torch.inf).amin(1)

    def stands_at(self, other: _View) -> bool:
        return math.dist((other.x, other.y), (self.x, self.y)) < 0.02

    def ahead_m(self) -> float:
        """The same straight ahead."""
        across = (self.free_m * torch.sin(self.bearing)).abs()
        blocks = (across < _BODY_M) | (self.bearing.abs() < 0.05)
        return float((self.free_m * torch.cos(self.bearing))[blocks].min())

    def thing(self, towards: float | None = None, target: bool = False) -> tuple[float, float] | None:
        """Bearing and distance of an object in sight: the nearest, or the one nearest to the bearing `towards`. target: only
        objects at eye height."""
        far = self.target_m if target else self.thing_m
        seen = torch.isfinite(far)
        if not seen.any():
            return None
        cost = far if towards is None else torch.where(seen, (self.bearing - towards).abs(), torch.inf)
        pick = int(cost.argmin())
        near = seen & ((far - far[pick]).abs() < 1.0) & ((self.bearing - self.bearing[pick]).abs() < 0.3)
        return float(self.bearing[near].mean()), float(far[pick])


class Explorer:
    """A policy that covers a world. In worlds with depth, pose and Doom's six movement buttons it walks to the least visited
    places, mixed with random moves, up to `things`, at which it shoots (ATTACK), and through doors (USE). In other worlds it
    explores by visit counts (act/count_based.py, to which `log` and `recall` belong)."""

    def __init__(self, spec: Spec, log: Path | None = None):
        self.spec = spec
        self._walks = set(LEGS) <= set(spec.action_names) and {"depth", "pose"} <= set(spec.channels)
        self._seeker = CountBased(spec, log)

    def recall(self, steps: int) -> None:
        """Restores the state after the first `steps` of the log."""
        self._seeker.recall(steps)

    def begin(self, batch: int, rng: torch.Generator) -> list:
        """The memory of `batch` episodes: walks, which `act` advances in place."""
        return [_Walk(rng, self.spec) for _ in range(batch)] if self._walks else self._seeker.begin(batch, rng)

    def act(self, observation: Observation, memory: list, rng: torch.Generator) -> tuple[torch.Tensor, list]:
        if not self._walks:
            return self._seeker.act(observation, memory, rng)
        pressed = []
        for entry, walk in enumerate(memory):
            buttons = walk.next(_look(self.spec, {name: seen[entry : entry + 1] for name, seen in observation.items()}))
            pressed.append([float(name in buttons) for name in self.spec.action_names])
        return torch.tensor(pressed).to(torch.int8), memory


class _Walk:
    """One episode of walking: an endless sequence of moves of a few to a few dozen steps."""

    def __init__(self, rng: torch.Generator, spec: Spec):
        self.rng = rng
        self.shoots, self.uses = "ATTACK" in spec.action_names, "USE" in spec.action_names
        self.meets = "things" in spec.channels
        self.visits: dict[tuple[int, int], int] = {}
        self.boredom = 0.0  # grows while nothing new is seen, and lowers the threshold for a promising direction
        self._moves: _Moves | None = None

    def next(self, view: _View) -> tuple[str, ...]:
        """The buttons of the next step."""
        if self._moves is not None:
            return self._moves.send(view)
        self._moves = self.episode(view)
        return next(self._moves)

    def episode(self, view: _View) -> _Moves:
        kinds = [self.seek, self.run, self.turn, self.strafe, self.back, self.stop, self.look_around, self.mash]
        weights = torch.tensor([10.0, 2.0, 1.0, 1.5, 0.6, 0.4, 0.3, 1.0])
        while True:
            if self.meets and view.thing() and _chance(self.rng, 0.6):
                fights = self.shoots and _chance(self.rng, 0.8)
                view = yield from self.fight(view) if fights else self.fetch(view)
            kind = kinds[int(torch.multinomial(weights, 1, generator=self.rng))]
            view = yield from kind(view)

    def step(self, *buttons: str) -> _Moves:
        view = yield buttons
        cell = _cell(view.x, view.y)
        self.visits[cell] = self.visits.get(cell, 0) + 1
        return view

    # -- moves: each takes the current view, yields buttons and returns the last view ----------------------------

    def seek(self, view: _View) -> _Moves:
        """Turns to the most promising open direction in sight and runs there, steering clear of walls."""
        score = self.promise(view)
        side = "TURN_LEFT" if _chance(self.rng, 0.5) else "TURN_RIGHT"
        along = [(), (), ("MOVE_BACKWARD",), ("MOVE_LEFT",), ("MOVE_RIGHT",)][random_int(self.rng, 0, 4)]
        for _ in range(100):  # while only walls and known places are in sight, look elsewhere
            if float(score.max()) > 0.3 - self.boredom:
                break
            self.boredom += 0.005
            view = yield from self.step(side, *(("MOVE_FORWARD",) if view.ahead_m() > 2.0 else along))
            score = self.promise(view)
        self.boredom *= 0.5
        goal, stuck = self.choose(view, score), 0
        for step in range(1, random_int(self.rng, 12, 40)):
            if step % 8 == 0:  # look again; keep the heading unless another is clearly better
                apart = _wrapped(view.yaw + view.bearing - goal)
                goal = self.choose(view, self.promise(view) + 0.3 * torch.exp(-((apart / 0.3) ** 2)))
            off, ahead = _wrapped(goal - view.yaw), view.ahead_m()
            buttons = ["MOVE_FORWARD"] if abs(off) < 0.3 or ahead > 1.2 else list(along)
            if abs(off) > 0.06:
                buttons.append("TURN_LEFT" if off > 0 else "TURN_RIGHT")
            elif ahead < 1.2:
                break
            before = view
            view = yield from self.step(*buttons)
            stuck = stuck + 1 if buttons[:1] == ["MOVE_FORWARD"] and view.stands_at(before) else 0
            if stuck > 5:
                return (yield from self.dodge(view))
        return view

    def choose(self, view: _View, score: torch.Tensor) -> float:
        """A heading in the world (radians), sampled by softmax of the score."""
        likelihood = torch.exp(10 * (score - score.max()))
        return view.yaw + float(view.bearing[int(torch.multinomial(likelihood, 1, generator=self.rng))])

    def fight(self, view: _View) -> _Moves:
        """Turns to the nearest object at eye height and shoots at it. One fight of five only aims, and one of three aims beside it,
        so that recordings separate the effects of aiming, of a shot and of a hit."""
        ways = (), (), (), ("MOVE_LEFT",), ("MOVE_RIGHT",), ("MOVE_FORWARD",), ("MOVE_BACKWARD",)
        along = ways[random_int(self.rng, 0, 6)]
        often = (0.0, 0.3, 0.8, 1.0, 1.0)[random_int(self.rng, 0, 4)]
        beside = 0.0  # radians
        if _chance(self.rng, 1 / 3):
            side = -1 if _chance(self.rng, 0.5) else 1
            beside = side * random_int(self.rng, 8, 45) / 100
        target, turned = view.thing(target=True), 0.0
        for _ in range(random_int(self.rng, 20, 70)):
            if target is None:
                break
            off = target[0] - beside - turned  # a turn continues for one more step
            turn = () if abs(off) < 0.04 else ("TURN_LEFT",) if off > 0 else ("TURN_RIGHT",)
            shot = ("ATTACK",) if abs(target[0] - beside) < 0.12 and _chance(self.rng, often) else ()
            before, held = view.yaw, target[0]
            view = yield from self.step(*along, *turn, *shot)
            turned = _wrapped(view.yaw - before)
            target = view.thing(held - turned, target=True)
        return view

    def fetch(self, view: _View) -> _Moves:
        """Walks up to the nearest object in sight, as to a pick-up."""
        target, stuck = view.thing(), 0
        while target and stuck < 8:
            off = target[0]
            buttons = ["MOVE_FORWARD"] if abs(off) < 0.4 else []
            if abs(off) > 0.06:
                buttons.append("TURN_LEFT" if off > 0 else "TURN_RIGHT")
            before = view
            view = yield from self.step(*buttons)
            stuck = stuck + 1 if buttons[:1] == ["MOVE_FORWARD"] and view.stands_at(before) else 0
            target = view.thing(off) if _chance(self.rng, 0.98) else None  # some are never reached
        return view

    def use(self, view: _View) -> _Moves:
        """Presses USE at an obstacle, waits for it to open, and walks on if it does."""
        view = yield from self.hold(("USE",), 1, 3)
        for _ in range(random_int(self.rng, 10, 40)):
            view = yield from self.step(*(("MOVE_FORWARD",) if view.ahead_m() > 1.0 else ()))
        return view

    def dodge(self, view: _View) -> _Moves:
        """Away from a wall, towards the more open half; sometimes by a strafe or a step back."""
        if self.uses and _chance(self.rng, 0.5):
            view = yield from self.use(view)
            if view.ahead_m() > 1.5:
                return view
        left = float(view.free_m[view.bearing > 0].mean()) > float(view.free_m[view.bearing <= 0].mean())
        if _chance(self.rng, 0.15):
            left = not left
        if _chance(self.rng, 0.25):
            for _ in range(random_int(self.rng, 3, 10)):
                view = yield from self.step("MOVE_BACKWARD")
        side = ("MOVE_" if _chance(self.rng, 0.2) else "TURN_") + ("LEFT" if left else "RIGHT")
        for _ in range(random_int(self.rng, 8, 30)):
            view = yield from self.step(side)
            if side.startswith("TURN") and view.ahead_m() > 2.0:
                break
        return view

    def run(self, view: _View) -> _Moves:
        """Straight ahead, sometimes diagonally or while turning, until a wall is near."""
        ways = (), (), (), ("MOVE_LEFT",), ("MOVE_RIGHT",), ("TURN_LEFT",), ("TURN_RIGHT",)
        extra = ways[random_int(self.rng, 0, 6)]
        bump = _chance(self.rng, 0.15)  # recordings should have collisions too
        for _ in range(random_int(self.rng, 8, 40)):
            view = yield from self.step("MOVE_FORWARD", *extra)
            if not bump and view.ahead_m() < 0.9:
                return (yield from self.dodge(view))
        return view

    def turn(self, view: _View) -> _Moves:
        return (yield from self.hold(("TURN_LEFT",) if _chance(self.rng, 0.5) else ("TURN_RIGHT",), 3, 30))

    def strafe(self, view: _View) -> _Moves:
        buttons = ("MOVE_LEFT",) if _chance(self.rng, 0.5) else ("MOVE_RIGHT",)
        if _chance(self.rng, 0.4):  # circle around the view
            buttons += ("TURN_RIGHT",) if buttons[0] == "MOVE_LEFT" else ("TURN_LEFT",)
        return (yield from self.hold(buttons, 5, 25))

    def back(self, view: _View) -> _Moves:
        buttons = ("MOVE_BACKWARD",)
        if _chance(self.rng, 0.3):
            buttons += ("TURN_LEFT",) if _chance(self.rng, 0.5) else ("TURN_RIGHT",)
        return (yield from self.hold(buttons, 4, 20))

    def stop(self, view: _View) -> _Moves:
        return (yield from self.hold((), 3, 12))

    def look_around(self, view: _View) -> _Moves:
        """A quarter to a full turn, sometimes and back again (for loop closure)."""
        side = "TURN_LEFT" if _chance(self.rng, 0.5) else "TURN_RIGHT"
        sides = [side, "TURN_RIGHT" if side == "TURN_LEFT" else "TURN_LEFT"] if _chance(self.rng, 0.4) else [side]
        angle = math.pi * (0.5 + 1.5 * random_unit(self.rng))
        for side in sides:
            turned = 0.0
            for _ in range(140):
                before = view.yaw
                view = yield from self.step(side)
                turned += abs(_wrapped(view.yaw - before))
                if turned >= angle:
                    break
        return view

    def mash(self, view: _View) -> _Moves:
        """Random key combinations, as a person tries a keyboard."""
        for _ in range(random_int(self.rng, 2, 6)):
            pressed = torch.rand(len(LEGS), generator=self.rng) < 0.3
            buttons = tuple(name for name, down in zip(LEGS, pressed.tolist()) if down)
            view = yield from self.hold(buttons, 3, 12)
        return view

    def hold(self, buttons: tuple[str, ...], least: int, most: int) -> _Moves:
        for _ in range(random_int(self.rng, least, most)):
            view = yield from self.step(*buttons)
        return view

    def promise(self, view: _View) -> torch.Tensor:
        """[C] in 0..1: the free distance in each direction times the novelty of the places along it."""
        free = view.walkable_m().clamp(0, 12.0)
        novelty = torch.zeros_like(free)
        for index, (distance, bearing) in enumerate(zip(free.tolist(), view.bearing.tolist())):
            direction = view.yaw + bearing
            reach = [0.5 + i for i in range(1, 12) if 0.5 + i < distance - 0.4]
            cells = [_cell(view.x + r * math.cos(direction), view.y + r * math.sin(direction)) for r in reach]
            if cells:
                novelty[index] = sum(1 / (1 + self.visits.get(cell, 0) / 3) for cell in cells) / len(cells)
        return novelty * (free / 5.0).clamp(max=1.0)


def _look(spec: Spec, observation: Observation, bins: int = 33) -> _View:
    """Bearings and free distances from the depth rows around the horizon, and the pose."""
    focal, _, centre, horizon = spec.camera or (0.5, 0.8, 0.5, 0.5)
    depth = observation["depth"][0].float()
    height = depth.shape[0]
    top = min(int(height * (horizon - 0.04)), height - 1)
    bottom = max(top + 1, int(height * (horizon + 0.05)))
    level = torch.nn.functional.adaptive_max_pool1d(-depth[top:bottom].amin(0)[None], bins)[0].neg()
    bearing = -torch.atan(((torch.arange(bins) + 0.5) / bins - centre) / focal)
    thing = target = torch.full((bins,), torch.inf)
    if "things" in observation:
        far = torch.where(observation["things"][0].bool(), depth, torch.inf)
        pooled = torch.nn.functional.adaptive_max_pool1d
        thing, target = (-pooled(-rows.amin(0)[None], bins)[0] for rows in (far, far[top:bottom]))
    pose, far = observation["pose"][0], [level / torch.cos(bearing) for level in (level, thing, target)]
    return _View(float(pose[0]), float(pose[1]), float(yaw(pose)), bearing, *far)


def _cell(x: float, y: float) -> tuple[int, int]:
    return math.floor(x / _CELL_M), math.floor(y / _CELL_M)


def _wrapped(angle):
    """An angle, a number or a tensor, wrapped to -pi..pi."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def _chance(rng: torch.Generator, likelihood: float) -> bool:
    return random_unit(rng) < likelihood
