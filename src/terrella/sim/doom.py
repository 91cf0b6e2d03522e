"""ViZDoom as a World: the real game, with named buttons, exact depth and the camera's pose.

Doom's depth buffer has 8 bits (about 7 map units per level), so depth is ray cast from the map's sectors, and the buffer is used
only for nearer sprites. One metre is 32 map units. `things` masks everything that may move or vanish and should not enter a map;
`objects` has the position of each sprite, `instances` its pixels."""

import contextlib
import math
import os
import re
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import torch
import vizdoom
from gymnasium import spaces
from PIL import Image

from ..core.errors import ObservationError, StaleStateError, TerrellaError
from ..core.spec import DONE, EVENT, POSE, POSE_UNIT, REWARD, Camera, Spec
from ..core.state import State
from .doom_map import Sectors, map_names, skies
from .doom_system import doom_system

UNITS_PER_M = 32.0
TICS_PER_S = 35
MAX_DEPTH_M = 60.0
BUTTONS = ("MOVE_FORWARD", "MOVE_BACKWARD", "MOVE_LEFT", "MOVE_RIGHT", "TURN_LEFT", "TURN_RIGHT")
MORE_BUTTONS = ("ATTACK", "USE")  # if the scenario's configuration has them
KEYS = {
    "KeyW": "MOVE_FORWARD",
    "KeyS": "MOVE_BACKWARD",
    "KeyA": "MOVE_LEFT",
    "KeyD": "MOVE_RIGHT",
    "ArrowLeft": "TURN_LEFT",
    "ArrowRight": "TURN_RIGHT",
    "ArrowUp": "MOVE_FORWARD",
    "ArrowDown": "MOVE_BACKWARD",
    "Space": "ATTACK",
    "KeyE": "USE",
}
# Horizontal field of view 90 degrees; Doom's pixels are 1.2 times as tall as wide, so fy/H = 0.5 * (4/3) * 1.2.
CAMERA = (0.5, 0.8, 0.5, 0.5)
MAP_SPACING_M = 1024.0  # from one map of a game to the next: see `map_origin`
HEALTH = spaces.Box(0, 1000, (), np.float32)
OBJECTS = 16  # the nearest sprites that are listed
PICK_UPS = ("Health", "Armor", "Ammo", "Weapon", "Powerup", "Key")
SWITCHES = {"depth_buffer_enabled": True, "sectors_info_enabled": True, "audio_buffer_enabled": False}
SWITCHES |= {"automap_buffer_enabled": False, "window_visible": False, "render_hud": False, "render_weapon": False}
SWITCHES |= {"render_crosshair": False, "render_messages": False, "render_screen_flashes": False}
_COUNTED = vizdoom.GameVariable.HITCOUNT, vizdoom.GameVariable.KILLCOUNT
_BUFFER_SLOPE, _BUFFER_OFFSET = 0.1395, -1.8  # 8-bit level = floor(slope * map units + offset), fitted on my_way_home


@dataclass(frozen=True)
class DoomConfig:
    """The settings of a Doom world."""

    # A ViZDoom scenario, or maps of a game ("freedoom2/MAP01,MAP02"), one of which is drawn per episode.
    scenario: str = "my_way_home"
    # (height, width) of rgb, 4:3.
    size: tuple[int, int] = (96, 128)
    # (height, width) of depth and masks, 4:3.
    depth_size: tuple[int, int] = (96, 128)
    # Time limit of an episode in tics, 0 for none.
    timeout_tics: int = 0
    # Difficulty, 1 to 5. Default: the scenario's own, 3 on the maps of a game.
    skill: int | None = None
    # Tics of a step, 35 a second, for which its buttons are held.
    tics: int = 1


