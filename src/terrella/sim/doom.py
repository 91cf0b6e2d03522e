"""ViZDoom as a World: the real game, with named buttons, exact depth and the camera's pose.

Doom's own depth buffer has 8 bits (about 7 map units a level), so depth is cast exactly from the map's sectors, and
the buffer is used only where it shows something nearer (a sprite). One metre is 32 map units, the usual reading.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
import vizdoom
from gymnasium import spaces

from ..core.errors import ObservationError, StaleStateError, TerrellaError
from ..core.spec import DONE, REWARD, Spec
from ..core.state import State

UNITS_PER_M = 32.0
TICS_PER_S = 35
MAX_DEPTH_M = 60.0
BUTTONS = ("MOVE_FORWARD", "MOVE_BACKWARD", "MOVE_LEFT", "MOVE_RIGHT", "TURN_LEFT", "TURN_RIGHT")
KEYS = {
    code: [float(name == button) for name in BUTTONS]
    for code, button in {
        "KeyW": "MOVE_FORWARD",
        "KeyS": "MOVE_BACKWARD",
        "KeyA": "MOVE_LEFT",
        "KeyD": "MOVE_RIGHT",
        "ArrowLeft": "TURN_LEFT",
        "ArrowRight": "TURN_RIGHT",
        "ArrowUp": "MOVE_FORWARD",
        "ArrowDown": "MOVE_BACKWARD",
    }.items()
}
# Horizontal field of view 90 degrees; Doom's pixels are 1.2 times as tall as wide, so fy/H = 0.5 * (4/3) * 1.2.
CAMERA = (0.5, 0.8, 0.5, 0.5)
_BUFFER_SLOPE, _BUFFER_OFFSET = 0.1395, -1.8  # 8-bit level = floor(slope * map units + offset), fitted on my_way_home


@dataclass(frozen=True)
class DoomConfig:
    """scenario: a ViZDoom scenario's name; size: rgb (height, width), 4:3; depth_size: likewise;
    timeout_tics: when an episode ends by itself, 0 for never."""

    scenario: str = "my_way_home"
    size: tuple[int, int] = (96, 128)
    depth_size: tuple[int, int] = (96, 128)
    timeout_tics: int = 0


class Doom:
    """The game as a World. One process, one story: not forkable, batch 1; a state is a ticket for the present."""

    def __init__(self, config: DoomConfig | None = None):
        self.config = config = config or DoomConfig()
        height, width = config.size
        if min(height, width) < 1 or 384 % height or 512 % width or 384 // height != 512 // width:
            raise TerrellaError(f"Doom renders at 384x512 divided by a whole number; size {height}x{width} is not.")
        self._shrink = 384 // height
        self._game = _open_game(config)
        self._walls = _Sectors(self._game.get_state().sectors)
        self._ticket = 0
        self._seen: dict[str, torch.Tensor] = {}
        self.spec = Spec(
            name=f"doom:{config.scenario}",
            action=spaces.MultiBinary(len(BUTTONS)),
            channels={
                "rgb": spaces.Box(0, 255, (height, width, 3), np.uint8),
                "depth": spaces.Box(0, MAX_DEPTH_M, config.depth_size, np.float32),
                "pose": spaces.Box(-np.inf, np.inf, (7,), np.float32),
                "reward": REWARD,
                "done": DONE,
            },
            observes=(),
            dt_s=1 / TICS_PER_S,
            units={"depth": "m", "pose": "m, quaternion wxyz of T_world_cam"},
            action_names=BUTTONS,
            keys=KEYS,
            camera=CAMERA,
            forkable=False,
            max_batch=1,
            card={"what": f"ViZDoom's {config.scenario} with Freedoom's art: the real game", "kind": "simulator"},
        )

    def start(self, batch: int, rng: torch.Generator) -> State:
        """A new episode; where the scenario has several spawn points, `rng` picks."""
        if batch != 1:
            raise TerrellaError(f"{self.spec.name} is one game process: start(1, rng), or open several.")
        self._game.set_seed(int(torch.randint(2**31 - 1, (1,), generator=rng).item()))
        self._game.new_episode()
        self._reward, self._done = 0.0, False
        return self._advance()

    def observe(self, observation: Mapping[str, torch.Tensor], prior: State | None, rng: torch.Generator) -> State:
        """A game cannot be put into a state from outside: evidence is ignored, the present (or a start) is returned."""
        if observation:
            raise ObservationError(f"{self.spec.name} is the real game and takes no evidence; call start(1, rng).")
        return prior if prior is not None else self.start(1, rng)

    def imagine(self, state: State, action: torch.Tensor, rng: torch.Generator) -> State:
        """One tic of the game. After `done` the game stands still."""
        buttons = self.spec.check_action(action, 1)
        self._check_present(state)
        if not self._done:
            self._reward = float(self._game.make_action(buttons[0].tolist(), 1))
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

    def _check_present(self, state: State) -> None:
        if int(state["ticket"][0]) != self._ticket:
            raise StaleStateError(
                f"{self.spec.name} has moved on since this state; it cannot go back (forkable=False)."
            )

    def _advance(self) -> State:
        self._ticket += 1
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
        if name == "rgb":
            return torch.from_numpy(_area_mean(self._present.screen_buffer, self._shrink))
        x, y, z, yaw_deg = (float(value) for value in np.asarray(self._present.game_variables))
        if name == "pose":
            half = np.deg2rad(yaw_deg) / 2
            here = np.array([x, y, z]) / UNITS_PER_M
            return torch.tensor([*here, np.cos(half), 0.0, 0.0, np.sin(half)], dtype=torch.float32)
        exact = self._walls.depth(x, y, z, np.deg2rad(yaw_deg), self.config.depth_size)
        depth_m = _with_sprites(exact, np.asarray(self._present.depth_buffer)) / UNITS_PER_M
        return torch.from_numpy(depth_m).float().clamp(0, MAX_DEPTH_M)


def _open_game(config: DoomConfig) -> vizdoom.DoomGame:
    scenario = os.path.join(vizdoom.scenarios_path, f"{config.scenario}.cfg")
    if not os.path.exists(scenario):
        known = sorted(name[:-4] for name in os.listdir(vizdoom.scenarios_path) if name.endswith(".cfg"))
        raise TerrellaError(f"ViZDoom has no scenario '{config.scenario}'; it has {', '.join(known)}.")
    game = vizdoom.DoomGame()
    game.load_config(scenario)
    game.set_doom_config_path(os.path.join(tempfile.gettempdir(), f"terrella-vizdoom-{os.getpid()}.ini"))
    game.set_window_visible(False)
    game.set_mode(vizdoom.Mode.PLAYER)
    game.set_screen_resolution(vizdoom.ScreenResolution.RES_512X384)
    game.set_screen_format(vizdoom.ScreenFormat.RGB24)
    game.set_depth_buffer_enabled(True)
    game.set_sectors_info_enabled(True)
    for switch in (game.set_render_hud, game.set_render_weapon, game.set_render_crosshair, game.set_render_messages):
        switch(False)
    variable = vizdoom.GameVariable
    game.set_available_buttons([getattr(vizdoom.Button, name) for name in BUTTONS])
    game.set_available_game_variables(
        [variable.POSITION_X, variable.POSITION_Y, variable.CAMERA_POSITION_Z, variable.ANGLE]
    )
    game.add_game_args("+movebob 0")  # the head does not bob: its phase would be a hidden state
    game.set_episode_timeout(config.timeout_tics)
    game.init()
    return game


def _area_mean(image: np.ndarray, shrink: int) -> np.ndarray:
    """uint8 [H, W, 3] -> uint8 [H / shrink, W / shrink, 3], each pixel the mean of its block."""
    rows = image[::shrink].astype(np.uint16)
    for offset in range(1, shrink):
        rows += image[offset::shrink]
    total = rows[:, ::shrink] + np.uint16(shrink * shrink // 2)
    for offset in range(1, shrink):
        total += rows[:, offset::shrink]
    return (total // np.uint16(shrink * shrink)).astype(np.uint8)


def _with_sprites(exact: np.ndarray, buffer: np.ndarray) -> np.ndarray:
    """Depth in map units; where the 8-bit buffer is clearly nearer than the map (a thing stands there), the buffer's."""
    rows = (np.arange(exact.shape[0]) * 2 + 1) * buffer.shape[0] // (2 * exact.shape[0])
    columns = (np.arange(exact.shape[1]) * 2 + 1) * buffer.shape[1] // (2 * exact.shape[1])
    level = buffer[np.ix_(rows, columns)].astype(np.float32)
    coarse = (level + 0.5 - _BUFFER_OFFSET) / _BUFFER_SLOPE
    return np.where((coarse < exact * 0.85 - 16) & (level > 1), coarse, exact)


