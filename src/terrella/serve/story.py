"""A story: one world, or a truth with a dream beside it, stepped by held keys, with its past and its recording."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import simplejpeg
import torch
from gymnasium import spaces

from ..core.errors import ServeError, TerrellaError
from ..core.spec import Spec
from ..core.state import State
from ..core.world import World, make_rng
from .actions import action_of_keys
from .chart import Chart, chart, mapped, tells_known, tinted
from .history import History, Moment
from .picture import MAX_DROPPED_PIXELS, doubtful, picture_of
from .protocol import DONE, FRESH

JPEG_QUALITY = 90


class Sink(Protocol):
    """Where a recorded session goes. The last row of an episode has action None: its terminal observation."""

    def add(
        self, observation: Mapping[str, np.ndarray], action: np.ndarray | None, reward: float, done: bool | None
    ) -> None: ...

    def end_episode(self) -> object: ...

    def close(self) -> None: ...


SinkFactory = Callable[[], Sink]


def vitals(spec: Spec) -> list[str]:
    """The channels that are one number of the player's, such as health, which the page shows beside the score."""
    others = ("reward", "done", "uncertainty")
    return [name for name, space in spec.channels.items() if space.shape == () and name not in others]


def _alike(one: Spec, other: Spec, name: str) -> bool:
    """Whether both show the channel, in the same form."""
    return name in one.channels and name in other.channels and one.channels[name].shape == other.channels[name].shape


@dataclass(frozen=True)
class StoryConfig:
    """history_s: seconds of pictures kept (for rewinding and clips); state_mb: memory for the states among them."""

    history_s: float = 30.0
    state_mb: int = 256


def check_playable(worlds: Sequence[World]) -> None:
    """ServeError where these worlds cannot be shown on one page, with the reason."""
    if len(worlds) not in (1, 2):
        raise ServeError(f"a page shows one world or two side by side; got {len(worlds)}.")
    for world in worlds:
        space = world.spec.channels.get("rgb")
        if not isinstance(space, spaces.Box) or len(space.shape) != 3 or space.shape[2] != 3 or space.dtype != np.uint8:
            raise ServeError(
                f"{world.spec.name} shows no picture (an rgb channel, uint8 [H, W, 3]), so it cannot be played."
            )
    if len(worlds) == 2 and worlds[0].spec.action != worlds[1].spec.action:
        first, second = (world.spec for world in worlds)
        raise ServeError(f"{first.name} and {second.name} take different actions; compare a dream with its own game.")