class Doom:
    """The game as a World: one process, one episode, not forkable, batch 1. A state is a ticket for the present.

    A scenario with the player's health has the channels `health`; `things` bool [h, w], the mask of sprites, doors and lifts;
    `objects` [OBJECTS, 4], the visible sprites, nearest first: a persistent number (0: none) and the position of its feet, metres;
    `instances` uint8 [h, w], the row of `objects` at each pixel, counted from 1; and `hit` and `fallen`, whether the player hit or
    felled something in this step. ATTACK and USE exist if its configuration has
    them. On a map of a game, a kill and the exit give reward 1, death -1, and episodes start at the map's start or at a
    pick-up."""

    def __init__(self, config: DoomConfig | None = None):
        self.config = config = config or DoomConfig()
        height, width = config.size
        if min(height, width) < 1 or 384 % height or 512 % width or 384 // height != 512 // width:
            raise TerrellaError(f"Doom renders at 384x512 divided by an integer; {height}x{width} is not such a size.")
        self._shrink = 384 // height
        scenario, self._maps = _named(config.scenario)
        self._game, self.buttons, alive = _open_game(config, scenario, self._maps)
        self.wad = _wad(self._game)
        self._places: dict[str, Sectors] = {}
        self._ticket = 0
        self._seen: dict[str, torch.Tensor] = {}
        self._cast_at = -1
        channels: dict[str, spaces.Space] = {
            "rgb": spaces.Box(0, 255, (height, width, 3), np.uint8),
            "depth": spaces.Box(0, MAX_DEPTH_M, config.depth_size, np.float32),
            "pose": POSE,
        }
        if alive:
            channels["things"] = spaces.Box(0, 1, config.depth_size, np.bool_)  # pyright: ignore
            channels["instances"] = spaces.Box(0, OBJECTS, config.depth_size, np.uint8)
            channels["objects"] = spaces.Box(-np.inf, np.inf, (OBJECTS, 4), np.float32)
            channels |= {"health": HEALTH, "hit": EVENT, "fallen": EVENT}
        self.spec = Spec(
            name=f"doom:{config.scenario}",
            action=spaces.MultiBinary(len(self.buttons)),
            channels={**channels, "reward": REWARD, "done": DONE},
            observes=(),
            dt_s=config.tics / TICS_PER_S,
            units={"depth": "m", "pose": POSE_UNIT},
            action_names=self.buttons,
            keys={
                key: [float(one == button) for one in self.buttons]
                for key, button in KEYS.items()
                if button in self.buttons
            },
            cameras={"rgb": Camera(CAMERA, config.size)},
            forkable=False,
            max_batch=1,
            system=self._system(),
            card={"what": f"ViZDoom's {config.scenario} with Freedoom's art: the real game", "kind": "simulator"},
        )

    def _system(self) -> dict[str, object]:
        """The player and the walls, where there is one map."""
        state = self._game.get_state()
        if self._maps or state is None:
            return {}
        walls = Sectors(state.sectors, skies(self.wad, self._game.get_doom_map()))
        return doom_system(walls.lines[walls.solid], UNITS_PER_M).to_json()

    def start(self, batch: int, rng: torch.Generator) -> State:
        """A new episode; `rng` draws the map and the spawn point where there are several."""
        if batch != 1:
            raise TerrellaError(f"{self.spec.name} is one game process: start(1, rng), or open several.")
        self._game.set_seed(int(torch.randint(2**31 - 1, (1,), generator=rng).item()))
        if self._maps:
            self._game.set_doom_map(self._maps[int(torch.randint(len(self._maps), (1,), generator=rng))])
        self._game.new_episode()
        self._enter_map()
        if self._maps:
            self._start_at_pick_up(rng)
        self._reward, self._done, self._counts = 0.0, False, [math.inf, math.inf]
        return self._advance()

    def observe(self, observation: Mapping[str, torch.Tensor], prior: State | None, rng: torch.Generator) -> State:
        """The prior, or a start: a game cannot be set from an observation."""
        if observation:
            raise ObservationError(f"{self.spec.name} is the real game and accepts no observation; call start(1, rng).")
        return prior if prior is not None else self.start(1, rng)

    def imagine(self, state: State, action: torch.Tensor, rng: torch.Generator) -> State:
        """One step of the game. After `done` it stands still."""
        buttons = self.spec.check_action(action, 1)
        self._check_present(state)
        if not self._done:
            self._reward = float(self._game.make_action(buttons[0].tolist(), self.config.tics))
            self._done = self._game.is_episode_finished()
        else:
            self._reward = 0.0
        return self._advance()

    def render(self, state: State, channels) -> dict[str, torch.Tensor]:
        self.spec.check_channels(channels)
        self._check_present(state)
        return {name: self._channel(name) for name in channels}

    def close(self) -> None:
        self._game.close()

    def walls(self) -> Sectors:
        """The geometry of the map, whose heights are those of now."""
        return Sectors(self._game.get_state().sectors, skies(self.wad, self.map_name))

    @property
    def map_name(self) -> str:
        return self._game.get_doom_map()

    def place(self) -> tuple[float, float, float]:
        """(x, y) of the player in map units, and the heading in radians."""
        x, y, _, yaw_deg, _ = (float(value) for value in np.asarray(self._present.game_variables))
        return x, y, math.radians(yaw_deg)

    def placed(self, state: State, x: float, y: float) -> State:
        """The player at (x, y), map units, of the same heading. For skills below 5, at which the game allows it."""
        self._check_present(state)
        self._warp(x, y)
        return self._advance()

    def judge(self, reward: float, over: bool) -> None:
        """The reward of this step by the rules of a task in place of the map's, and whether the episode ends here."""
        self._reward, self._done, self._seen = reward, self._done or over, {}

    def _warp(self, x: float, y: float) -> None:
        self._game.send_game_command(f"warp {x:.0f} {y:.0f}")
        self._game.make_action([0.0] * len(self.buttons), 2)

    def _enter_map(self) -> None:
        """Loads the geometry of the episode's map."""
        name, sectors = self._game.get_doom_map(), self._game.get_state().sectors
        if name not in self._places:
            self._places[name] = Sectors(sectors, skies(self.wad, name))
        self._walls, self._origin = self._places[name], map_origin(self.wad.stem, name) if self._maps else (0.0, 0.0)
        self._walls.update(sectors)
        self._walls.initial_heights = self._walls.heights

    def _start_at_pick_up(self, rng: torch.Generator) -> None:
        """In three of four episodes, moves the player to a random pick-up, because a map has only one start."""
        pick_ups = [thing for thing in self._game.get_state().objects if thing.category in PICK_UPS]
        if pick_ups and float(torch.rand(1, generator=rng)) < 0.75:
            place = pick_ups[int(torch.randint(len(pick_ups), (1,), generator=rng))]
            self._warp(place.position_x, place.position_y)
            if self._game.is_episode_finished():  # it was behind the exit
                self._game.new_episode()
                self._enter_map()

    def _check_present(self, state: State) -> None:
        if int(state["ticket"][0]) != self._ticket:
            raise StaleStateError(
                f"{self.spec.name} has moved on since this state and cannot go back (forkable=False)."
            )

    def _advance(self) -> State:
        self._ticket += 1
        counts = [self._game.get_game_variable(variable) for variable in _COUNTED]
        self._happened = dict(zip(("hit", "fallen"), (now > was for now, was in zip(counts, self._counts))))
        self._counts = counts
        present = self._game.get_state()
        if present is not None:  # at the end of an episode the last picture stays
            self._present = present
        self._seen = {}
        return State({"ticket": torch.tensor([self._ticket])})

    def _channel(self, name: str) -> torch.Tensor:
        if name not in self._seen:
            self._seen[name] = self._show(name)[None]
        return self._seen[name]

    def _show(self, name: str) -> torch.Tensor:
        if name == "reward":
            return torch.tensor(self._reward, dtype=torch.float32)
        if name == "done":
            return torch.tensor(self._done)
        if name in self._happened:
            return torch.tensor(self._happened[name])
        if name == "rgb":
            return torch.from_numpy(np.array(Image.fromarray(self._present.screen_buffer).reduce(self._shrink)))
        x, y, z, yaw_deg, health = (float(value) for value in np.asarray(self._present.game_variables))
        if name == "health":
            dead = self._done and self._game.is_player_dead()  # after death there is no state, the last picture stays
            return torch.tensor(0.0 if dead else max(health, 0.0), dtype=torch.float32)
        if name == "pose":
            half = np.deg2rad(yaw_deg) / 2
            here = np.array([x, y, z]) / UNITS_PER_M + (*self._origin, 0.0)
            return torch.tensor([*here, np.cos(half), 0.0, 0.0, np.sin(half)], dtype=torch.float32)
        if name in ("objects", "instances"):
            return torch.from_numpy(self._sprite_channels(x, y)[name])
        depth, sector = self._cast(x, y, z, np.deg2rad(yaw_deg))
        if name == "things":
            dynamic = self._walls.dynamic()
            return torch.from_numpy(self._sprites() | np.append(dynamic, False)[sector])
        depth_m = _with_sprites(depth, np.asarray(self._present.depth_buffer)) / UNITS_PER_M
        return torch.from_numpy(depth_m).float().clamp(0, MAX_DEPTH_M)

    def _cast(self, x: float, y: float, z: float, yaw: float) -> tuple[np.ndarray, np.ndarray]:
        """The current view of the map: depth [h, w] in map units and sector [h, w]."""
        if self._cast_at != self._ticket:
            self._walls.update(self._present.sectors)
            size, farthest = self.config.depth_size, MAX_DEPTH_M * UNITS_PER_M
            self._last_cast, self._cast_at = self._walls.depth(x, y, z, yaw, CAMERA, size, farthest), self._ticket
        return self._last_cast

    def _sprites(self) -> np.ndarray:
        """bool [h, w]: pixels that a sprite covers, even in part."""
        values = np.zeros(256, bool)
        values[[label.value for label in self._present.labels]] = True
        rows, columns = self.config.depth_size
        return _any_of(_any_of(values[self._present.labels_buffer], rows, 0), columns, 1)

    def _sprite_channels(self, x: float, y: float) -> dict[str, np.ndarray]:
        """`objects` and `instances` as seen from (x, y), in map units."""
        labels = [label for label in self._present.labels if label.object_name != "DoomPlayer"]
        labels.sort(key=lambda label: np.hypot(label.object_position_x - x, label.object_position_y - y))
        objects, row_of = np.zeros((OBJECTS, 4), np.float32), np.zeros(256, np.uint8)
        for row, label in enumerate(labels[:OBJECTS]):
            feet = np.array([label.object_position_x, label.object_position_y, label.object_position_z]) / UNITS_PER_M
            objects[row] = (label.object_id + 1, *(feet + (*self._origin, 0.0)))
            row_of[label.value] = row + 1
        instances = row_of[_sampled(np.asarray(self._present.labels_buffer), self.config.depth_size)]
        return {"objects": objects, "instances": instances}


