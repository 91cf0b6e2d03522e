"""Islet-v0: our own small game, a scrolling island with stars to collect. `terrella play gym:Islet-v0`"""

from functools import cache
from typing import ClassVar

import gymnasium
import numpy as np
from gymnasium import spaces

from .islet_art import HEIGHT, HUT, LETTERS, MILL, PALETTE, PEN, POND, STARS, WIDTH, paint

VIEW = (72, 96)  # rows and columns of the visible map
STRIP = 8  # rows of night sky above them
SPEED = 2  # pixels per step
_ACTIONS = ("noop", "up", "down", "left", "right")
_DIRECTIONS = ((0, 0), (0, -1), (0, 1), (-1, 0), (1, 0))
_CAT_DELAY = 8  # steps by which the cat follows


class Islet(gymnasium.Env):
    """The walker moves two pixels per step, and the picture scrolls with it; other things move on fixed paths. There are fifteen
    stars (reward 1 each), which then light up in the sky; the last one terminates the episode. The island is fixed; the seed draws
    the start and the phase of the moving things. Observation: uint8 [80, 96, 3]. Action: noop, up, down, left, right."""

    metadata: ClassVar[dict] = {"render_modes": ["rgb_array"], "render_fps": 15}
    action_space = spaces.Discrete(len(_ACTIONS))
    observation_space = spaces.Box(0, 255, (STRIP + VIEW[0], VIEW[1], 3), np.uint8)

    def __init__(self, render_mode: str | None = None):
        self.render_mode = render_mode
        self.x = self.y = self.facing = self.clock = 0
        self.moving = False
        self.trail = [0] * (2 * _CAT_DELAY)  # previous positions of the walker, oldest first: x, y, x, y, …
        self.stars_left = np.ones(len(STARS), np.bool_)

    def get_action_meanings(self) -> list[str]:
        return list(_ACTIONS)

    def get_keys_to_action(self) -> dict[tuple[int, ...], int]:
        arrows = dict(zip((1073741906, 1073741905, 1073741904, 1073741903), range(1, 5)))  # as pygame numbers them
        return {(key,): action for key, action in (arrows | dict(zip(map(ord, "wsad"), range(1, 5)))).items()}

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        super().reset(seed=seed, options=options)
        places = np.argwhere(reachable())
        row, column = places[self.np_random.integers(len(places))]
        self.x, self.y, self.clock = 2 * int(column), 2 * int(row), int(self.np_random.integers(10_000))
        self.stars_left = np.ones(len(STARS), np.bool_)
        self.trail = [self.x, self.y] * _CAT_DELAY
        first = int(self.np_random.integers(1, 5))
        for _ in range(_CAT_DELAY):  # so that the trail is filled
            self._walk(first)
        self.moving = False
        self._collect()
        return self.render(), {}

    def step(self, action):
        self.clock += 1
        self._walk(int(action))
        collected = self._collect()
        return self.render(), float(collected), not self.stars_left.any(), False, {}

    def _walk(self, action: int) -> None:
        across, down = _DIRECTIONS[action]
        x, y = self.x + SPEED * across, self.y + SPEED * down
        self.facing = action or self.facing
        self.moving = bool(action) and bool(_standable()[y, x])
        if self.moving:
            self.trail = [*self.trail[2:], self.x, self.y]
            self.x, self.y = x, y

    def _collect(self) -> int:
        near = self.stars_left & (np.abs(np.array(STARS) - (self.x, self.y)) <= (6, 6)).all(1)
        self.stars_left = self.stars_left & ~near
        return int(near.sum())

    def render(self) -> np.ndarray:  # pyright: ignore[reportIncompatibleMethodOverride]
        """uint8 [80, 96, 3]."""
        high, wide = VIEW
        left = min(max(self.x - wide // 2, 0), WIDTH - wide)
        top = min(max(self.y - 6 - high // 2, 0), HEIGHT - high)
        art, picture = paint(), np.empty((STRIP + high, wide), np.uint8)
        picture[:STRIP] = _skies()[len(STARS) - int(self.stars_left.sum())]
        picture[STRIP:] = art.ground[top : top + high, left : left + wide]
        for y, x, sprite, rise in sorted(self._sprites(), key=lambda one: one[0]):
            rows, columns = sprite.shape
            up, aside = y - rise - rows + 1 - top, x - columns // 2 - left
            if -rows < up < high and -columns < aside < wide:
                part = sprite[max(-up, 0) : high - up, max(-aside, 0) : wide - aside]
                up, aside = max(up, 0), max(aside, 0)
                place = np.s_[up : up + part.shape[0], aside : aside + part.shape[1]]
                here = (part > 0) & (art.base[top : top + high, left : left + wide][place] <= y)
                np.copyto(picture[STRIP:][place], part, where=here)
        return PALETTE.take(picture, 0, mode="clip")

    def _sprites(self) -> list[tuple[int, int, np.ndarray, int]]:
        """(row and column of the foot, sprite, pixels above the ground) of everything that moves or vanishes."""
        sprites, clock = paint().sprites, self.clock
        side = max(self.facing - 2, 0)  # of the walker: front, back, left, right
        view = sprites["walker"][(0, 1, 0, 2, 2)[self.facing]]
        stride = 1 + (self.x + self.y) // 4 % 2 if self.moving else 0
        x, y = self.trail[:2]
        cat = sprites["cat"][1 + (x + y) // 4 % 2 if self.moving else 0][int(x > self.x)]
        things = [(y, x, cat, 0), (self.y, self.x, view[stride][side % 2], 0)]
        things += [(y, x, sprites["star"][0], 0) for (x, y), left in zip(STARS, self.stars_left.tolist()) if left]
        pond, row = POND[0], POND[1]
        for kind, y, delay, reach in (("duck", row, 0, 18), ("duckling", row + 2, 10, 18), ("duckling", row + 3, 17, 18),
                                      ("duck", row + 9, 40, 12)):  # fmt: skip
            x, back, _ = swing(clock - delay, pond - reach, pond + reach)
            things.append((y, x, sprites[kind][back], 0))
        for y, delay in ((PEN[1] + 13, 0), (PEN[3] - 6, 47)):
            x, back, rests = swing(clock + delay, PEN[0] + 9, PEN[2] - 8, 30)
            things.append((y, x, sprites["sheep"][rests][back], 0))
        for x, y, delay in ((140, 184, 0), (176, 190, 31), (250, 102, 12)):
            across, down = swing(clock + delay, -14, 14)[0], swing(clock + delay, -6, 6)[0]
            things.append((y + down + 8, x + across, sprites["butterfly"][clock // 3 % 2], 8))
        x, back, _ = swing(clock, 60, 260)
        things.append((236, x, sprites["boat"][back], 0))
        things += [(HUT[1] + 1, HUT[0] + 6, sprites["puff"][0], 24 + (clock + at) % 14) for at in (0, 7)]
        things.append((MILL[1] + 1, MILL[0], sprites["sails"][clock // 3 % 4], 5))
        return things


def swing(clock: int, low: int, high: int, rest: int = 0) -> tuple[int, int, int]:
    """A back-and-forth motion between two pixels, one per step, with a rest at each end: (position, moving back, resting)."""
    span = high - low
    at = clock % (2 * (span + rest))
    back, at = divmod(at, span + rest)
    return (high - min(at, span) if back else low + min(at, span)), back, int(at >= span and rest > 0)


@cache
def _standable() -> np.ndarray:
    """Bool [HEIGHT, WIDTH]: positions where the walker's foot, 6 x 3 pixels, is on free ground."""
    blocked = np.pad(paint().blocked, 4, constant_values=True)
    rows, columns = range(2, 5), range(1, 7)
    return ~np.any([blocked[r : r + HEIGHT, c : c + WIDTH] for r in rows for c in columns], axis=0)


@cache
def reachable() -> np.ndarray:
    """Bool [HEIGHT / 2, WIDTH / 2]: the positions, two pixels apart, that can be reached from the crossing by the hut."""
    free = _standable()[::SPEED, ::SPEED]
    mask = np.zeros_like(free)
    mask[70, 80], before = True, 0
    while mask.sum() > before:
        before = mask.sum()
        mask[1:] |= mask[:-1]
        mask[:-1] |= mask[1:]
        mask &= free
        mask[:, 1:] |= mask[:, :-1]
        mask[:, :-1] |= mask[:, 1:]
        mask &= free
    return mask


@cache
def _skies() -> np.ndarray:
    """Palette indices [stars + 1, STRIP, columns]: the sky with each number of lit stars."""
    skies = np.full((len(STARS) + 1, STRIP, VIEW[1]), LETTERS.index("N"), np.uint8)
    skies[:, -1] = LETTERS.index("k")
    lit = paint().sprites["lit"][0]
    for sky, count in zip(skies, range(len(STARS) + 1)):
        for at in range(len(STARS)):
            place = sky[1:6, 4 + 6 * at : 9 + 6 * at]
            if at < count:
                np.copyto(place, lit, where=lit > 0)
            else:
                place[[2, 1, 2, 2, 3], [2, 2, 1, 3, 2]] = LETTERS.index("M")
    return skies


gymnasium.register("Islet-v0", entry_point="terrella.sim.islet:Islet", max_episode_steps=1500)
