"""A timeline: one world, or a game with a learned world beside it, with its past and its recording."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
import simplejpeg
import torch
from gymnasium import spaces

from ..core.errors import ServeError, TerrellaError
from ..core.policy import Policy
from ..core.spec import Spec, measured_trust
from ..core.state import State
from ..core.world import World, make_rng
from .agent import Agents, agents_of
from .chart import map_event, map_kind, tint_invented
from .driver import Driver
from .history import History, Image, Moment
from .picture import MAX_DROPPED_PIXELS, picture_of, strip_of, uncertainty_levels
from .presentation import events_of, numbers_of, outcome
from .protocol import BEYOND, DONE, FRESH, Goal
from .recording import SessionRecording, SinkFactory

JPEG_QUALITY = 95  # with 90 plain grass of pixel art is speckled


def _alike(one: Spec, other: Spec, name: str) -> bool:
    """Whether both have the channel, with the same shape."""
    return name in one.channels and name in other.channels and one.channels[name].shape == other.channels[name].shape


def no_rewind(worlds: Sequence[World]) -> str:
    """Why these worlds cannot go back in time; empty if they can."""
    fixed = next((world.spec.name for world in worlds if not world.spec.forkable), "")
    return f"{fixed} is a running game: it cannot go back in time." if fixed else ""


def check_playable(worlds: Sequence[World]) -> None:
    """ServeError if these worlds cannot be shown on one page."""
    if len(worlds) not in (1, 2):
        raise ServeError(f"a page shows one world or two side by side; got {len(worlds)}.")
    for world in worlds:
        for name in world.spec.kinds("rgb") or ("rgb",):
            space = world.spec.channels.get(name)
            drawn = isinstance(space, spaces.Box) and len(space.shape) == 3 and space.shape[2] == 3
            if not drawn or space.dtype != np.uint8:
                raise ServeError(
                    f"{world.spec.name} has no pictures to show (a channel {name}, uint8 [H, W, 3]), so it cannot be "
                    "played; `terrella record` and `terrella score` take it."
                )
    if len(worlds) == 2 and worlds[0].spec.action != worlds[1].spec.action:
        first, second = (world.spec for world in worlds)
        raise ServeError(
            f"{first.name} and {second.name} take different actions; compare a world with the game it learned."
        )


class Timeline:
    """Not thread-safe, and slow: the session calls it from one worker thread, one method at a time.

    The first world is played; a learned world beside it, the dream, gets the same actions. policy: may drive in place of the person
    (driver.py). history_s, state_mb: as in ServeConfig. keys: the spec with other keys than the world's own."""

    def __init__(
        self,
        worlds: Sequence[World],
        seed: int,
        sink_factory: SinkFactory | None = None,
        picture: torch.Tensor | None = None,
        policy: Policy | Agents | None = None,
        history_s: float = 30.0,
        state_mb: int = 256,
        keys: Spec | None = None,
    ):
        check_playable(worlds)
        self.worlds, self.spec = tuple(worlds), worlds[0].spec
        self.obeyed = self.spec if keys is None else keys  # the spec whose keys a person presses
        self.no_rewind = no_rewind(worlds)
        self.notice = ""  # a message for the person, in one sentence
        self.ending: dict[str, object] | None = None  # of an episode that is over: outcome, text, steps, vitals, score
        self.cameras: tuple[str, ...] = ("rgb",)  # the picture channels that are shown
        self.driver = Driver(agents_of(policy), worlds[0])
        self.recording = SessionRecording(sink_factory)
        frames = int(min(max(history_s / self.spec.dt_s, 64), 4096))
        self.history = History(frames, state_mb * 2**20)
        self.shown: Moment  # the newest moment, or the one that was rewound to
        self._picture = picture
        self.restart(seed)

    @property
    def rewound(self) -> bool:
        return self.shown.step < self.history.newest.step

    @property
    def map_kind(self) -> str:
        """The kind of map that `map_event` returns; "" for none."""
        return next((kind for world in reversed(self.worlds) if (kind := map_kind(world.spec))), "")

    def pictures(self) -> list[tuple[bytes, ...]]:
        """The JPEGs of the recent past, oldest first, up to the moment shown, as far back as the same cameras were shown."""
        past = self.history.pictures()
        past = past[: len(past) - (self.history.newest.step - self.shown.step)]
        views = [image[:2] for image in past[-1]]
        first = next((at for at in range(len(past), 0, -1) if [image[:2] for image in past[at - 1]] != views), 0)
        return [tuple(image.jpeg for image in images) for images in past[first:]]

    @torch.inference_mode()
    def map_event(self) -> dict | None:
        """The map at the moment shown, of the last world that has one, as the page gets it; None if none has."""
        number = max((at for at, world in enumerate(self.worlds) if map_kind(world.spec)), default=None)
        if number is None:
            return None
        state = (self.shown.states or self._states)[number]
        return {"world": number, "step": self.shown.step, **map_event(self.worlds[number], state)}

    @torch.inference_mode()
    def consider(self) -> dict | None:
        """Imagines another piece of the futures that the agent considers; returns them as the page gets them when complete."""
        futures = self.driver.consider()
        if not futures:
            return None
        plans = [
            {"cost": cost if math.isfinite(cost) else None, "image": strip_of(pictures)} for cost, pictures in futures
        ]
        return {"step": self.shown.step, "frames": len(futures[0][1]), "plans": plans}

    @torch.inference_mode()
    def images(self, moment: Moment, invented: bool = False) -> tuple[Image, ...]:
        """The moment through the cameras shown now, with invented pixels tinted if `invented`; without the moment's states,
        its pictures as they are."""
        views = tuple((number, camera) for number in range(len(self.worlds)) for camera in self._shown_of(number))
        if moment.states is None or (not invented and views == tuple(image[:2] for image in moment.images)):
            return moment.images
        images: list[Image] = []
        for number, (world, state) in enumerate(zip(self.worlds, moment.states, strict=True)):
            for camera, name in self._shown_of(number).items():
                known = "known" + name.removeprefix("rgb")
                tint = invented and known in world.spec.channels
                seen = world.render(state, (name, known) if tint else (name,))
                picture = tint_invented(seen[name], seen[known]) if tint else seen[name]
                images.append(Image(number, camera, encode_jpeg(picture)))
        return tuple(images)

    # -- commands -----------------------------------------------------------------------------------------------

    @torch.inference_mode()
    def restart(self, seed: int, same_picture: bool = True) -> Moment:
        """A new episode from `seed`, and from the picture that this episode began with, if any. The past is forgotten once the new
        episode has begun."""
        picture = self._picture if same_picture else None
        rngs = tuple(make_rng(seed) for _ in (*self.worlds, "policy"))
        states = self._starts(rngs, picture)
        self.seed, self._rngs, self._picture = seed, rngs, picture
        self.history.clear()
        return self._begin(0, states)

    @torch.inference_mode()
    def step(self, held: Sequence[str] = (), axes: Sequence[float] = (), draw: bool = True) -> Moment:
        """One step of every world, with the action of the person or the agent; after `done`, the first moment of a new episode.
        Without `draw` the moment has the pictures of the one before, unless it is recorded."""
        if self.rewound:
            self._return_to(self.history.newest)
        if self.shown.flags & DONE:
            return self._begin(self.shown.step + 1, self._starts(self._rngs, self._picture))
        action = self.driver.action(self.obeyed, held, axes, self._states[0], self._rngs[-1])
        pairs = zip(self.worlds, self._states, self._rngs, strict=False)
        self._states = tuple(world.imagine(state, action, rng) for world, state, rng in pairs)
        return self._show(self.shown.step + 1, 0, action, draw or self.recording.on)

    def stand_at(self, step: int) -> Moment:
        """Shows a moment of the past without going on from it."""
        if self.no_rewind:
            raise ServeError(self.no_rewind)
        self.shown = self.history.at(step)
        return self.shown

    @torch.inference_mode()
    def branch(self) -> Moment:
        """Goes on from the moment shown and forgets the later ones. The same actions lead to the same frames."""
        if self.rewound:
            self.recording.end_episode()
            self.history.forget_after(self.shown.step)
            self._return_to(self.shown)
        return self.shown

    def to_newest(self) -> Moment:
        self.shown = self.history.newest
        return self.shown

    @torch.inference_mode()
    def enter(self, data: bytes) -> Moment:
        """A new episode that begins with a picture, the bytes of an image file. The past stays."""
        height, width = self.spec.channels["rgb"].shape[:2]
        picture = picture_of(data, (height, width), MAX_DROPPED_PIXELS, "this picture")
        states = self._starts(self._rngs, picture)
        self._picture = picture
        if self.rewound:
            self._return_to(self.history.newest)
        return self._begin(self.shown.step + 1, states)

    @torch.inference_mode()
    def seek(self, goal: Goal) -> None:
        """Gives the agent a goal; ServeError if it takes no such goals."""
        agents = self.driver.agents
        if goal.at is not None:
            if agents is None or not agents.places:
                raise ServeError(
                    "the agent here cannot walk to a place: that takes a world with a pose in which one can plan."
                )
            pose = torch.tensor([[*goal.at, *[torch.nan] * 5]])
            return self.driver.seek({"pose": pose}, {"at": list(goal.at)})
        if goal.words:
            if agents is None or agents.words is None:
                raise ServeError("the agent here takes no instructions.")
            return self.driver.seek(agents.words(goal.words), {"words": goal.words})
        if not goal.here and not goal.picture:
            return self.driver.seek({})
        if agents is None or not agents.pictures:
            raise ServeError("the agent here cannot seek a picture: this world cannot be planned in.")
        if goal.picture:
            height, width = self.spec.channels["rgb"].shape[:2]
            seen = {"rgb": picture_of(goal.picture, (height, width), MAX_DROPPED_PIXELS, "this picture")[None]}
        else:
            seen = self.worlds[0].render((self.shown.states or self._states)[0], self.spec.recorded)
        self.driver.seek(seen, {"image": strip_of(seen["rgb"])}, now=not goal.here)

    @torch.inference_mode()
    def sync(self) -> Moment:
        """Lets the dream observe the current state of the game."""
        if len(self.worlds) != 2:
            raise ServeError("there is no game beside this world to observe; play with --compare.")
        if self.rewound or self.shown.flags & DONE:
            raise ServeError("go on from this moment first, then let the dream observe the game.")
        self._states = (self._states[0], self._dream_of(self._states[0], self._rngs[1]))
        return self._show(self.shown.step + 1, 0, None)

    def look(self, cameras: Sequence[str]) -> None:
        """Shows the pictures of these channels from now on; for a world that has none of them, its main camera."""
        self.cameras = tuple(cameras) or ("rgb",)

    def record(self, on: bool) -> None:
        """Begins or ends recording the played world (of two, the game) to a dataset."""
        if on:
            self.recording.begin()
        else:
            self.close()

    def close(self) -> None:
        """Ends the recording, and says what was saved."""
        on = self.recording.on
        self.recording.close()
        self.notice = self.recording.fault or (self.recording.saved if on else self.notice)

    # -- inside -------------------------------------------------------------------------------------------------

    def _shown_of(self, number: int) -> dict[int, str]:
        """The cameras of a world that are shown: number -> channel."""
        known = dict(enumerate(self.worlds[number].spec.kinds("rgb")))
        return {at: name for at, name in known.items() if name in self.cameras} or {0: known[0]}

    def _starts(self, rngs: tuple[torch.Generator, ...], picture: torch.Tensor | None) -> tuple[State, ...]:
        if picture is not None:
            return (self._entered(picture, rngs[0]),)
        self.notice = ""
        game = self.worlds[0].start(1, rngs[0])
        return (game,) if len(self.worlds) == 1 else (game, self._dream_of(game, rngs[1]))

    def _begin(self, step: int, states: tuple[State, ...]) -> Moment:
        self.recording.end_episode()
        self._states, self._return = states, 0.0
        self.driver.forget()
        return self._show(step, FRESH, None)

    def _entered(self, picture: torch.Tensor, rng: torch.Generator) -> State:
        """The state of the played world after it observed `picture`. A notice says if the picture is unlike its training data."""
        world = self.worlds[0]
        if len(self.worlds) == 2:
            raise ServeError("a comparison cannot start from a picture: the game cannot; play without --compare.")
        if "rgb" not in world.spec.observes:
            raise ServeError(f"{world.spec.name} takes no pictures, so it cannot start from one.")
        state = world.observe({"rgb": picture[None]}, None, rng)
        levels = uncertainty_levels(world.spec)
        self.notice = ""
        if levels and float(world.render(state, ("uncertainty",))["uncertainty"][0]) >= levels[1]:
            self.notice = (
                f"this picture is unlike the recordings that {world.spec.name} was trained on: most of what follows is "
                "invented."
            )
        return state

    def _dream_of(self, game: State, rng: torch.Generator) -> State:
        """The state of the dream after it observed the game."""
        dream = self.worlds[1]
        missing = [name for name in dream.spec.observes if name not in self.spec.channels]
        if missing or not dream.spec.observes:
            self.notice = f"the dream starts on its own: it cannot observe {self.spec.name}."
            return dream.start(1, rng)
        try:
            shared = [name for name in dream.spec.may_observe if _alike(self.spec, dream.spec, name)]
            state = dream.observe(self.worlds[0].render(game, [*dream.spec.observes, *shared]), None, rng)
        except TerrellaError as error:
            self.notice = f"the dream starts on its own: {error}"
            return dream.start(1, rng)
        self.notice = ""
        return state

    def _show(self, step: int, flags: int, action: torch.Tensor | None, draw: bool = True) -> Moment:
        observations = [self._observed(number, draw) for number in range(len(self.worlds))]
        seen, last = observations[0], observations[-1]
        drawn = (
            Image(number, camera, encode_jpeg(observations[number][name]))
            for number in range(len(self.worlds))
            for camera, name in self._shown_of(number).items()
        )
        images = tuple(drawn) if draw else self.shown.images
        acted = action is not None
        reward = float(seen["reward"][0]) if "reward" in seen and acted else 0.0
        done = bool(seen["done"][0]) if "done" in seen and acted else False
        age = 0 if flags & FRESH else self.shown.age + 1
        imagined = self.shown.imagined + 1 if acted else 0
        trusted = measured_trust(self.worlds[-1].spec)
        beyond = BEYOND * (trusted is not None and imagined > trusted)
        numbers = self._numbers(seen, acted, bool(flags & FRESH))
        ended = outcome(numbers_of(self.spec), numbers, reward, self._return, age)
        self._return += reward
        self.ending = dict(ended, steps=age, vitals=numbers, score=self._return) if done else None
        self.recording.add(seen, action, reward, done)
        self.notice = self.recording.fault or self.notice
        moment = Moment(
            step,
            images,
            flags | DONE * done | beyond,
            self._return,
            None if self.no_rewind else self._states,
            None if self.no_rewind else tuple(rng.get_state() for rng in self._rngs),
            float(last["uncertainty"][0]) if "uncertainty" in last else -1.0,
            float(last["drifted"][0]) if "drifted" in last else 0.0,
            numbers,
            age,
            imagined,
        )
        self.history.push(moment)
        self.shown = moment
        return moment

    def _numbers(self, seen: Mapping[str, torch.Tensor], acted: bool, begins: bool) -> tuple[float, ...]:
        """The numbers of a step; of events, how many of them there were in this episode."""
        names, events = numbers_of(self.spec), events_of(self.spec)
        earlier = dict.fromkeys(names, 0.0) if begins else dict(zip(names, self.shown.vitals, strict=True))
        now = {name: float(seen[name][0]) for name in names}
        return tuple(earlier[name] + now[name] * acted if name in events else now[name] for name in names)

    def _observed(self, number: int, draw: bool) -> Mapping[str, torch.Tensor]:
        """The channels of a world that are shown, its pictures if `draw`, and those that are recorded."""
        spec = self.worlds[number].spec
        wanted = [*(self._shown_of(number).values() if draw else ()), "uncertainty", "drifted"]
        if number == 0:
            wanted += ["reward", "done", *numbers_of(spec), *(spec.recorded if self.recording.on else ())]
        names = tuple(dict.fromkeys(name for name in wanted if name in spec.channels))
        return self.worlds[number].render(self._states[number], names)

    def _return_to(self, moment: Moment) -> None:
        self.shown = moment
        if moment.states is not None and moment.rngs is not None:
            self._states, self._return = moment.states, moment.episode_return
            for rng, state in zip(self._rngs, moment.rngs, strict=True):
                rng.set_state(state)
            self.driver.forget()


def encode_jpeg(rgb: torch.Tensor) -> bytes:
    """One JPEG of rgb uint8 [1, H, W, 3], without chroma subsampling, because small pictures are shown large."""
    picture = np.ascontiguousarray(rgb[0].cpu().numpy())
    return simplejpeg.encode_jpeg(picture, quality=JPEG_QUALITY, colorspace="RGB", colorsubsampling="444")