def map_origin(game: str, name: str) -> tuple[float, float]:
    """The origin (x, y) of a game's map in one large world, metres, so that several maps can be learned together."""
    number = int("".join(re.findall(r"\d", name)) or 0)
    row = number // 6
    return MAP_SPACING_M * (number % 6), MAP_SPACING_M * (-1 - row if game.endswith("1") else row)


def _named(scenario: str) -> tuple[str, tuple[str, ...]]:
    """(scenario, maps): "freedoom2/MAP01,MAP02" -> ("freedoom2", ("MAP01", "MAP02")); a ViZDoom scenario has no maps."""
    name, _, maps = scenario.partition("/")
    return name, tuple(part.strip().upper() for part in maps.split(",") if part.strip())


@cache
def _settings_folder(process: int) -> tempfile.TemporaryDirectory[str]:
    """Where ViZDoom writes its settings: a folder for each process, which goes when that ends."""
    return tempfile.TemporaryDirectory(prefix=f"terrella-vizdoom-{process}-", ignore_cleanup_errors=True)


def _open_game(
    config: DoomConfig, scenario: str, maps: tuple[str, ...]
) -> tuple[vizdoom.DoomGame, tuple[str, ...], bool]:
    """(the running game, its buttons, whether it has the player's health)."""
    _check_scenario(config, scenario, maps)
    game = vizdoom.DoomGame()
    game.load_config(str(Path(vizdoom.scenarios_path) / f"{scenario}.cfg"))
    button, variable = vizdoom.Button, vizdoom.GameVariable
    more = [name for name in MORE_BUTTONS if getattr(button, name) in game.get_available_buttons()]
    alive = bool(maps) or variable.HEALTH in game.get_available_game_variables()
    buttons = (*BUTTONS, *more)
    game.set_doom_config_path(os.path.join(_settings_folder(os.getpid()).name, "settings.ini"))
    game.set_mode(vizdoom.Mode.PLAYER)
    game.set_screen_resolution(vizdoom.ScreenResolution.RES_512X384)
    game.set_screen_format(vizdoom.ScreenFormat.RGB24)
    game.set_labels_buffer_enabled(alive)
    for what, on in SWITCHES.items():
        getattr(game, f"set_{what}")(on)
    game.set_available_buttons([getattr(button, name) for name in buttons])
    game.set_available_game_variables(
        [variable.POSITION_X, variable.POSITION_Y, variable.CAMERA_POSITION_Z, variable.ANGLE, variable.HEALTH]
    )
    if maps:
        game.set_doom_map(maps[0])
        game.set_doom_skill(3)
        game.set_objects_info_enabled(True)
        game.set_kill_reward(1.0)
        game.set_death_penalty(1.0)
    if config.skill is not None:
        game.set_doom_skill(config.skill)
    game.add_game_args("+movebob 0")  # no head bobbing, whose phase would be hidden state
    game.set_episode_timeout(config.timeout_tics)
    _begin(game, scenario)
    return game, buttons, alive


