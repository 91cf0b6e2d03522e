"""The explorer of worlds that it knows nothing of: it finds out what does something, reaches far places, and can be told again."""

from __future__ import annotations

import numpy as np
import torch
from gymnasium import spaces

from terrella.act import Explorer
from terrella.core import Spec, make_rng
from terrella.core.policy import Random

LENGTH = 40


class Corridor:
    """A dot on a line of 40 places: of nine actions two move it, by one, and the others do nothing; falling off ends it."""

    spec = Spec("line", spaces.Discrete(9), {"rgb": spaces.Box(0, 255, (8, 80, 3), np.uint8)}, (), 0.1)

    def __init__(self):
        self.at = 3

    def step(self, action: int) -> bool:
        self.at += {4: 1, 7: -1}.get(action, 0)
        return not 0 <= self.at < LENGTH

    def seen(self) -> dict[str, torch.Tensor]:
        picture = torch.zeros(1, 8, 80, 3, dtype=torch.uint8)
        picture[0, 2:6, 2 * self.at : 2 * self.at + 2] = 255
        return {"rgb": picture}


def play(policy, steps: int, seed: int = 0) -> tuple[list[int], list[int]]:
    rng, line = make_rng(seed), Corridor()
    memory, actions, places = policy.begin(1, rng), [], []
    for _ in range(steps):
        places.append(line.at)
        action, memory = policy.act(line.seen(), memory, rng)
        actions.append(int(action[0]))
        if line.step(actions[-1]):
            line, memory = Corridor(), policy.begin(1, rng)
    return actions, places


def changes(places: list[int]) -> float:
    return float((np.diff(places) != 0).mean())


def test_it_finds_the_actions_that_do_something_and_goes_far():
    actions, places = play(Explorer(Corridor.spec), 2500)
    (_, held), (_, random) = (play(Random(Corridor.spec, hold), 2500) for hold in ((3, 40), (1, 1)))
    assert set(actions) == set(range(9)), "every action is tried"
    assert changes(places) > 1.5 * changes(held) and changes(places) > changes(random)
    assert len(set(places)) > 1.5 * len(set(random)) and max(places) > 30


def test_the_same_seed_plays_the_same_way_and_a_log_brings_it_back(tmp_path):
    once, again = (play(Explorer(Corridor.spec, tmp_path / name), 300)[0] for name in "ab")
    assert once == again != play(Explorer(Corridor.spec), 300, seed=1)[0]
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    recalled = Explorer(Corridor.spec, tmp_path / "a")
    recalled.recall(300)
    known = Explorer(Corridor.spec)
    play(known, 300)
    rng = make_rng(9)
    for each in (recalled, known):
        each.begin(1, rng)
    found, before = recalled._seeker.novelty, known._seeker.novelty
    assert found.visits == before.visits and np.array_equal(found.holds, before.holds)
    assert all(np.array_equal(found.values[0][cell], before.values[0][cell]) for cell in before.values[0])


def test_any_action_space_and_a_world_without_pictures():
    for action in (
        spaces.Box(-1, 1, (3,)),
        spaces.MultiBinary(4),
        spaces.MultiDiscrete([3, 2]),
        spaces.Discrete(2, start=5),
    ):
        spec = Spec("box", action, {"observation": spaces.Box(-1, 1, (2,), np.float32)}, (), 0.1)
        explorer, rng = Explorer(spec), make_rng(0)
        memory, taken = explorer.begin(2, rng), []
        for _ in range(60):
            chosen, memory = explorer.act({"observation": torch.rand(2, 2, generator=rng)}, memory, rng)
            taken.append(spec.check_action(chosen, 2))
        assert len(torch.cat(taken).unique(dim=0)) > 1