class Story:
    """Not thread-safe, and slow: the session calls it from one worker thread, a verb at a time."""

    def __init__(
        self,
        worlds: Sequence[World],
        seed: int,
        sink_factory: SinkFactory | None = None,
        config: StoryConfig | None = None,
        picture: torch.Tensor | None = None,
    ):
        check_playable(worlds)
        config = config or StoryConfig()
        self.worlds, self._picture = tuple(worlds), picture
        self.notice = ""  # something that a person should know, in one sentence
        self._sink_factory = sink_factory
        self._sink: Sink | None = None
        self._seen: dict[str, np.ndarray] | None = None  # the observation that the next recorded action answers
        frames = int(min(max(config.history_s / self.spec.dt_s, 64), 4096))
        self._history = History(frames, config.state_mb * 2**20)
        self.restart(seed)

    @property
    def spec(self) -> Spec:
        """Of the world that is played; a dream beside it follows."""
        return self.worlds[0].spec

    @property
    def no_rewind(self) -> str:
        """Why there is no way back; empty where there is."""
        fixed = [world.spec.name for world in self.worlds if not world.spec.forkable]
        return f"{fixed[0]} is a running game: it cannot go back in time." if fixed else ""

    @property
    def recording(self) -> bool:
        return self._sink is not None

    @property
    def shown(self) -> Moment:
        """The moment that the story stands at: the newest, unless it was rewound."""
        return self._shown

    @property
    def newest_step(self) -> int:
        return self._history.newest.step

    @property
    def oldest_step(self) -> int:
        return self._history.oldest_step

    @property
    def rewound(self) -> bool:
        return self._shown.step < self.newest_step

    @property
    def state_bytes(self) -> int:
        return self._history.state_bytes

    def pictures(self) -> list[tuple[bytes, ...]]:
        """The JPEGs of the recent past, oldest first, up to the moment shown."""
        past = self._history.pictures()
        return past[: len(past) - (self.newest_step - self._shown.step)]

    def chart(self) -> tuple[int, Chart] | None:
        """The map of the moment shown, of the last world that has one, and which that is; None where none has."""
        number = max((at for at, world in enumerate(self.worlds) if mapped(world.spec)), default=None)
        if number is None:
            return None
        return number, chart(self.worlds[number], (self._shown.states or self._states)[number])

    def tinted(self, moment: Moment) -> tuple[bytes, ...]:
        """The moment's JPEGs with what was invented tinted, where a world says that and the moment's states are kept."""
        images = list(moment.images)
        for number, world in enumerate(self.worlds):
            if moment.states is not None and tells_known(world.spec):
                seen = world.render(moment.states[number], ("rgb", "known"))
                images[number] = encode_jpeg(tinted(seen["rgb"], seen["known"]))
        return tuple(images)

    # -- verbs --------------------------------------------------------------------------------------------------

    def restart(self, seed: int, same_picture: bool = True) -> Moment:
        """A new story from `seed`, and the picture that this one began with, if any; the past is forgotten, once the new one
        has begun."""
        picture, self._picture = self._picture, self._picture if same_picture else None
        rngs = tuple(make_rng(seed) for _ in self.worlds)
        try:
            states = self._starts(rngs)
        except TerrellaError:
            self._picture = picture
            raise
        self.seed, self._rngs = seed, rngs
        self._history.clear()
        return self._begin(0, states)

    @torch.no_grad()
    def step(self, held: Sequence[str]) -> Moment:
        """One step of every world under the keys held; after `done`, the first moment of the next episode."""
        if self.rewound:
            self._return_to(self._history.newest)
        if self._shown.flags & DONE:
            return self._begin(self._shown.step + 1, self._starts(self._rngs))
        action = action_of_keys(self.spec, held)
        pairs = zip(self.worlds, self._states, self._rngs, strict=True)
        self._states = tuple(world.imagine(state, action, rng) for world, state, rng in pairs)
        return self._show(self._shown.step + 1, 0, action)

    def stand_at(self, step: int) -> Moment:
        """Shows a remembered moment without going on from it."""
        if self.no_rewind:
            raise ServeError(self.no_rewind)
        self._shown = self._history.at(step)
        return self._shown

    def branch(self) -> Moment:
        """Goes on from the moment shown: what came after it is forgotten, and the same actions lead to the same frames."""
        if self.rewound:
            self._end_episode()
            self._history.forget_after(self._shown.step)
            self._return_to(self._shown)
        return self._shown

    def to_newest(self) -> Moment:
        self._shown = self._history.newest
        return self._shown

    def enter(self, data: bytes) -> Moment:
        """A new episode that begins with a picture, the bytes of an image file; the past stays."""
        height, width = self.spec.channels["rgb"].shape[:2]
        before = self._picture
        self._picture = picture_of(data, (height, width), MAX_DROPPED_PIXELS, "this picture")
        try:
            states = self._starts(self._rngs)
        except TerrellaError:
            self._picture = before
            raise
        if self.rewound:
            self._return_to(self._history.newest)
        return self._begin(self._shown.step + 1, states)

    @torch.no_grad()
    def sync(self) -> Moment:
        """The dream looks at the truth as it is now."""
        if len(self.worlds) != 2:
            raise ServeError("there is no truth beside this world to look at; play with --compare.")
        if self.rewound or self._shown.flags & DONE:
            raise ServeError("go on from this moment first, then let the dream look at the game.")
        self._states = (self._states[0], self._dream_of(self._states[0], self._rngs[1]))
        return self._show(self._shown.step + 1, 0, None)

    def record(self, on: bool) -> None:
        """Begins or ends writing the played world (the truth, where two are shown) to a dataset."""
        if on and not self._sink:
            if not self._sink_factory:
                raise ServeError(
                    "there is nowhere to record to; start the server with a folder: terrella play ... --record DIR."
                )
            self._sink, self._seen = self._sink_factory(), None
        elif not on and self._sink:
            self._close_sink()

    def close(self) -> None:
        self._close_sink()

    # -- inside -------------------------------------------------------------------------------------------------

    @torch.no_grad()
    def _starts(self, rngs: tuple[torch.Generator, ...]) -> tuple[State, ...]:
        if self._picture is not None:
            return (self._entered(self._picture, rngs[0]),)
        self.notice = ""
        truth = self.worlds[0].start(1, rngs[0])
        return (truth,) if len(self.worlds) == 1 else (truth, self._dream_of(truth, rngs[1]))

    @torch.no_grad()
    def _begin(self, step: int, states: tuple[State, ...]) -> Moment:
        self._end_episode()
        self._states, self._return = states, 0.0
        return self._show(step, FRESH, None)

    def _entered(self, picture: torch.Tensor, rng: torch.Generator) -> State:
        """The played world after seeing `picture`; a notice says so where it is unlike what the world knows."""
        world = self.worlds[0]
        if len(self.worlds) == 2:
            raise ServeError(
                "a picture cannot begin a comparison: the game cannot go on from it; play without --compare."
            )
        if "rgb" not in world.spec.observes:
            raise ServeError(f"{world.spec.name} takes no pictures, so it cannot begin with one.")
        state = world.observe({"rgb": picture[None]}, None, rng)
        levels = doubtful(world.spec)
        self.notice = ""
        if levels and float(world.render(state, ("uncertainty",))["uncertainty"][0]) >= levels[1]:
            self.notice = (
                f"this picture is unlike what {world.spec.name} learned from: most of what follows is invented."
            )
        return state

    def _dream_of(self, truth: State, rng: torch.Generator) -> State:
        dream = self.worlds[1]
        missing = [name for name in dream.spec.observes if name not in self.spec.channels]
        if missing or not dream.spec.observes:
            self.notice = f"the dream starts on its own: it cannot look at {self.spec.name}."
            return dream.start(1, rng)
        try:
            shared = [name for name in dream.spec.may_observe if _alike(self.spec, dream.spec, name)]
            state = dream.observe(self.worlds[0].render(truth, [*dream.spec.observes, *shared]), None, rng)
        except TerrellaError as error:
            self.notice = f"the dream starts on its own: {error}"
            return dream.start(1, rng)
        self.notice = ""
        return state

    def _show(self, step: int, flags: int, action: torch.Tensor | None) -> Moment:
        wanted = ["rgb", *(name for name in ("reward", "done", "uncertainty") if name in self.spec.channels)]
        told = vitals(self.spec)
        wanted += told
        extra = [name for name in self.spec.channels if name not in wanted] if self._sink else []
        seen = self.worlds[0].render(self._states[0], tuple(wanted + extra))
        others = [
            world.render(state, ("rgb", *(("uncertainty",) if "uncertainty" in world.spec.channels else ())))
            for world, state in zip(self.worlds[1:], self._states[1:], strict=True)
        ]
        images = tuple(encode_jpeg(view["rgb"]) for view in (seen, *others))
        reward = float(seen["reward"][0]) if "reward" in seen and action is not None else 0.0
        done = bool(seen["done"][0]) if "done" in seen and action is not None else False
        self._return += reward
        self._write(seen, action, reward, done)
        rngs = None
        if not self.no_rewind:
            rngs = torch.stack([rng.get_state() for rng in self._rngs])
        flags |= DONE * done
        last = (seen, *others)[-1]
        doubt = float(last["uncertainty"][0]) if "uncertainty" in last else -1.0
        fit = tuple(float(seen[name][0]) for name in told)
        moment = Moment(step, images, flags, self._return, None if self.no_rewind else self._states, rngs, doubt, fit)
        self._history.push(moment)
        self._shown = moment
        return moment

    def _return_to(self, moment: Moment) -> None:
        self._shown = moment
        if moment.states is not None and moment.rng is not None:
            self._states, self._return = moment.states, moment.episode_return
            for rng, state in zip(self._rngs, moment.rng, strict=True):
                rng.set_state(state)

    def _write(self, seen: Mapping[str, torch.Tensor], action: torch.Tensor | None, reward: float, done: bool) -> None:
        """The observation before, the action taken there, and the reward and done that followed."""
        if not self._sink:
            return
        if self._seen is not None and action is not None:
            self._put(self._seen, action[0].cpu().numpy(), reward, done)
        self._seen = {name: tensor[0].cpu().numpy() for name, tensor in seen.items() if name not in ("reward", "done")}

    def _end_episode(self) -> None:
        if self._sink and self._seen is not None:
            self._put(self._seen, None, 0.0, None)
            self._seen = None
            self._put()

    def _put(self, *row) -> None:
        """A row into the recording (no row: the end of an episode); play goes on where the recording cannot."""
        try:
            if self._sink and row:
                self._sink.add(*row)
            elif self._sink:
                self._sink.end_episode()
        except (TerrellaError, OSError) as error:
            self.notice = f"the recording stopped: {error}"
            self._seen = None
            self._drop_sink()

    def _close_sink(self) -> None:
        self._end_episode()
        self._drop_sink()

    def _drop_sink(self) -> None:
        sink, self._sink = self._sink, None
        if sink:
            try:
                sink.close()
            except (TerrellaError, OSError) as error:
                self.notice = f"the recording stopped: {error}"


def encode_jpeg(rgb: torch.Tensor) -> bytes:
    """One JPEG of rgb uint8 [1, H, W, 3]; colours are not subsampled, for small pictures are shown large."""
    picture = np.ascontiguousarray(rgb[0].cpu().numpy())
    return simplejpeg.encode_jpeg(picture, quality=JPEG_QUALITY, colorspace="RGB", colorsubsampling="444")