def _check_scenario(config: DoomConfig, scenario: str, maps: tuple[str, ...]) -> None:
    """TerrellaError for a scenario, map or skill that ViZDoom does not have."""
    if config.skill is not None and not 1 <= config.skill <= 5:
        raise TerrellaError(f"Doom's skill goes from 1 (easy) to 5 (nightmare); got {config.skill}.")
    games = sorted(path.stem for path in Path(vizdoom.__file__).parent.glob("freedoom*.wad"))
    known = sorted(path.stem for path in Path(vizdoom.scenarios_path).glob("*.cfg"))
    if scenario not in known:
        raise TerrellaError(f"ViZDoom has no scenario '{scenario}'; it has {', '.join(known)}.")
    if maps or scenario in games:
        have = map_names(Path(vizdoom.__file__).parent / f"{scenario}.wad") if scenario in games else []
        if not have:
            raise TerrellaError(f"'{scenario}' has no maps to choose from; games with maps are {', '.join(games)}.")
        if not maps or set(maps) - set(have):
            wrong = ", ".join(sorted(set(maps) - set(have))) or "none is named"
            example = f"{scenario}/{have[0]} or {scenario}/{have[0]},{have[1]}"
            raise TerrellaError(f"{scenario} has the maps {have[0]} to {have[-1]} ({wrong}); give {example}.")


