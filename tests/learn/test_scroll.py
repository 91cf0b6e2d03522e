"""The scroll of a made-up game, in which two buttons move a camera over a map, is learned from its pictures."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import torch
from tests.learn.stopping import goes_on_exactly, quiet

from terrella.core import make_rng
from terrella.learn.objectives import scroll as stage
from terrella.learn.objectives.scroll import ScrollObjective, learn_scroll
from terrella.learn.recording import Recording
from terrella.learn.trainer import Run
from terrella.worlds.scroll import Scroll, least_off

SIZE, SLOTS = (32, 40), 3
MOVES = torch.tensor([[0, 0], [2, 0], [-2, 0]])


def walks(step: int = 2, length: int = 600) -> Recording:
    """Buttons left and right move the view over a map by `step` pixels, a status line stands still; four episodes."""
    rng = np.random.default_rng(0)
    whole = rng.integers(0, 256, (SIZE[0], 400, 3), dtype=np.uint8)
    rgb, action, x, held = np.zeros((length, *SIZE, 3), np.uint8), np.zeros((length, 2), np.float32), 180, 0
    for row in range(length):
        if row % 150 == 0:
            x = 180
        rgb[row], rgb[row, :6] = whole[:, x : x + SIZE[1]], 90
        if row % 2 == 0:
            held = int(rng.integers(0, 3))
        action[row, :] = held == 1, held == 2
        x = int(np.clip(x + step * (held == 2) - step * (held == 1), 0, 360))
    facts = {"rgb": rgb, "action": action, "action_valid": np.ones(length, bool), "length": length}
    return Recording(SimpleNamespace(**facts), np.arange(length) // 150 * 150, np.ones(length, bool))  # type: ignore[arg-type]


def scroll() -> Scroll:
    torch.manual_seed(0)
    return Scroll(SIZE, SLOTS, 36 + 2 * SLOTS, len(MOVES) - 1)


def test_what_a_button_does_to_the_picture_is_learned(tmp_path, monkeypatch):
    monkeypatch.setattr(stage, "STEPS", 200)
    made, seen = scroll(), walks()
    learn_scroll(Run(tmp_path, {}, quiet), made, seen, MOVES, SLOTS)
    objective = ScrollObjective(made, seen, MOVES, SLOTS)
    piece = objective.clips_at(objective.rows[::7])
    went = piece.explained[:, : SLOTS - 1].flip(1)
    with torch.no_grad():
        guess = least_off(made(made.frame_features(piece.frames[:, 0]), piece.context[:, 0], went), MOVES)
    right = guess == piece.explained[:, SLOTS - 1].argmax(1)
    assert right.float().mean() > 0.85, "going on as before would be right in two of three"


def test_a_stopped_one_goes_on_exactly(tmp_path, monkeypatch):
    monkeypatch.setattr(stage, "STEPS", 6)
    seen = walks(length=300)
    goes_on_exactly(
        lambda out: learn_scroll(Run(out, {}, quiet), scroll(), seen, MOVES, SLOTS),
        tmp_path / "whole", tmp_path / "cut", {"scroll": 2},
    )  # fmt: skip


def test_a_game_that_never_scrolls_is_not_learned_from(tmp_path):
    made = scroll()
    before = {name: weight.clone() for name, weight in made.state_dict().items()}
    learn_scroll(Run(tmp_path, {}, quiet), made, walks(step=0), MOVES, SLOTS)
    assert all(torch.equal(weight, before[name]) for name, weight in made.state_dict().items())
    frames = torch.randint(0, 256, (2, 3, *SIZE), dtype=torch.uint8, generator=make_rng(0))
    went = torch.rand(2, SLOTS - 1, len(MOVES), generator=make_rng(1))
    assert not least_off(made(made.frame_features(frames), torch.zeros(2, 36 + 2 * SLOTS), went), MOVES).any()


def test_in_doubt_the_picture_goes_the_middle_way():
    moves = torch.tensor([[0, 0], [4, 0], [2, 0], [-3, 0]])
    odds = torch.tensor([[0.1, 0.4, 0.45, 0.05], [0.35, 0.45, 0.1, 0.1], [0.7, 0.3, 0.0, 0.0]])
    assert least_off(odds.log(), moves).tolist() == [2, 2, 0]
