"""SplatWorld: a place of Gaussians to walk and fly in, with floors and walls read off them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple, final

import numpy as np
import torch
from gymnasium import spaces

from ..core import chance
from ..core.errors import ObservationError, TerrellaError
from ..core.spec import PLACES_UNIT, POSE, POSE_UNIT, WALKABLE, Camera, Spec
from ..core.state import State
from ..core.world import Observation
from ..space.camera import Intrinsics, rotation, yaw
from ..space.enclosure import ColliderKind
from ..space.fitting import resize_depth
from ..space.occupancy import Occupancy, Walker
from ..space.raster import Drawing, Gaussians, rasterise
from ..space.raster.move import multiply_quaternions
from ..space.solids import Solids
from ..space.walkable import walkable
from .additions import OBSERVED, Additions
from .collider_file import kept_collider
from .parts import check_prior, picture_of

BUTTONS = ("MOVE_FORWARD", "MOVE_BACKWARD", "MOVE_LEFT", "MOVE_RIGHT", "TURN_LEFT", "TURN_RIGHT", "UP", "DOWN")
KEYS = {
    "KeyW": "MOVE_FORWARD", "KeyS": "MOVE_BACKWARD", "KeyA": "MOVE_LEFT", "KeyD": "MOVE_RIGHT", "ArrowLeft": "TURN_LEFT",
    "ArrowRight": "TURN_RIGHT", "ArrowUp": "MOVE_FORWARD", "ArrowDown": "MOVE_BACKWARD", "Space": "UP", "KeyC": "DOWN",
}  # fmt: skip
# the push of each button: forward, left, turn to the left, up
_PUSH = torch.tensor(
    [[1, 0, 0, 0], [-1, 0, 0, 0], [0, 1, 0, 0], [0, -1, 0, 0], [0, 0, 1, 0], [0, 0, -1, 0], [0, 0, 0, 1], [0, 0, 0, -1]]
).float()
GRAVITY = 9.81  # m/s^2
LEVELS = {"sure": 0.1, "invents": 0.5}  # of the channel `uncertainty`, a share of the picture
MOST_PLACES = 8192  # rows of the channel `places`


@dataclass(frozen=True)
class SplatConfig:
    """Of a place of Gaussians."""

    camera: Intrinsics = (0.5, 0.667, 0.5, 0.5)
    size: tuple[int, int] = (192, 256)  # height and width of its pictures
    dt_s: float = 1 / 30  # of a step
    buttons: tuple[str, ...] = BUTTONS  # some of BUTTONS; without UP nobody flies
    # m, m, rad and m a step that a push adds forward, sideways, turning and upward
    pace: tuple[float, float, float, float] = (0.03, 0.025, 0.018, 0.025)
    keep: tuple[float, float, float, float] = (0.7, 0.7, 0.6, 0.7)  # share of each speed that stays in a step
    body: Walker = Walker()
    additions: int = 32768  # Gaussians that pictures may add to the place of an episode
    collider: ColliderKind = "open"  # how the grid that the Gaussians fill is closed (space/enclosure.py)
    inside: tuple[float, float, float] | None = (
        None  # the point in free space from which that is judged; None: the first start
    )


class SolidBoxes(NamedTuple):
    """Boxes that stop bodies."""

    boxes: torch.Tensor  # float32 [S, 6], low and high corners in metres
    bodies: torch.Tensor  # int32 [S], the object that can be pushed of which each is a part; 0: it stays

    @staticmethod
    def of(boxes: torch.Tensor | None, bodies: torch.Tensor | None = None) -> SolidBoxes:
        """Boxes that stay, unless `bodies` says otherwise; None: no boxes."""
        boxes = torch.zeros(0, 6) if boxes is None else boxes
        return SolidBoxes(boxes, torch.zeros(len(boxes), dtype=torch.int32) if bodies is None else bodies)


@final
class SplatWorld:
    """Gaussians with a provenance each, uint8 [N] (OBSERVED: seen, or built as asked; INVENTED: added, or changed by an edit), and
    `starts` [S, 7], poses in which episodes begin. `objects` int32 [N]: the object of each Gaussian (0: none; -k: hidden beneath
    k until an edit moves k); `card["objects"]` may list the names of 1, 2, ... Bodies collide with `solids`, or without any with
    what the Gaussians fill. Where MuJoCo is installed, objects that can be pushed are rigid bodies that carry their Gaussians;
    the channel `bodies` [K, 7] has their poses, in the order of the objects.

    rgb and depth (0: nothing) are drawn by `rasterise`; ids int32 [H, W]: the Gaussian with the largest share of a pixel (-1:
    none); known [H, W]: how much of a pixel was observed; uncertainty: the share of the picture that was not. UP lifts off;
    DOWN to the floor walks again. `places`: where one can walk to (kind 4). Pictures with depth are fused into the place of
    their episode alone (space/fusing.py); floors and walls stay.
    """

    def __init__(
        self,
        name: str,
        gaussians: Gaussians,
        provenance: torch.Tensor,
        starts: torch.Tensor,
        config: SplatConfig | None = None,
        card: Mapping[str, Any] | None = None,
        objects: torch.Tensor | None = None,
        solids: SolidBoxes | None = None,
    ):
        self.name, self.gaussians, self.provenance, self.starts = name, gaussians, provenance, starts
        self.config, self.card = config or SplatConfig(), dict(card or {})
        self.objects = torch.zeros(len(gaussians), dtype=torch.int32) if objects is None else objects
        self.solids, self.bodies = SolidBoxes.of(None) if solids is None else solids
        things = self.bodies.unique().tolist() if find_spec("mujoco") else []
        self.things = [number for number in things if number]  # the objects that are rigid bodies here
        self.added = Additions(gaussians, provenance, self.config.additions)
        self.collider_file: Path | None = None  # where `occupancy` is kept, because it takes seconds
        self.spec = self._spec()

    def _spec(self) -> Spec:
        height, width = self.config.size
        buttons = self.config.buttons
        poses = {"bodies": spaces.Box(-np.inf, np.inf, (len(self.things), 7), np.float32)} if self.things else {}
        return Spec(
            name=self.name,
            action=spaces.MultiBinary(len(buttons)),
            channels={
                "rgb": spaces.Box(0, 255, (height, width, 3), np.uint8),
                "depth": spaces.Box(0, np.inf, (height, width), np.float32),
                "pose": POSE,
                "ids": spaces.Box(-1, 2**24, (height, width), np.int32),
                "known": spaces.Box(0, 1, (height, width), np.float32),
                "uncertainty": spaces.Box(0, 1, (), np.float32),
                "places": spaces.Box(-np.inf, np.inf, (MOST_PLACES, 4), np.float32),
                **poses,
            },
            observes=("pose",),
            may_observe=("rgb", "depth"),
            dt_s=self.config.dt_s,
            units={
                "depth": "m",
                "pose": POSE_UNIT,
                "places": PLACES_UNIT,
                **dict.fromkeys(poses, POSE_UNIT.replace("cam", "body")),
            },
            action_names=buttons,
            keys={k: [float(one == name) for one in buttons] for k, name in KEYS.items() if name in buttons},
            cameras={"rgb": Camera(self.config.camera, self.config.size)},
            card={"kind": "splat", "uncertainty": LEVELS, **self.card},
        )

    @property
    def object_names(self) -> list[str]:
        """Names of the objects 1, 2, ..., if the card has them."""
        named = self.card.get("objects")
        return [str(one) for one in named] if isinstance(named, list) else []

    @cached_property
    def occupancy(self) -> Occupancy:
        """What the Gaussians fill, closed as `config.collider` says."""
        eyes = self.starts[:, :3]
        eyes = eyes if self.config.inside is None else torch.cat([torch.tensor([self.config.inside]), eyes])
        return kept_collider(self.gaussians, eyes, self.config.collider, self.config.body, self.collider_file)

    @cached_property
    def collider(self) -> Solids | Occupancy:
        """What stops a body, without the things that can be pushed."""
        still = ~torch.isin(self.bodies, torch.tensor(self.things, dtype=torch.int32))
        return Solids(self.solids[still]) if len(self.solids) else self.occupancy

    @cached_property
    def places(self) -> torch.Tensor:
        """The channel `places` [MOST_PLACES, 4]: where one can walk to from the starts; zeros in the other rows."""
        places = walkable(self.collider, self.starts[:, :3], self.config.body, MOST_PLACES)
        table = torch.zeros(MOST_PLACES, 4)
        table[: len(places), :2], table[: len(places), 3] = places[:, :2], WALKABLE
        return table

    @cached_property
    def rigid(self) -> Any:
        """The physics of the things that can be pushed (space/mujoco_bodies.py)."""
        from ..space.mujoco_bodies import RigidBodies

        owner = torch.zeros_like(self.bodies)
        for at, number in enumerate(self.things):
            owner[self.bodies == number] = at + 1
        return RigidBodies(self.solids, owner, self.config.body, self.config.dt_s)

    @cached_property
    def _riders(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Which Gaussians ride on things, and on which."""
        place = torch.full((max(int(self.objects.max()) if len(self.objects) else 0, *self.things, 0) + 1,), -1)
        place[self.things] = torch.arange(len(self.things))
        on = place[self.objects.long().clamp_min(0)]
        rows = (on >= 0).nonzero()[:, 0]
        return rows, on[rows]

    def start(self, batch: int, rng: torch.Generator) -> State:
        """Poses drawn from `starts`."""
        if batch < 1:
            raise TerrellaError("start needs a batch of one or more.")
        seeds = chance.seeds(batch, rng)
        row = (chance.uniform(seeds) * len(self.starts)).long().clamp_max(len(self.starts) - 1)
        return self._standing(self.starts[row])

    def observe(self, observation: Observation, prior: State | None, rng: torch.Generator) -> State:
        """The viewer is put at the pose; a picture with depth (metres, 0: unknown) is fused into the place of its episode."""
        if "pose" not in observation:
            raise ObservationError(f"{self.name} observes `pose`.")
        pose = torch.as_tensor(observation["pose"]).float()
        if pose.ndim != 2 or pose.shape[1] != 7 or not bool(pose.isfinite().all()):
            raise ObservationError(
                f"{self.name} observes finite poses [B, 7]; got a tensor of shape {tuple(pose.shape)}."
            )
        if prior is not None:
            check_prior(prior.batch, len(pose))
        state = self._standing(pose) if prior is None else prior.replace(pose=pose.clone())
        if not {"rgb", "depth"} <= set(observation):
            return state
        rgb, depth = picture_of(observation, self.config.size, "cpu"), torch.as_tensor(observation["depth"]).float()
        if depth.ndim != 3 or not len(depth) == len(rgb) == len(pose) or not bool((depth >= 0).all()):
            raise ObservationError(
                f"depth is [{len(pose)}, h, w] in metres, 0 where unknown; got {tuple(depth.shape)}."
            )
        deep = resize_depth(depth, self.config.size)
        return self.added.observed(state, rgb, deep, self.config.camera, lambda one, at: self._ridden(one, state, at))

    def imagine(self, state: State, action: torch.Tensor, rng: torch.Generator) -> State:
        """One step on: pushed by the buttons, held up by floors, stopped by walls."""
        action = self.spec.check_action(action, state.batch).float()
        config, pose = self.config, state["pose"]
        push = _PUSH[[BUTTONS.index(name) for name in config.buttons]]
        wish = (action @ push).clamp(-1, 1)
        speed = state["speed"] * torch.tensor(config.keep) + self._ahead(pose, wish)
        flying = state["flying"] | (wish[:, 3] > 0)
        level = torch.cat([speed[:, :2], (speed[:, 3] * flying)[:, None]], 1)
        place, pushed = self._gone(state, level)
        stand = self._floor({**state, **pushed}, place) + config.body.eye_m
        falling = torch.where(flying, 0.0, state["falling"] + GRAVITY * config.dt_s**2)
        flying = flying & ~((wish[:, 3] < 0) & (place[:, 2] <= stand + 0.05))
        climbed = place[:, 2] + ((stand - place[:, 2]) * 0.3).clamp_max(0.15)
        walked = torch.where(stand >= place[:, 2] - 0.2, climbed, torch.maximum(stand, place[:, 2] - falling))
        falling = torch.where(walked <= stand + 0.2, 0.0, falling)
        z = torch.where(flying, place[:, 2], walked)
        shift = place[:, :2] - pose[:, :2]
        # a wall takes the speed that goes into it
        gone = torch.where(shift.abs() < 0.5 * speed[:, :2].abs(), shift, speed[:, :2])
        speed = torch.cat([gone, speed[:, 2:]], 1)
        pose = torch.cat([place[:, :2], z[:, None], _yawed(pose[:, 3:], speed[:, 2])], 1)
        return state.replace(pose=pose, speed=speed, falling=falling, flying=flying, **pushed)

    def _gone(self, state: State, level: torch.Tensor) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Where a body that wants to go by `level` [B, 3] metres arrives, and the things that it pushes on the way."""
        eye, body = state["pose"][:, :3], self.config.body
        goal = self.collider.walk(eye, level, body)
        if not self.things:
            return goal, {}
        poses, speeds, came = self.rigid.step(state["bodies"], state["body_speeds"], eye, goal)
        held = (came != goal).any(1, keepdim=True)  # things push back, but never into a wall
        place = torch.where(held, self.collider.walk(eye, came - eye, body), goal)
        return place, {"bodies": poses, "body_speeds": speeds}

    def _floor(self, state: Mapping[str, torch.Tensor], place: torch.Tensor) -> torch.Tensor:
        """Height [B] of the floor under `place` [B, 3]: the place's own, or the top of a thing."""
        level = self.collider.floor(place, self.config.body)
        if not self.things:
            return level
        low = replace(self.config.body, step_m=0.1)
        return torch.maximum(level, Solids(self.rigid.boxes(state["bodies"])).highest(place, low))

    def render(self, state: State, channels: Sequence[str]) -> Observation:
        """Channels by name; `pose`, `bodies` and `places` need no drawing."""
        self.spec.check_channels(channels)
        seen = {name: state[name] for name in channels if name in state}
        if "places" in channels:
            seen["places"] = self.places.expand(state.batch, -1, -1)
        drawn = [name for name in channels if name not in seen]
        if drawn:
            shown = [self._seen(state, entry, drawn) for entry in range(state.batch)]
            seen |= {name: torch.cat([one[name] for one in shown]) for name in drawn}
        return {name: seen[name] for name in channels}

    def _seen(self, state: State, entry: int, channels: Sequence[str]) -> dict[str, torch.Tensor]:
        """The drawn channels of one entry of a state."""
        scene, provenance = self.added.of(state, entry)
        scene = self._ridden(scene, state, entry)
        with torch.no_grad():
            seen = rasterise(scene, state["pose"][entry][None], self.config.camera, self.config.size)
        return {name: _shown(seen, provenance, name) for name in channels}

    def _ridden(self, scene: Gaussians, state: State, entry: int) -> Gaussians:
        """The scene with the Gaussians of things where these are now."""
        if not self.things or torch.equal(state["bodies"][entry], self.rigid.rest):
            return scene
        (rows, on), poses = self._riders, state["bodies"][entry]
        off = scene.means[rows] - self.rigid.rest[on, :3]
        means = (rotation(poses)[on] @ off[..., None])[..., 0] + poses[on, :3]
        quats = multiply_quaternions(poses[on, 3:], scene.quats[rows])
        ridden = {"means": scene.means.index_copy(0, rows, means), "quats": scene.quats.index_copy(0, rows, quats)}
        return replace(scene, **ridden)

    def _standing(self, pose: torch.Tensor) -> State:
        count = len(pose)
        flying = torch.zeros(count, dtype=torch.bool)
        still = {"speed": torch.zeros(count, 4), "falling": torch.zeros(count), "flying": flying}
        if self.things:
            still["bodies"] = self.rigid.rest.expand(count, -1, -1).clone()
            still["body_speeds"] = torch.zeros(count, len(self.things), 6)
        return State({"pose": pose.clone(), **still, **self.added.empty(count)}, self.added.arenas)

    def _ahead(self, pose: torch.Tensor, wish: torch.Tensor) -> torch.Tensor:
        """What pushes [B, 4] forward, left, turning and up add to the speeds along world x and y, of turning, and upward."""
        heading = yaw(pose)
        c, s = heading.cos(), heading.sin()
        forward, left, turn, up = (wish * torch.tensor(self.config.pace)).unbind(1)
        return torch.stack([c * forward - s * left, s * forward + c * left, turn, up], 1)


def _yawed(quats: torch.Tensor, angle: torch.Tensor) -> torch.Tensor:
    """Quaternions [B, 4] turned by [B] radians about the world's z, of length 1."""
    c, s = (angle / 2).cos(), (angle / 2).sin()
    w, x, y, z = quats.unbind(1)
    turned = torch.stack([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w], 1)
    return turned / turned.norm(dim=1, keepdim=True)


def _shown(seen: Drawing, provenance: torch.Tensor, name: str) -> torch.Tensor:
    """A channel of a drawing of Gaussians with this provenance."""
    if name == "rgb":
        return (seen.rgb.clamp(0, 1) * 255).round().to(torch.uint8).permute(0, 2, 3, 1).contiguous()
    if name == "depth":
        return torch.where(seen.alpha > 0.5, seen.depth / seen.alpha.clamp_min(0.5), 0.0)
    if name == "ids":
        return seen.ids
    origin = torch.cat([provenance, provenance.new_zeros(1)]) == OBSERVED  # the last for -1
    known = seen.alpha.clamp(0, 1) * origin[seen.ids.long()]
    return known if name == "known" else 1 - known.mean((1, 2))