def _begin(game: vizdoom.DoomGame, scenario: str) -> None:
    """Starts the process, and removes the empty folder for saved games that ViZDoom makes in the working directory."""
    saves = Path("_vizdoom")
    existed = saves.exists()
    try:
        game.init()
    except vizdoom.FileDoesNotExistException as error:
        raise TerrellaError(
            f"{scenario} needs a file that ViZDoom does not include ({error}); choose another."
        ) from error
    finally:
        if not existed:
            with contextlib.suppress(OSError):
                saves.rmdir()


def _wad(game: vizdoom.DoomGame) -> Path:
    """The WAD with the map: the scenario's, or the game's."""
    own = Path(game.get_doom_scenario_path())
    return own if own.is_file() else Path(game.get_doom_game_path())


def _any_of(mask: np.ndarray, count: int, axis: int) -> np.ndarray:
    """Reduces `axis` of a bool array to length `count` by any()."""
    return np.logical_or.reduceat(mask, np.arange(count) * mask.shape[axis] // count, axis)


def _with_sprites(exact: np.ndarray, buffer: np.ndarray) -> np.ndarray:
    """Depth in map units, from the 8-bit buffer where that is clearly nearer than the map (a sprite)."""
    level = _sampled(buffer, exact.shape).astype(np.float32)
    coarse = (level + 0.5 - _BUFFER_OFFSET) / _BUFFER_SLOPE
    return np.where((coarse < exact * 0.85 - 16) & (level > 1), coarse, exact)


def _sampled(buffer: np.ndarray, size: tuple[int, ...]) -> np.ndarray:
    """[H, W] -> [h, w], the value at the centre of each pixel."""
    rows = (np.arange(size[0]) * 2 + 1) * buffer.shape[0] // (2 * size[0])
    columns = (np.arange(size[1]) * 2 + 1) * buffer.shape[1] // (2 * size[1])
    return buffer[np.ix_(rows, columns)]
