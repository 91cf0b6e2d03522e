"""Codec: what stays is copied to the last bit, what moves is fetched, and a saved one is the same."""

from __future__ import annotations

import pytest
import torch

from terrella.core import check_world, make_rng
from terrella.worlds.codec import Codec, CodecConfig
from terrella.worlds.config import HistoryConfig
from terrella.worlds.controls import Controls
from terrella.worlds.folder import load_world, save_world
from terrella.worlds.generator import context_thumbnail
from terrella.worlds.history import FrameHistory, Starts
from terrella.worlds.learned import About, LearnedWorld

SIZE, SLOTS = (16, 24), 3
MOVES = torch.tensor([[0, 0], [2, 0], [0, -3]])


def codec(seed: int = 0, wild: bool = True) -> Codec:
    torch.manual_seed(seed)
    made = Codec(CodecConfig(SIZE, SLOTS, 36 + 2 * SLOTS, len(MOVES) - 1, 5, channels=(8, 8)))
    made.moves[:], made.palette[:] = MOVES, torch.arange(15).view(5, 3).to(torch.uint8) * 17
    if wild:
        for weight in (made.choice.weight, made.choice.bias):
            torch.nn.init.normal_(weight)
    return made


def pictures(batch: int, seed: int = 0) -> torch.Tensor:
    return torch.randint(0, 256, (batch, SLOTS, 3, *SIZE), dtype=torch.uint8, generator=make_rng(seed))


def world(generator: Codec) -> LearnedWorld:
    scene = FrameHistory(HistoryConfig(SIZE, SLOTS, 2), Starts.of(pictures(4), 2))
    return LearnedWorld(About("made", Controls.buttons(2), 0.1), scene=scene, generator=generator)


def test_it_keeps_the_contract():
    assert {"batches", "states_can_be_saved"} <= set(check_world(world(codec()), steps=3))


def test_an_untrained_one_stands_still_to_the_last_bit():
    still, rng = world(codec(wild=False)), make_rng(0)
    state = first = still.start(2, rng)
    for _ in range(50):
        state = still.imagine(state, torch.zeros(2, 2, dtype=torch.int8), rng)
    assert torch.equal(still.render(state, ("rgb",))["rgb"], still.render(first, ("rgb",))["rgb"])


def test_pixels_are_fetched_from_where_the_sources_say():
    frames, made = pictures(1), codec()
    height, width = SIZE
    for source in range(made.sources):
        fetched = made.pixels(frames, torch.full((1, *SIZE), source))
        for v, u in ((0, 0), (5, 7), (height - 1, width - 1)):
            slot = max(0, source - len(MOVES) + 1)
            x, y = MOVES[source].tolist() if slot == 0 else (0, 0)
            j, i = min(max(v - y, 0), height - 1), min(max(u - x, 0), width - 1)
            assert torch.equal(fetched[0, :, v, u], frames[0, slot, :, j, i]), (source, v, u)


def test_what_is_likelier_painted_has_a_colour_of_the_palette():
    made, frames = codec(), pictures(2)
    choices = torch.zeros(2, made.sources + 1, *SIZE)
    choices[:, 1] = 3.0
    choices[0, -1, :4] = 9.0
    drawn = made.fetched(frames, choices, torch.randn(2, 32, *SIZE, generator=make_rng(1)))
    colours = drawn[0, :, :4].flatten(1).T
    assert (colours[:, None] == made.palette).all(-1).any(1).all()
    there = made.pixels(frames, torch.ones(2, *SIZE, dtype=torch.int64))
    assert torch.equal(drawn[0, :, 4:], there[0, :, 4:]) and torch.equal(drawn[1], there[1])


def test_the_stress_on_what_changes_is_taken_back():
    made, frames = codec(), pictures(1)
    choices = torch.full((1, made.sources + 1, *SIZE), -9.0)
    choices[:, 0], choices[:, 1] = 0.0, 2.0
    features = torch.zeros(1, 32, *SIZE)
    moved = made.pixels(frames, torch.ones(1, *SIZE, dtype=torch.int64))
    assert torch.equal(made.fetched(frames, choices, features), moved)
    made.stress.fill_(16.0)
    assert torch.equal(made.fetched(frames, choices, features), frames[:, 0])


def test_a_saved_one_draws_the_same(tmp_path):
    one, frames = world(codec()), pictures(2, seed=3)
    one.generator.stress.fill_(3.0)
    save_world(one, tmp_path / "world")
    again = load_world(tmp_path / "world")
    context = torch.cat([context_thumbnail(frames[:, 0]), torch.zeros(2, 2 * SLOTS)], 1)
    move = torch.tensor([1, 0])
    for mine, other in zip(
        one.generator.choices(frames, context, move), again.generator.choices(frames, context, move)
    ):
        assert torch.equal(mine, other)
    assert (
        torch.equal(again.generator.moves, MOVES)
        and again.generator.stress == 3
        and again.generator.palette.dtype == torch.uint8
    )


@pytest.mark.parametrize("device", ["meta"])
def test_a_step_stays_on_its_device(device):
    there = world(codec()).to(device)
    state = there.imagine(there.start(2, make_rng(0)), torch.zeros(2, 2, dtype=torch.int8), make_rng(0))
    assert there.render(state, ("rgb",))["rgb"].device.type == device
