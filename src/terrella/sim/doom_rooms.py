"""A Doom map as a task with instructions: "go to the red room". Rooms are sectors, named by what their walls look like."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from gymnasium import spaces

from ..core.errors import TerrellaError
from ..core.instruction import text_to_bytes
from ..core.similar import did_you_mean
from ..core.spec import EVENT, POSE_UNIT, TEXT
from ..core.state import State
from .doom import Doom, DoomConfig
from .doom_map import wall_textures
from .doom_routes import RoomRoutes

TICS, MAX_STEPS = 4, 150  # of a step; steps of an episode
SKILL = 4  # the highest at which the game lets the player be placed
# Texture of a room's walls -> its name, from how Freedoom draws it.
NAMES = {
    "FLOOR1_6": "red", "SFALL2": "green", "CEIL4_2": "blue", "COMP01": "white", "CRATE2": "grey", "BIGDOOR2": "metal",
    "TLITE6_1": "lamp", "SILVER2": "silver",
}  # fmt: skip
WORDINGS = ("go to the {} room", "walk to the {} room", "find the {} room", "enter the {} room")
HELD_OUT = ("head over to the {} room", "please move into the {} room")  # wordings that training never sees
VARIANTS = ("rooms", "rooms:unseen", "rooms:free")


@dataclass(frozen=True)
class _Episode:
    room: str = ""  # the room to go to; "" where nothing is asked for
    text: str = ""


class DoomRooms:
    """Doom's map with a room to go to. An episode starts in another named room, anywhere, in any direction. `text` names the room;
    `expert` is the action of a teacher who knows the map; reward 1 and the end of the episode when the player is in the room. The
    map's own goal, an armour, ends an episode without success. A step is 4 tics. variant: "rooms"; "rooms:unseen" has wordings that
    training never sees; "rooms:free" asks for nothing and goes on. TerrellaError for a map without rooms of known walls."""

    def __init__(self, config: DoomConfig, variant: str = "rooms"):
        if variant not in VARIANTS:
            hint = did_you_mean(variant, VARIANTS) or "."
            raise TerrellaError(f"there is no task '{variant}'{hint} Doom has {', '.join(VARIANTS)}.")
        if (config.skill or SKILL) > SKILL:
            raise TerrellaError(f"skill {config.skill}: the game does not let its player be placed; give 1 to {SKILL}.")
        self._doom = inner = Doom(replace(config, tics=TICS, skill=config.skill or SKILL))
        self._variant, self._wordings = variant, HELD_OUT if variant == "rooms:unseen" else WORDINGS
        self._walls, textures = inner.walls(), wall_textures(Path(inner.wad), inner.map_name)
        self.rooms = {NAMES[each]: number for number, each in enumerate(textures) if each in NAMES}
        if len(self.rooms) < 2:
            inner.close()
            raise TerrellaError(f"{config.scenario} has no rooms of different walls to name; my_way_home has eight.")
        self._routes = RoomRoutes(self._walls)
        self._episode = _Episode()
        width = len(inner.buttons)
        channels = {name: inner.spec.channels[name] for name in ("rgb", "pose", "reward", "done")}
        channels |= {"text": TEXT, "expert": spaces.Box(0, 1, (width,), np.float32), "success": EVENT}
        card = {"what": f"ViZDoom's {config.scenario}: go to the room that an instruction names", "kind": "simulator"}
        self.spec = replace(
            inner.spec, name=f"doom:{config.scenario}:{variant}", channels=channels, card=card, system={},
            units={"pose": POSE_UNIT},
            max_episode_steps=None if variant == "rooms:free" else MAX_STEPS,
        )  # fmt: skip

    def start(self, batch: int, rng: torch.Generator) -> State:
        """A new episode: `rng` draws the room to go to, the wording, the room of the start and the place in it."""
        state = self._doom.start(batch, rng)
        names = list(self.rooms)
        goal, begins = torch.randperm(len(names), generator=rng)[:2].tolist()
        text = self._wordings[int(torch.randint(len(self._wordings), (1,), generator=rng))].format(names[goal])
        self._episode = _Episode() if self._variant == "rooms:free" else _Episode(names[goal], text)
        places = self._routes.free_points(self.rooms[names[begins]])
        x, y = places[int(torch.randint(len(places), (1,), generator=rng))]
        return self._doom.placed(state, x, y)

    def observe(self, observation, prior: State | None, rng: torch.Generator) -> State:
        """The prior, or a start: a game cannot be set from an observation."""
        if not observation and prior is None:
            return self.start(1, rng)
        return self._doom.observe(observation, prior, rng)

    def imagine(self, state: State, action: torch.Tensor, rng: torch.Generator) -> State:
        """One step; after `done` the game stands still."""
        was = self._success()
        after = self._doom.imagine(state, action, rng)
        now = self._success()
        self._doom.judge(float(now and not was), now)
        return after

    def render(self, state: State, channels) -> dict[str, torch.Tensor]:
        self.spec.check_channels(channels)
        own = {"text": self._text, "expert": self._expert, "success": lambda: torch.tensor(self._success())}
        seen = self._doom.render(state, [name for name in channels if name not in own])
        return {name: own[name]()[None] if name in own else seen[name] for name in channels}

    def close(self) -> None:
        self._doom.close()

    def _text(self) -> torch.Tensor:
        return torch.from_numpy(text_to_bytes(self._episode.text).copy())

    def _success(self) -> bool:
        x, y, _ = self._doom.place()
        return bool(self._episode.room) and self._routes.sector_at(x, y) == self.rooms[self._episode.room]

    def _expert(self) -> torch.Tensor:
        """The teacher's buttons: nothing where nothing is asked for, or the room is reached."""
        pressed = dict.fromkeys(self._doom.buttons, 0.0)
        if self._episode.room and not self._success():
            x, y, yaw = self._doom.place()
            pressed |= dict.fromkeys(self._routes.buttons(x, y, yaw, self.rooms[self._episode.room]), 1.0)
        return torch.tensor(list(pressed.values()))
