"""FlowNetwork: untrained it keeps the last frame, noise decides a sample, and pictures are carried along."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch

from terrella.core import check_world, make_rng, precision
from terrella.core.errors import CheckpointError
from terrella.data import Layout
from terrella.space.ground import window
from terrella.space.mosaic import empty_mosaic, read_mosaic, update_mosaic
from terrella.space.recall import EMPTY, KEPT
from terrella.worlds.config import HistoryConfig
from terrella.worlds.controls import Controls
from terrella.worlds.flow import RECALLED, STAYS, FlowConfig, FlowNetwork
from terrella.worlds.folder import load_world, save_world
from terrella.worlds.frame_history import FrameHistory, StartClips, glimpse_of_frames
from terrella.worlds.generator import Conditioning, pixels
from terrella.worlds.learned import About, LearnedWorld

SIZE, SLOTS = (20, 28), 3  # sides that are no multiples of 16
MOVES = torch.tensor([[0, 0], [2, 0], [0, -3]])


def network(wild: bool = True, moves: int = 2, seed: int = 0, recalls: bool = False) -> FlowNetwork:
    torch.manual_seed(seed)
    made = (
        FlowNetwork(FlowConfig(SIZE, SLOTS, 36 + 2 * SLOTS, moves, (8, 16, 16), recalls=recalls, normed=True))
        .eval()
        .requires_grad_(False)
    )
    made.moves[:] = MOVES[: moves + 1]
    if wild:
        torch.nn.init.normal_(made.output.weight, std=0.3)
        for block in (*made.before, *made.after, made.drawn):
            torch.nn.init.normal_(block.second.weight, std=0.1)
    return made


def pictures(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randint(0, 256, (*shape, 3, *SIZE), dtype=torch.uint8, generator=make_rng(seed))


def shown(batch: int, **more) -> Conditioning:
    context = torch.randn(batch, 36 + 2 * SLOTS, generator=make_rng(1))
    return Conditioning(glimpse_of_frames(pictures(batch, SLOTS)), torch.zeros(batch, 4, *SIZE), context, **more)


def noise(batch: int, seed: int) -> torch.Tensor:
    return torch.randn(batch, 4, *SIZE, generator=make_rng(seed))


def world(generator: FlowNetwork, ground: torch.Tensor | None = None) -> LearnedWorld:
    starts = StartClips.of(pictures(4, SLOTS), 2)
    if ground is not None:
        frames = torch.stack([ground[:3, y : y + SIZE[0], x : x + SIZE[1]] for x, y in [(0, 0), (12, 6), (30, 18)]])
        starts = StartClips.of(frames[:, None].repeat(1, SLOTS, 1, 1, 1), 2)
    moves = tuple(map(tuple, generator.moves.tolist())) if generator.config.moves else ()
    scene = FrameHistory(HistoryConfig(SIZE, SLOTS, 2, moves, recalls=generator.config.recalls), starts, None, ground)
    return LearnedWorld(About("made", Controls.buttons(2), 0.1), scene=scene, generator=generator)


@pytest.mark.parametrize(("moves", "recalls"), [(0, False), (2, False), (0, True)])
def test_it_keeps_the_contract(moves, recalls):
    made = world(network(moves=moves, recalls=recalls))
    assert {"batches", "states_can_be_saved"} <= set(check_world(made, steps=3))


def test_maps_that_grow_do_not_make_pictures_grow():
    """In a training that went on for longer they grew until the last layers answered 0, or what is not a number."""
    made, seen = network(moves=0), shown(2)
    usual = made.draw(noise(2, 0), seen)
    made.after[3].second.weight.mul_(1e6)
    made.after[3].second.bias.mul_(1e6)
    grown = made.draw(noise(2, 0), seen)
    assert (grown[:, :3] - usual[:, :3]).abs().max() > 0.01, "they are seen"
    assert grown[:, :3].abs().max() < 2 * usual[:, :3].abs().max()


def test_a_frame_of_long_ago_changes_what_is_drawn_where_it_is_like_the_draft():
    """With one drawing step there is only the draft, which sees no memory."""
    made, rng = world(network(moves=0, recalls=True)), make_rng(0)
    seen = pictures(1, 8, seed=3)[0].permute(0, 2, 3, 1)
    action = torch.zeros(1, 2)
    state = made.observe({"rgb": seen[:1]}, None, rng)
    for picture in seen[1:]:
        state = made.observe({"rgb": picture[None]}, made.imagine(state, action, rng), rng)
    kept = state["kept"][0]
    assert torch.equal(kept[: 8 - SLOTS], seen[: 8 - SLOTS].flip(0).permute(0, 3, 1, 2)), "those that left the history"
    empty = state.replace(kept_keys=torch.full_like(state["kept_keys"], EMPTY))
    for steps, same in [(3, False), (1, True)]:
        drawer = made.replaced(steps=steps)
        one, other = (drawer.render(drawer.imagine(at, action, make_rng(1)), ("rgb",))["rgb"] for at in (state, empty))
        assert torch.equal(one, other) == same


def test_a_world_that_recalls_is_saved_and_read(tmp_path):
    made = world(network(moves=0, recalls=True))
    save_world(made, tmp_path)
    read = load_world(tmp_path)
    assert read.scene.config.recalls and read.generator.config.recalls
    assert read.start(1, make_rng(0))["kept"].shape == (1, KEPT, 3, *SIZE)


def test_untrained_the_last_frame_stays_to_the_last_bit():
    given = shown(2)
    drawn = network(wild=False).draw(noise(2, 0), given)
    assert torch.equal(pixels(drawn), pictures(2, SLOTS)[:, 0])


@pytest.mark.parametrize(("by", "stays"), [(0.9 * STAYS, True), (2 * STAYS, False)])
def test_a_change_too_small_to_see_is_no_change(by, stays):
    made = network(wild=False)
    made.output.bias += by
    after = pixels(made.draw(noise(1, 0), shown(1)))
    before = pictures(1, SLOTS)[:, 0]
    assert torch.equal(after, before) if stays else (after > before).float().mean() > 0.9


def test_the_draft_is_the_same_whatever_the_noise_and_a_sample_is_not():
    made, given = network(), shown(2)
    drafts = [made.draw(noise(2, seed), given, steps=1) for seed in (0, 1)]
    samples = [made.draw(noise(2, seed), given) for seed in (0, 1)]
    assert torch.equal(*drafts) and not torch.allclose(*samples, atol=0.01)


@pytest.mark.parametrize(("half", "apart"), [(False, 1e-4), (True, 0.03)])
def test_each_of_a_batch_is_drawn_alone(monkeypatch, half, apart):
    """Up to half precision, where a CPU has it."""
    monkeypatch.setattr(precision, "half_is_native", lambda device: half)
    made, given, chance = network(), shown(18), noise(18, 0)
    whole, alone = made.draw(chance, given)[17:], made.draw(chance[17:], given.at(slice(17, 18)))
    torch.testing.assert_close(whole, alone, rtol=1e-4, atol=apart)
    assert half == (not torch.allclose(whole, alone, rtol=1e-4, atol=1e-4))


def scrolled() -> tuple[Conditioning, torch.Tensor, torch.Tensor]:
    """A picture that is about to scroll by 2 to the right, a mosaic that knows what then enters, the next picture, and `over`."""
    wide = torch.randint(0, 256, (1, 3, SIZE[0], SIZE[1] + 2), dtype=torch.uint8, generator=make_rng(2))
    last, after = wide[..., 2:], wide[..., :-2]
    still, none = torch.zeros(1, 2, dtype=torch.int64), torch.zeros(SIZE, dtype=torch.bool)
    mosaic = update_mosaic(empty_mosaic(1, SIZE), after, still, none)
    mosaic = update_mosaic(mosaic, last, -MOVES[1:2], none)
    given = replace(shown(1, mosaic=mosaic), glimpse=glimpse_of_frames(last[:, None].repeat(1, SLOTS, 1, 1, 1)))
    return replace(given, scroll=torch.tensor([1])), last, after


def test_untrained_a_picture_goes_on_by_its_scroll_but_for_what_lies_over_it():
    made, (given, last, after) = network(wild=False), scrolled()
    made.over[:, :4] = True
    drawn = pixels(made.draw(noise(1, 0), given))
    assert torch.equal(drawn[..., :4], last[..., :4]), "it lies over the picture"
    assert torch.equal(drawn[..., 4:], after[..., 4:]), "what was under it is remembered"
    made.over[:] = False
    drawn = pixels(made.draw(noise(1, 0), given))
    assert torch.equal(drawn, after), "what enters is remembered"
    drawn = pixels(made.draw(noise(1, 0), replace(given, mosaic=empty_mosaic(1, SIZE))))
    assert torch.equal(drawn[..., 2:], after[..., 2:]) and torch.equal(drawn[..., 0], last[..., 0])


@pytest.mark.parametrize(("by", "recalled"), [(0.9 * RECALLED, True), (1.2 * RECALLED, False)])
def test_a_colour_near_the_remembered_one_is_as_remembered(by, recalled):
    made, (given, _, after) = network(wild=False), scrolled()
    made.output.bias += by
    drawn = pixels(made.draw(noise(1, 0), given))
    assert torch.equal(drawn, after) if recalled else (drawn > after).float().mean() > 0.9


def test_memory_shows_what_enters_and_not_what_lies_over_it(monkeypatch):
    made, (given, _, after), seen = network(wild=False), scrolled(), []
    made.over[:, :4] = True
    monkeypatch.setattr(made, "_remembered", lambda memory, base: seen.append(memory) or base.new_zeros(1, 4, *SIZE))
    made.draw(noise(1, 0), given)
    assert len(seen) == 1
    assert torch.equal(seen[0][:, :3, :, 4:], after[..., 4:]) and (seen[0][:, 3, :, 4:] > 0).all()
    assert not seen[0][..., :4].any()


def test_it_is_loaded_as_it_was_saved(tmp_path):
    ground = torch.randint(0, 256, (4, 48, 64), dtype=torch.uint8, generator=make_rng(3)).clamp_min(1)
    made = world(network(), ground)
    save_world(made, tmp_path / "world")
    loaded = load_world(tmp_path / "world")
    assert loaded.generator.config == made.generator.config and torch.equal(loaded.scene.ground, ground)
    frames = []
    for one in (made, loaded):
        state = one.observe({"rgb": pictures(2).permute(0, 2, 3, 1)}, None, make_rng(0))
        state = one.imagine(state, torch.tensor([[1, 0], [0, 1]], dtype=torch.int8), make_rng(1))
        frames.append(one.render(state, ("rgb",))["rgb"])
    assert (frames[0].int() - frames[1].int()).abs().max() <= 2, "weights are stored in half precision"


def test_a_world_of_an_earlier_release_says_how_it_is_learned_again(tmp_path):
    save_world(world(network()), tmp_path)
    about = json.loads((tmp_path / "world.json").read_text())
    about["parts"]["scene"]["config"]["fog_px"] = 12
    (tmp_path / "world.json").write_text(json.dumps(about))
    assert load_world(tmp_path).generator.kind == "flow", "a setting that is gone does no harm"
    about["parts"]["generator"] = {"kind": "codec", "config": {"size": SIZE, "colours": 64}}
    (tmp_path / "world.json").write_text(json.dumps(about))
    with pytest.raises(CheckpointError, match="is drawn by a codec, .* terrella train video RECORDING --out NEW"):
        load_world(tmp_path)


def scrolling_to(move: int) -> LearnedWorld:
    """A world whose pictures always go on by one of the moves."""
    made = network()
    made.scrolling.votes.bias.data = 99.0 * torch.nn.functional.one_hot(torch.tensor(move), len(MOVES)).float()
    return world(made)


def test_where_the_picture_scrolls_the_mosaic_is_shown_with_the_picture_in_its_middle():
    made, rng = scrolling_to(1), make_rng(0)
    state = made.imagine(made.start(2, rng), torch.zeros(2, 2, dtype=torch.int8), rng)
    seen, (height, width) = made.render(state, ("rgb", "mosaic")), SIZE
    assert seen["mosaic"].shape == (2, *made.spec.channels["mosaic"].shape)
    known = seen["mosaic"][..., 3] > 0
    top, left = (known.shape[1] - height) // 2, (known.shape[2] - width) // 2
    assert known[:, top : top + height, left : left + width].all() and not known.all()
    assert not seen["mosaic"][~known].any()
    assert "mosaic" not in Layout.of(made.spec).channels, "recordings do without it"


def test_a_mosaic_goes_on_as_the_picture_scrolls_though_it_is_too_plain_to_tell():
    made, rng = scrolling_to(1), make_rng(0)
    torch.nn.init.zeros_(made.generator.output.weight)
    plain = {"rgb": torch.full((2, *SIZE, 3), 90, dtype=torch.uint8)}
    state = made.observe(plain, None, rng)
    for _ in range(3):
        state = made.imagine(state, torch.zeros(2, 2, dtype=torch.int8), rng)
    seen = made.render(state, ("mosaic",))["mosaic"][..., 3] > 0
    assert seen.any(1).sum(1).tolist() == [SIZE[1] + 3 * 2] * 2
    state = made.observe(plain, state, rng)  # how evidence went on is seen in its pictures alone
    assert (made.render(state, ("mosaic",))["mosaic"][..., 3] > 0).any(1).sum(1).tolist() == [SIZE[1] + 2 * 2] * 2


def test_what_lies_over_what_scrolls_is_no_part_of_the_mosaic_but_of_the_map():
    made, rng = scrolling_to(0), make_rng(0)
    made.scene.over[:4] = True
    before = made.start(2, rng)
    state = made.imagine(before, torch.zeros(2, 2, dtype=torch.int8), rng)
    mosaic = made.look(state, before).mosaic
    assert mosaic is not None
    known = read_mosaic(mosaic, SIZE, torch.zeros(2, 2, dtype=torch.int64))[:, 3] > 0
    assert not known[:, :4].any() and known[:, 4:].all()
    seen = made.render(state, ("rgb", "mosaic"))
    top, left = ((whole - part) // 2 for whole, part in zip(seen["mosaic"].shape[1:3], SIZE))
    middle = seen["mosaic"][:, top : top + SIZE[0], left : left + SIZE[1]]
    assert torch.equal(middle[:, :4, :, :3], seen["rgb"][:, :4]) and (middle[..., 3] > 0).all()
    ground = state.replace(mosaic=torch.ones_like(state["mosaic"]))  # of colour 1, seen once
    beneath = made.render(ground, ("mosaic",))["mosaic"][:, top : top + 4, left : left + SIZE[1], :3]
    assert (beneath == 1).all(), "where the ground beneath is known, the map shows it"


@pytest.mark.parametrize("device", ["meta"])
def test_a_step_stays_on_its_device(device):
    there = world(network()).to(device)
    state = there.imagine(there.start(2, make_rng(0)), torch.zeros(2, 2, dtype=torch.int8), make_rng(0))
    assert there.render(state, ("rgb",))["rgb"].device.type == device


def test_over_its_ground_a_world_shows_what_was_recorded():
    """Whatever its network would draw there: what comes into the picture is as the recordings saw it."""
    ground = torch.randint(0, 256, (4, 48, 64), dtype=torch.uint8, generator=make_rng(3)).clamp_min(1)
    made, rng = world(scrolling_to(2).generator, ground), make_rng(0)
    torch.nn.init.zeros_(made.generator.output.weight)
    picture = ground[None, :3, 20 : 20 + SIZE[0], 12 : 12 + SIZE[1]].permute(0, 2, 3, 1)
    state = made.observe({"rgb": picture}, None, rng)
    for step in range(1, 3):
        state = made.imagine(state, torch.zeros(1, 2, dtype=torch.int8), rng)
        assert state["place"].tolist() == [[12, 20 + 3 * step]]
        truth = ground[:3, 20 + 3 * step :, 12 : 12 + SIZE[1]].permute(1, 2, 0)[: SIZE[0]]
        assert torch.equal(made.render(state, ("rgb",))["rgb"][0], truth)


def test_the_ground_of_the_recordings_is_known_from_every_start():
    ground = torch.randint(0, 256, (4, 48, 64), dtype=torch.uint8, generator=make_rng(3)).clamp_min(1)
    made = world(network(wild=False), ground)
    state = made.start(3, make_rng(0))
    assert torch.equal(window(ground, state["place"], SIZE)[:, :3], state["frames"][:, 0])
    mosaic = made.scene.look(state, state).mosaic
    assert mosaic is not None
    counts = (mosaic[:, 3] > 0).sum((1, 2))
    assert (counts == ground.shape[1] * ground.shape[2]).all(), "all of it lies in the mosaic"


def test_noise_on_the_history_leaves_the_frame_that_changes():
    generator, frames, context = (
        network(moves=0),
        pictures(2, SLOTS).float() / 127.5 - 1,
        torch.zeros(2, 36 + 2 * SLOTS),
    )
    plain = generator.encode(frames, context)
    noised = generator.encode(frames, context, noise=0.1 * torch.randn(frames.shape, generator=make_rng(0)))
    assert torch.equal(noised.base, frames[:, 0]) and torch.equal(noised.older, plain.older)
    assert not torch.equal(noised.maps[0], plain.maps[0])