class _Sectors:
    """The map as prisms; `depth` casts one ray a pixel through them."""

    def __init__(self, sectors):
        self.heights = [(sector.floor_height, sector.ceiling_height) for sector in sectors]
        lines = [np.array([(w.x1, w.y1, w.x2, w.y2) for w in sector.lines], np.float64) for sector in sectors]
        self.lines = np.concatenate(lines)
        self.owner = np.repeat(np.arange(len(lines)), [len(group) for group in lines])
        ends = [tuple(sorted([(x1, y1), (x2, y2)])) for x1, y1, x2, y2 in self.lines]
        self.solid = np.array([ends.count(pair) == 1 for pair in ends])  # a line of one sector only is a wall

    def depth(self, x: float, y: float, eye: float, yaw: float, size: tuple[int, int]) -> np.ndarray:
        """Depth along the optical axis, map units, float64 [H, W]; map coordinates, yaw in radians."""
        height, width = size
        right_slope = ((np.arange(width) + 0.5) / width - CAMERA[2]) / CAMERA[0]
        down_slope = ((np.arange(height) + 0.5) / height - CAMERA[3]) / CAMERA[1]
        forward, right = np.array([np.cos(yaw), np.sin(yaw)]), np.array([np.sin(yaw), -np.cos(yaw)])
        start, end = self.lines[:, :2] - (x, y), self.lines[:, 2:] - (x, y)
        near_f, near_r, far_f, far_r = start @ forward, start @ right, end @ forward, end @ right
        side_a = near_r - right_slope[:, None] * near_f  # [W, lines]; the ray crosses where the sign changes
        side_b = far_r - right_slope[:, None] * far_f
        share = side_a / np.where(side_a == side_b, 1.0, side_a - side_b)
        along = near_f + share * (far_f - near_f)
        crossing = np.where(((side_a > 0) != (side_b > 0)) & (along > 0), along, np.inf)
        slope = np.where(np.abs(down_slope) > 1e-9, down_slope, 1e-9)[:, None]
        wall = crossing[:, self.solid].min(1)
        best = np.broadcast_to(np.minimum(wall, MAX_DEPTH_M * UNITS_PER_M), (height, width))
        for sector, (floor, ceiling) in enumerate(self.heights):
            cuts = np.sort(crossing[:, self.owner == sector], axis=1)
            if not np.isfinite(cuts).any():
                continue
            inside = np.isfinite(cuts).sum(1) % 2 == 1  # an odd count: the eye is in this sector
            cuts = np.where(inside[:, None], np.pad(cuts, ((0, 0), (1, 0)))[:, :-1], cuts)
            cuts = np.pad(cuts, ((0, 0), (0, cuts.shape[1] % 2)), constant_values=np.inf)
            surface = np.where(slope > 0, (eye - floor) / slope, (eye - ceiling) / slope)  # floor below, ceiling above
            for enter, leave in zip(cuts[:, ::2].T, cuts[:, 1::2].T):
                if not np.isfinite(leave).any():
                    break
                hit = np.maximum(surface, enter)
                best = np.minimum(best, np.where(hit <= leave, hit, np.inf))
        return best
