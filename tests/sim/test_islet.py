"""Islet-v0, our own game: a seed says all, walls hold, found stars stay away, and the picture scrolls by whole pixels."""

from __future__ import annotations

import gymnasium
import numpy as np
import torch

from terrella.cli import main
from terrella.core import check_world, make_rng
from terrella.library import load
from terrella.sim import islet, islet_art
from terrella.sim.islet import SPEED, STRIP, Islet, reachable, swing

NOOP, UP, DOWN, LEFT, RIGHT = range(5)


def at(x: int, y: int, facing: int = DOWN) -> Islet:
    env = Islet("rgb_array")
    env.reset(seed=0)
    env.x, env.y, env.facing, env.moving = x, y, facing, False
    env.trail, env.stars_left = [x, y] * (len(env.trail) // 2), np.zeros(len(islet_art.STARS), np.bool_)
    return env


def life(seed: int) -> list[bytes]:
    env, rng = Islet(), np.random.default_rng(1)
    return [env.reset(seed=seed)[0].tobytes()] + [env.step(rng.integers(5))[0].tobytes() for _ in range(60)]


def test_it_is_a_gymnasium_environment_with_few_colours():
    env = gymnasium.make("terrella.sim.islet:Islet-v0", render_mode="rgb_array")
    seen, _ = env.reset(seed=3)
    assert env.observation_space.contains(seen) and np.array_equal(seen, env.render())
    assert env.spec.max_episode_steps == 1500 and len(islet_art.PALETTE) <= 33
    for _ in range(20):
        seen, reward, terminated, truncated, _ = env.step(env.action_space.sample())
        assert env.observation_space.contains(seen) and not terminated and not truncated


def test_the_seed_says_all_and_starts_differ():
    assert life(5) == life(5) and life(5)[0] != life(6)[0]


def test_walls_hold_and_every_place_and_star_can_be_reached():
    env, rng, action = at(160, 140), np.random.default_rng(0), 0
    for step in range(400):
        action = int(rng.integers(5)) if step % 15 == 0 else action
        env.step(action)
        assert reachable()[env.y // SPEED, env.x // SPEED] and env.x % SPEED == env.y % SPEED == 0
    free = islet._standable()[::SPEED, ::SPEED]
    assert np.array_equal(free, reachable()) and free.mean() > 0.3
    rows, columns = np.nonzero(free)
    for x, y in islet_art.STARS:
        assert ((abs(columns * SPEED - x) <= 6) & (abs(rows * SPEED - y) <= 6)).any()
    hut = at(islet_art.HUT[0], islet_art.HUT[1] + 6, UP)
    for _ in range(9):
        hut.step(UP)
    assert hut.y > islet_art.HUT[1] and not hut.moving


def test_the_picture_scrolls_by_two_pixels_and_stands_at_the_borders():
    env = at(160, 150)  # on the way south, where nobody else is
    before, after = env.render(), env.step(DOWN)[0]
    ground = np.s_[STRIP : STRIP + 20, :30]
    assert np.array_equal(before[STRIP + SPEED :][:20, :30], after[ground])
    assert np.array_equal(before[:STRIP], after[:STRIP])
    west = at(34, 140)
    before, after = west.render(), west.step(LEFT)[0]
    assert west.x == 32 and np.array_equal(before[ground], after[ground])


def test_the_cat_follows_and_who_is_behind_the_hut_is_hidden():
    env = at(160, 150)
    for _ in range(12):
        env.step(DOWN)
    assert env.trail[:2] == [160, env.y - SPEED * 8] and env.moving
    x, y = 150, islet_art.HUT[1] - 8
    hidden, away = at(x, y).render(), at(x, y + 40).render()
    coat = islet_art.PALETTE[islet_art.LETTERS.index("u")]
    assert (away[STRIP:, 40:56] == coat).all(2).sum() > 5 + (hidden[STRIP:, 40:56] == coat).all(2).sum()


def test_others_move_while_the_walker_stands():
    pond = at(204, 128)
    frames = np.stack([pond.step(NOOP)[0] for _ in range(8)])
    changes = (frames[1:] != frames[:-1]).any(3)
    assert changes.any((1, 2)).all() and changes.mean() < 0.1


def test_it_goes_to_and_fro_and_rests():
    assert [swing(clock, 3, 5) for clock in range(5)] == [(3, 0, 0), (4, 0, 0), (5, 1, 0), (4, 1, 0), (3, 0, 0)]
    assert [swing(clock, 3, 5, 2)[::2] for clock in range(5)] == [(3, 0), (4, 0), (5, 1), (5, 1), (5, 0)]


def test_a_star_is_found_once_and_lights_up():
    x, y = islet_art.STARS[5]
    env = at(x, y - 12)
    env.stars_left[5:7] = True
    dark = env.render()
    rewards = [env.step(action)[1] for action in (DOWN, DOWN, DOWN, DOWN, UP, UP, DOWN, DOWN)]
    assert sum(rewards) == 1 and env.stars_left.tolist()[5:7] == [False, True]
    assert not np.array_equal(env.render()[:STRIP], dark[:STRIP])
    env.x, env.y = islet_art.STARS[6]
    assert env.step(NOOP)[1:3] == (1.0, True)


def test_as_a_world_it_keeps_every_law_and_forks():
    world, rng = load("gym:Islet-v0"), make_rng(0)
    assert world.spec.forkable and world.spec.max_episode_steps == 1500
    assert check_world(world)
    state = world.start(2, rng)
    state = world.imagine(state, torch.tensor([1, 4]), rng)
    assert world.render(state, ("rgb",))["rgb"].shape == (2, 80, 96, 3)


def test_record_takes_all_from_the_environment(tmp_path, capsys):
    assert main(["record", "world", "gym:Islet-v0", "--out", str(tmp_path / "set"), "--frames", "60"]) == 0
    said = "".join(capsys.readouterr())
    assert "pictures of 80x96" in said and "15 steps a second (its render_fps); episodes of up to 1,500" in said
    assert "noop, up, down, left, right (get_action_meanings); at rest: noop" in said
    assert "ArrowUp up" in said and "KeyD right" in said and "(get_keys_to_action)" in said
