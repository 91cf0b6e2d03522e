"""Two balls that bounce by chance: does a learned world keep both, and do they go each way as often as in truth?

    terrella record world gym:lab.bouncing_balls:BouncingBalls-v0 --frames 20000 --out recordings/balls
    terrella train video recordings/balls --out runs/balls --hours 0.5
    python -m lab.bouncing_balls runs/balls

The game, 64 x 64 pixels: two white balls of 3 x 3, and a paddle that shows the action. At floor and ceiling a ball's sideways speed
is drawn anew, of -2, -1, 1 and 2 pixels a step. Counted in rollouts: pictures with two balls, and of clear bounces the part of each
sideways speed, beside the game's own, with 95% intervals (Wilson).
"""

import sys

import gymnasium
import numpy as np
import torch
from scipy.ndimage import center_of_mass, label

import terrella
from terrella.core import make_rng
from terrella.measure.statistics import wilson

SIZE, SPEEDS = 64, (-2, -1, 1, 2)
TOP, FLOOR, LEFT, RIGHT = 8, 52, 6, 57  # of a ball's middle
EPISODES, SHOWN, STEPS = 32, 4, 200


class BouncingBalls(gymnasium.Env):
    """Nothing ends it, and nothing is won."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 15}
    observation_space = gymnasium.spaces.Box(0, 255, (SIZE, SIZE, 3), np.uint8)
    action_space = gymnasium.spaces.Discrete(3)
    render_mode = "rgb_array"

    def __init__(self, render_mode: str = "rgb_array"):
        self.paddle, self.place, self.speed = 0, np.zeros((2, 2)), np.zeros((2, 2))

    def get_action_meanings(self) -> list[str]:
        return ["NOOP", "LEFT", "RIGHT"]

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.paddle, self.place = 30, self.np_random.uniform(12, 50, (2, 2))
        down, across = self.np_random.choice([-2.0, 2.0], 2), self.np_random.choice(SPEEDS, 2)
        self.speed = np.stack([down, across], 1).astype(float)
        return self.render(), {}

    def step(self, action):
        self.paddle = int(np.clip(self.paddle + (0, -2, 2)[int(action)], 4, 51))
        self.place += self.speed
        for place, speed in zip(self.place, self.speed):
            if not TOP <= place[0] <= FLOOR:
                place[0] = np.clip(place[0], TOP, FLOOR)
                speed[:] = -speed[0], self.np_random.choice(SPEEDS)
            if not LEFT <= place[1] <= RIGHT:
                place[1] = np.clip(place[1], LEFT, RIGHT)
                speed[1] *= -1
        return self.render(), 0.0, False, False, {}

    def render(self):
        picture = np.full((SIZE, SIZE, 3), (20, 24, 48), np.uint8)
        picture[:6] = picture[60:] = picture[:, :4] = picture[:, 60:] = (90, 90, 110)
        picture[56:59, self.paddle : self.paddle + 9] = (230, 160, 60)
        for y, x in self.place.round().astype(int):
            picture[y - 1 : y + 2, x - 1 : x + 2] = 255
        return picture


gymnasium.register("BouncingBalls-v0", BouncingBalls, max_episode_steps=400)


def balls(picture: np.ndarray) -> np.ndarray:
    """Places y, x of the white areas of 4 pixels or more: [n, 2]; one of two balls' size counts twice."""
    areas, count = label(picture.min(-1) > 150)
    numbers = [number for number in range(1, count + 1) if (areas == number).sum() >= 4]
    twice = [number for number in numbers for _ in range(1 + ((areas == number).sum() > 12))]
    return np.array(center_of_mass(areas > 0, areas, twice)).reshape(-1, 2)


def rollouts(world) -> np.ndarray:
    """Pictures uint8 [EPISODES, STEPS, H, W, 3] of a world of this game that is shown the game's first pictures."""
    game, rng, chance = BouncingBalls(), make_rng(0), np.random.default_rng(0)
    frames = np.stack([_first(game, seed) for seed in range(EPISODES)])
    state, drawn = world.observe({"rgb": torch.from_numpy(frames[:, 0])}, None, rng), []
    for step in range(1, SHOWN + STEPS):
        action = torch.zeros(EPISODES, dtype=torch.int64)
        if step >= SHOWN:
            action = torch.from_numpy(chance.integers(0, 3, EPISODES))
        state = world.imagine(state, action, rng)
        if step < SHOWN:
            state = world.observe({"rgb": torch.from_numpy(frames[:, step])}, state, rng)
        else:
            drawn.append(world.render(state, ("rgb",))["rgb"].numpy())
    return np.stack(drawn, 1)


def truth() -> np.ndarray:
    """The same of the game."""
    made = []
    for seed in range(EPISODES):
        game, chance = BouncingBalls(), np.random.default_rng(seed)
        game.reset(seed=seed)
        made.append([game.step(int(chance.integers(3)))[0] for _ in range(STEPS)])
    return np.array(made)


def _first(game: BouncingBalls, seed: int) -> np.ndarray:
    first, _ = game.reset(seed=seed)
    return np.stack([first, *(game.step(0)[0] for _ in range(SHOWN - 1))])


def bounces(places: list[np.ndarray]) -> list[int]:
    """Sideways speeds after clear bounces in a rollout: of a ball near floor or ceiling that, 3 steps on, has moved away by 4 to 8
    pixels, and sideways by about 3 times a speed."""
    speeds = []
    for now, after in zip(places, places[3:]):
        for y, x in now:
            if len(now) != 2 or len(after) != 2 or abs(y - TOP) > 1 and abs(y - FLOOR) > 1 or not 14 < x < 48:
                continue
            away = np.abs(after - (y, x))
            ball = int(np.argmin(away.sum(1)))
            across = (after[ball, 1] - x) / 3
            nearest = min(SPEEDS, key=lambda speed: abs(speed - across))
            if 4 <= away[ball, 0] <= 8 and abs(nearest - across) < 0.34:
                speeds.append(nearest)
    return speeds


def report(name: str, pictures: np.ndarray) -> None:
    places = [[balls(picture) for picture in rollout] for rollout in pictures]
    parts = []
    for step in (1, 8, 32, 64, 128):
        right = sum(len(rollout[step - 1]) == 2 for rollout in places)
        parts.append(f"{step}: {right}/{len(places)}")
    speeds = [speed for rollout in places for speed in bounces(rollout)]
    print(f"{name}: two balls after " + ", ".join(parts))
    for speed in SPEEDS:
        part = wilson(speeds.count(speed), max(1, len(speeds)))
        print(f"  sideways {speed:+d}: {speeds.count(speed)} of {len(speeds)} [{part.low:.2f}, {part.high:.2f}]")


if __name__ == "__main__":
    report("truth", truth())
    for path in sys.argv[1:]:
        report(path, rollouts(terrella.load(path)))
