"""RedrawnWorld: a World of pictures in which tracked things can be set, by moving their patches. `Guarded` corrects it so."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
import torch.nn.functional as F
from gymnasium import spaces
from torch import Tensor

from ..core.errors import TerrellaError
from ..core.state import State
from ..core.world import Observation, World
from .system import PhysicalSystem
from .tracker import DIFFERENCE, REACH, RING, Followed, Tracker, begin
from .tracks import HERE, PLACE, RADIUS, Tracked

FAINT = 0.05  # of a pixel: what a thing covers less of is background
_KEY = "tracks."
_PARTS = ("place", "speed", "area", "usual", "colour", "here", "cut", "others")
_MODEL = ("model", "model_place", "model_area")  # the last observed picture, and its things


class RedrawnWorld:
    """`RedrawnWorld(world, tracked)`: a world that observes pictures, with the channels of tracks beside its own.

    It observes those channels: things that are set elsewhere are cut out of the picture, the background is filled in, and they are
    pasted where they should be. A picture in the observation is observed as it is. `system` describes the bodies, in the tracker's
    order (by colour, then from left to right); their velocities are differences of positions.

    State: that of the world, and tracks.* of the things."""

    def __init__(self, world: World, tracked: Tracked):
        pictures = world.spec.kinds("rgb")
        if not pictures or pictures[0] not in world.spec.observes:
            raise TerrellaError(
                f"{world.spec.name} observes no picture, so things cannot be moved in it; guard its channels."
            )
        self.world, self.tracked, self._rgb = world, tracked, pictures[0]
        bodies = tuple(replace(body, velocity=None) for body in tracked.system.bodies)
        self.system: PhysicalSystem = replace(tracked.system, bodies=bodies)
        count = len(bodies)
        widths = {PLACE: 2 * count, RADIUS: count, HERE: count}
        more = {name: spaces.Box(-np.inf, np.inf, (width,), np.float64) for name, width in widths.items()}
        self.spec = replace(
            world.spec, channels={**world.spec.channels, **more}, observes=tuple(widths), may_observe=world.spec.observes, leap=0,
        )  # fmt: skip

    def start(self, batch: int, rng: torch.Generator) -> State:
        return self._followed(self.world.start(batch, rng), None)

    def observe(self, observation: Observation, prior: State | None, rng: torch.Generator) -> State:
        inner = None if prior is None else _bare(prior)
        if self._rgb in observation:
            given = {name: part for name, part in observation.items() if name not in self.spec.observes}
            return self._followed(self.world.observe(given, inner, rng), prior)
        if prior is None or inner is None:
            raise TerrellaError(f"{self.spec.name} begins with a picture; give '{self._rgb}'.")
        picture = self._redrawn(prior, observation)
        rest = {
            name: part for name, part in self.world.render(inner, self.world.spec.observes).items() if name != self._rgb
        }
        after = self.world.observe({self._rgb: picture, **rest}, inner, rng)
        parts = {**{name: prior[_KEY + name] for name in _MODEL}, **self._set(prior, observation), "shown": picture}
        return after.replace(**{_KEY + name: part for name, part in parts.items()})

    def imagine(self, state: State, action: Tensor, rng: torch.Generator) -> State:
        return self._followed(self.world.imagine(_bare(state), action, rng), state, dreamt=True)

    def render(self, state: State, channels: Sequence[str]) -> dict[str, Tensor]:
        self.spec.check_channels(channels)
        own = [name for name in channels if name not in self.spec.observes]
        shown = dict(self.world.render(_bare(state), own)) if own else {}
        return {name: shown[name] if name in shown else self._channel(state, name) for name in channels}

    def _channel(self, state: State, name: str) -> Tensor:
        count, batch = len(self.system.bodies) - 1, state.batch
        here, none = state[_KEY + "here"][:, :count], torch.zeros(batch, 1, dtype=torch.float64)
        if name == HERE:
            return torch.cat([here.double(), (state[_KEY + "others"] > 0).double()[:, None]], 1)
        if name == RADIUS:
            size = (state[_KEY + "usual"][:, :count] / torch.pi).sqrt() * self.tracked.scale.metres_per_pixel
            return torch.cat([size, none], 1)
        place = self.tracked.scale.metres(state[_KEY + "place"][:, :count])
        return torch.cat([place.flatten(1), none, none], 1)

    def _followed(self, inner: State, prior: State | None, dreamt: bool = False) -> State:
        picture = self.world.render(inner, (self._rgb,))[self._rgb].cpu()
        areas = self.tracked.tracker.areas(picture)
        if prior is None:
            things = begin(areas)
        else:
            before = Followed(*(prior[_KEY + name] for name in _PARTS))
            things = before.step(areas, REACH * picture.shape[2])
        missing = len(self.system.bodies) - 1 - things.area.shape[1]
        parts: dict[str, Tensor] = {name: getattr(things, name) for name in _PARTS}
        if prior is None and missing > 0:  # fewer things than bodies: the others are not there
            for name in _PARTS[:-1]:
                flat = (0, 0, 0, missing) if parts[name].ndim == 3 else (0, missing)
                parts[name] = F.pad(parts[name], flat)
        parts.update({"shown": picture, "model": picture, "model_place": parts["place"], "model_area": parts["area"]})
        if dreamt and prior is not None:
            parts.update({name: prior[_KEY + name] for name in _MODEL})
        return inner.replace(**{_KEY + name: part for name, part in parts.items()})

    def _goal(self, observation: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """(places [B, N, 2] in pixels, bool [B, N]: there) that are observed."""
        given = torch.as_tensor(observation[PLACE]).double().unflatten(1, (-1, 2))[:, :-1]
        return self.tracked.scale.pixels(given), torch.as_tensor(observation[HERE])[:, :-1] != 0

    def _set(self, prior: State, observation: Mapping[str, Tensor]) -> dict[str, Tensor]:
        goal, here = self._goal(observation)
        count = goal.shape[1]
        parts = {name: prior[_KEY + name].clone() for name in _PARTS}
        parts["speed"][:, :count] += torch.where(here[..., None], goal - parts["place"][:, :count], 0.0)
        parts["place"][:, :count], parts["here"][:, :count] = goal, here
        parts["others"] = torch.where(torch.as_tensor(observation[HERE])[:, -1] != 0, parts["others"], 0)
        return parts

    def _redrawn(self, prior: State, observation: Mapping[str, Tensor]) -> Tensor:
        """The pictures uint8 [B, H, W, 3] with each thing at its place, as it looked when it was last observed."""
        goal, here = self._goal(observation)
        picture, model = prior[_KEY + "shown"].float(), prior[_KEY + "model"].float()
        at, background = prior[_KEY + "model_place"], self.tracked.tracker.background
        drawn = torch.where(_things(picture, background)[..., None], background, picture)
        radius = (prior[_KEY + "model_area"] / torch.pi).sqrt() + RING
        for body in range(goal.shape[1]):
            mask = _own(at, radius, body, picture.shape[1:3])
            layer = _layer(model, background, mask, self.tracked.tracker, prior[_KEY + "colour"][:, body].long())
            layer = _shifted(layer, goal[:, body] - at[:, body])
            shown = drawn * (1 - layer[..., :1]) + layer[..., 1:]
            drawn = torch.where(here[:, body, None, None, None], shown, drawn)
        return drawn.round().clamp(0, 255).to(torch.uint8)


def _bare(state: State) -> State:
    return State({name: part for name, part in state.items() if not name.startswith(_KEY)}, state.arenas)


def _things(picture: Tensor, background: Tensor) -> Tensor:
    """bool [B, H, W]: pixels at which something differs from the background, with a ring around them."""
    differs = ((picture - background).abs().amax(-1) > DIFFERENCE).float()
    return F.max_pool2d(differs[:, None], 2 * RING + 1, 1, RING)[:, 0] > 0


def _own(place: Tensor, radius: Tensor, body: int, size: torch.Size) -> Tensor:
    """bool [B, H, W]: pixels within the radius of a body, and nearer to it than to others."""
    y, x = torch.arange(size[0]) + 0.5, torch.arange(size[1]) + 0.5
    away = (
        (x - place[:, :, None, None, 0]) ** 2 + (y[:, None] - place[:, :, None, None, 1]) ** 2
    ).sqrt()  # [B, N, H, W]
    gap = away - radius[:, :, None, None]
    return (gap[:, body] <= 0) & (gap[:, body] <= gap.amin(1))


def _layer(source: Tensor, background: Tensor, mask: Tensor, tracker: Tracker, colour: Tensor) -> Tensor:
    """The cover of a thing within a mask, and its colour times its cover: [B, H, W, 4]."""
    row, y, x = mask.nonzero(as_tuple=True)
    behind = background[y, x]
    share = tracker.cover(source[row, y, x], behind)[0].gather(1, colour[row][:, None])
    layer = torch.zeros(*mask.shape, 4)
    layer[row, y, x] = torch.cat([share, source[row, y, x] - (1 - share) * behind], 1) * (share > FAINT)
    return layer


def _shifted(values: Tensor, way: Tensor) -> Tensor:
    """Values [B, H, W, C] moved by `way` [B, 2] pixels to the right and down, bilinearly, 0 beyond the edge."""
    height, width = values.shape[1:3]
    turn = torch.eye(2, 3).repeat(len(values), 1, 1)
    turn[:, :, 2] = -2 * way.float() / torch.tensor([width, height])
    grid = F.affine_grid(turn, [len(values), 1, height, width], align_corners=False)
    return F.grid_sample(values.permute(0, 3, 1, 2), grid, align_corners=False).permute(0, 2, 3, 1)
