"""Codec: what stays is copied to the last bit, what moves is fetched, and a saved one is the same."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from terrella.core import check_world, make_rng
from terrella.data import Layout
from terrella.space.matching import SAME, gather_sources
from terrella.space.mosaic import empty_mosaic, read_mosaic, update_mosaic
from terrella.worlds.codec import HIDDEN, Codec, CodecConfig, CodecInputs, shared_chance
from terrella.worlds.config import HistoryConfig
from terrella.worlds.controls import Controls
from terrella.worlds.folder import load_world, save_world
from terrella.worlds.frame_history import FrameHistory, StartClips
from terrella.worlds.generator import context_thumbnail
from terrella.worlds.learned import About, LearnedWorld

SIZE, SLOTS = (16, 24), 3
MOVES = torch.tensor([[0, 0], [2, 0], [0, -3]])
NONE = torch.zeros(SIZE, dtype=torch.bool)  # nothing lies over what scrolls


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
    scene = FrameHistory(
        HistoryConfig(SIZE, SLOTS, 2, tuple(map(tuple, MOVES.tolist()))), StartClips.of(pictures(4), 2)
    )
    return LearnedWorld(About("made", Controls.buttons(2), 0.1), scene=scene, generator=generator)


def test_it_keeps_the_contract():
    assert {"batches", "states_can_be_saved"} <= set(check_world(world(codec()), steps=3))


def foggy(generator: Codec) -> LearnedWorld:
    """With a ground of 60 x 40 pixels, of which the starts are parts."""
    ground = torch.randint(0, 256, (4, 40, 60), dtype=torch.uint8, generator=make_rng(3)).clamp_min(1)
    places = [(0, 0), (12, 6), (36, 24), (20, 12)]
    frames = torch.stack([ground[:3, y : y + SIZE[0], x : x + SIZE[1]] for x, y in places])
    starts = StartClips.of(frames[:, None].repeat(1, SLOTS, 1, 1, 1), 2)
    config = HistoryConfig(SIZE, SLOTS, 2, tuple(map(tuple, MOVES.tolist())), fog_px=2)
    scene = FrameHistory(config, starts, None, ground)
    return LearnedWorld(About("made", Controls.buttons(2), 0.1), scene=scene, generator=generator)


def scrolling(move: int) -> Codec:
    """Whose pictures always go on by one of the moves."""
    made = codec(wild=False)
    made.scrolling.votes.bias.data = 20.0 * torch.nn.functional.one_hot(torch.tensor(move), len(MOVES)).float()
    return made


@pytest.mark.parametrize("wild", [False, True])
def test_over_its_ground_a_world_shows_what_was_recorded(wild):
    """However it scrolls and whatever its codec would paint: what comes into the picture is as the recordings saw it."""
    generator = scrolling(2)
    if wild:
        torch.nn.init.normal_(generator.choice.weight)
    made, rng = foggy(generator), make_rng(0)
    picture = made.scene.ground[None, :3, 20 : 20 + SIZE[0], 12 : 12 + SIZE[1]].permute(0, 2, 3, 1)
    state = made.observe({"rgb": picture}, None, rng)
    for step in range(1, 7):
        state = made.imagine(state, torch.zeros(1, 2, dtype=torch.int8), rng)
        assert state["place"].tolist() == [[12, 20 + 3 * step]]
        seen = made.render(state, ("rgb", "known"))
        there = max(0, 40 - 20 - 3 * step)
        assert (seen["known"][0, :there] == 1).all() and (seen["known"][0, there:] == 0).all()
        truth = made.scene.ground[:3, 20 + 3 * step :, 12 : 12 + SIZE[1]].permute(1, 2, 0)
        assert (seen["rgb"][0, : min(there, SIZE[0])] == truth[: SIZE[0]]).all() or wild
    assert seen["rgb"][0, 8:].float().std((0, 1)).max() < 1, "beyond the ground there is fog alone"


def test_a_world_with_a_ground_keeps_the_contract_and_is_saved(tmp_path):
    made = foggy(codec())
    assert {"batches", "states_can_be_saved"} <= set(check_world(made, steps=3)) and "known" in made.spec.channels
    save_world(made, tmp_path / "world")
    loaded = load_world(tmp_path / "world")
    assert torch.equal(loaded.scene.ground, made.scene.ground) and loaded.scene.config == made.scene.config
    assert "known" not in world(codec()).spec.channels, "an older world shows what it invents"


def test_where_the_picture_scrolls_the_mosaic_is_shown_with_the_picture_in_its_middle():
    made, rng = world(codec()), make_rng(0)
    state = made.imagine(made.start(2, rng), torch.zeros(2, 2, dtype=torch.int8), rng)
    seen, (height, width) = made.render(state, ("rgb", "mosaic")), SIZE
    assert seen["mosaic"].shape == (2, *made.spec.channels["mosaic"].shape)
    known = seen["mosaic"][..., 3] > 0
    top, left = (known.shape[1] - height) // 2, (known.shape[2] - width) // 2
    assert known[:, top : top + height, left : left + width].all() and not known.all()
    assert not seen["mosaic"][~known].any()
    assert "mosaic" not in Layout.of(made.spec).channels, "recordings do without it"


def test_a_mosaic_goes_on_as_the_dream_scrolls_though_its_pictures_are_too_plain_to_tell():
    made, rng = world(codec(wild=False)), make_rng(0)
    plain = {"rgb": torch.full((2, *SIZE, 3), 90, dtype=torch.uint8)}
    made.generator.scrolling.votes.bias[1] = 99.0  # two pixels to the right
    state = made.observe(plain, None, rng)
    for _ in range(3):
        state = made.imagine(state, torch.zeros(2, 2, dtype=torch.int8), rng)
    seen = made.render(state, ("mosaic",))["mosaic"][..., 3] > 0
    assert seen.any(1).sum(1).tolist() == [SIZE[1] + 3 * 2] * 2
    state = made.observe(plain, state, rng)  # of evidence nobody knows but by looking how it went on
    assert (made.render(state, ("mosaic",))["mosaic"][..., 3] > 0).any(1).sum(1).tolist() == [SIZE[1] + 2 * 2] * 2


def test_what_lies_over_what_scrolls_is_no_part_of_the_mosaic_but_of_the_map():
    made, rng = world(codec()), make_rng(0)
    made.scene.over[:4] = True
    before = made.start(2, rng)
    state = made.imagine(before, torch.zeros(2, 2, dtype=torch.int8), rng)
    given = made.look(state, before)
    assert given.over is not None and given.mosaic is not None
    assert torch.equal(given.over, made.scene.over.expand(2, -1, -1))
    known = read_mosaic(given.mosaic, SIZE, torch.zeros(2, 2, dtype=torch.int64))[:, 3] > 0
    assert not known[:, :4].any() and known[:, 4:].all()
    seen = made.render(state, ("rgb", "mosaic"))
    top, left = ((whole - part) // 2 for whole, part in zip(seen["mosaic"].shape[1:3], SIZE))
    middle = seen["mosaic"][:, top : top + SIZE[0], left : left + SIZE[1]]
    assert torch.equal(middle[:, :4, :, :3], seen["rgb"][:, :4]) and (middle[..., 3] > 0).all()
    ground = state.replace(mosaic=torch.ones_like(state["mosaic"]))  # of colour 1, seen once
    beneath = made.render(ground, ("mosaic",))["mosaic"][:, top : top + 4, left : left + SIZE[1], :3]
    assert (beneath == 1).all(), "where the ground beneath is known, the map shows it"


def test_what_lies_over_what_scrolls_is_seen_to_stay_where_both_would_explain_it():
    made, over = codec(), NONE.clone()
    over[:4] = True
    frames = pictures(1)
    frames[:, 0] = gather_sources(
        frames[:, 1:], torch.ones(1, *SIZE, dtype=torch.int64), MOVES
    )  # two pixels to the right
    frames[..., :8, :] = 90  # of one colour, which every move explains
    for shown, stays in ((NONE, False), (over, True)):
        went = made.seen(frames, empty_mosaic(1, SIZE), shown[None], torch.ones(1, dtype=torch.int64)).went[
            0, :2, :2, 4:-4
        ]
        assert ((went[0] > 0.5) == stays).all() and ((went[1] > 0.5) != stays).all()


def test_where_nothing_scrolls_there_is_no_mosaic_to_show():
    still = replace(world(codec()).scene.config, moves=((0, 0),) * len(MOVES))
    scene = FrameHistory(still, StartClips.of(pictures(4), 2))
    assert "mosaic" not in scene.channels().shows


def test_an_untrained_one_stands_still_to_the_last_bit():
    still, rng = world(codec(wild=False)), make_rng(0)
    state = first = still.start(2, rng)
    for _ in range(50):
        state = still.imagine(state, torch.zeros(2, 2, dtype=torch.int8), rng)
    assert torch.equal(still.render(state, ("rgb",))["rgb"], still.render(first, ("rgb",))["rgb"])


def shown(made: Codec, batch: int = 1, seed: int = 0) -> CodecInputs:
    """Frames, and a mosaic that holds the newest of them but for its upper half."""
    frames = pictures(batch, seed)
    mosaic = update_mosaic(empty_mosaic(batch, SIZE), frames[:, 0], torch.zeros(batch, 2, dtype=torch.int64), NONE)
    mosaic[:, :, : mosaic.shape[2] // 2] = 0
    return made.seen(frames, mosaic, NONE.expand(batch, -1, -1), torch.arange(batch) % len(MOVES))


def like(one: torch.Tensor, other: torch.Tensor) -> bool:
    """Whether no pixel is of another colour; near ones count as one."""
    return bool((one.int() - other.int()).abs().max() <= SAME)


def test_pixels_are_fetched_from_where_the_sources_say():
    made = codec()
    seen = shown(made)
    height, width = SIZE
    for source in range(made.sources):
        found = gather_sources(seen.sources, torch.full((1, *SIZE), source), made.moves)
        for v, u in ((0, 0), (5, 7), (height - 1, width - 1)):
            slot = max(0, source - len(MOVES) + 1)
            x, y = MOVES[source].tolist() if slot == 0 else (0, 0)
            j, i = min(max(v - y, 0), height - 1), min(max(u - x, 0), width - 1)
            assert torch.equal(found[0, :, v, u], seen.sources[0, slot, :, j, i]), (source, v, u)


def test_what_the_mosaic_does_not_know_is_not_fetched_from_it():
    made = codec()
    seen = shown(made)
    choices, _ = made.choices(seen, torch.zeros(1, 36 + 2 * SLOTS))
    memory = choices.softmax(1)[:, made.sources - 1]
    assert not memory[:, : SIZE[0] // 2].any() and (memory[:, SIZE[0] // 2 :] > 0).all()
    assert torch.equal(seen.sources[:, -1, :, SIZE[0] // 2 :], seen.sources[:, 0, :, SIZE[0] // 2 :])


def test_what_lies_outside_of_the_picture_is_as_the_mosaic_knows_it():
    made, frames = codec(wild=False), pictures(1)
    mosaic = torch.full_like(empty_mosaic(1, SIZE), 200)
    seen = made.seen(frames, mosaic, NONE[None], torch.tensor([1]))  # all goes two pixels to the right
    choices, features = made.choices(seen, torch.zeros(1, 36 + 2 * SLOTS))
    share = choices.softmax(1)[0]
    assert not share[1, :, :2].any() and (share[1, :, 2:] > 0.5).all()
    assert like(made.drawn(seen, choices, features)[0, :, :, :2], torch.full((3, SIZE[0], 2), 200, dtype=torch.uint8))


def test_what_lies_over_what_scrolls_neither_goes_along_nor_hides_it():
    made, frames, over = codec(wild=False), pictures(1), NONE.clone()
    over[:4], over[8:12, 10:14] = True, True
    mosaic = torch.full_like(empty_mosaic(1, SIZE), 200)
    seen = made.seen(frames, mosaic, over[None], torch.tensor([1]))  # all goes two pixels to the right
    assert torch.equal(seen.known[0, 0], ~over), "the mosaic is not asked for what it is no part of"
    made.choice.bias.data[made.sources] = 9.0  # everything else is painted
    choices, features = made.choices(seen, torch.zeros(1, 36 + 2 * SLOTS))
    share = choices.softmax(1)[0]
    assert torch.equal(seen.scrolled[0, :, over], frames[0, 0, :, over]), "it stays"
    assert not share[[1, -1], 8:12, 14:16].any() and (share[-1, 8:12, 16:] > 0.5).all()
    ground = made.drawn(seen, choices, features)[0, :, 8:12, 14:16]
    assert like(ground, torch.full_like(ground, 200)), "what it hid is as the mosaic knows it"


def test_what_went_on_is_carried_to_where_it_would_go_next():
    made = codec()
    went = torch.rand(1, len(MOVES), *SIZE, generator=make_rng(4))
    carried = made._carried(went)
    for number, (x, y) in enumerate(MOVES.tolist()):
        assert carried[0, number, 8, 9] == went[0, number, 8 - y, 9 - x]


def test_what_is_likelier_painted_has_a_colour_of_the_palette():
    made = codec()
    seen = shown(made, 2)
    choices = torch.full((2, made.sources + 1, *SIZE), -9.0)
    choices[:, 1] = 3.0
    choices[0, -1, :4] = 9.0
    drawn = made.drawn(seen, choices, torch.randn(2, HIDDEN, *SIZE, generator=make_rng(1)))
    colours = drawn[0, :, :4].flatten(1).T
    assert ((colours[:, None].int() - made.palette.int()).abs().amax(-1) <= SAME).any(1).all()
    there = gather_sources(seen.sources, torch.ones(2, *SIZE, dtype=torch.int64), made.moves)
    assert like(drawn[0, :, 4:], there[0, :, 4:]) and like(drawn[1], there[1])


def test_colours_that_are_in_the_picture_and_near_are_the_likelier_ones():
    made = codec()
    for weight in made.colour[-1].parameters():
        torch.nn.init.zeros_(weight)
    frame = made.palette[3][:, None, None].expand(3, *SIZE).clone()
    frame[:, :, :12] = made.palette[1][:, None, None]
    seen = shown(made)._replace(scrolled=frame[None], common=made.common_colours(frame[None]))
    nothing = torch.zeros(1, HIDDEN, *SIZE)
    best = made.colours(seen, nothing).argmax(1).unflatten(0, SIZE)
    assert (best[:, :8] == 1).all() and (best[:, 16:] == 3).all()
    made.common.data.zero_()
    assert made.colours(seen, nothing).std(1).max() == 0


def test_pixels_in_doubt_go_one_way_together():
    noise = torch.randn(2, 4, *SIZE, generator=make_rng(0))
    doubt = torch.zeros(2, 6, *SIZE)
    picks = (doubt + shared_chance(noise, doubt)).argmax(1)
    assert (picks == picks[:, :1, :1]).all() and picks[0, 0, 0] != picks[1, 0, 0]
    many = torch.randn(4000, 4, 2, 2, generator=make_rng(1))
    odds = torch.tensor([0.6, 0.3, 0.1]).log()[None, :, None, None].expand(4000, -1, 2, 2)
    counts = torch.bincount((odds + shared_chance(many, odds)).argmax(1)[:, 0, 0], minlength=3) / 4000
    assert torch.allclose(counts, torch.tensor([0.6, 0.3, 0.1]), atol=0.03)


def test_the_stress_on_what_changes_is_taken_back():
    made = codec()
    seen = shown(made)
    choices = torch.full((1, made.sources + 1, *SIZE), -20.0)
    choices[:, 0], choices[:, 1] = 0.0, 2.0
    features = torch.zeros(1, HIDDEN, *SIZE)
    moved = gather_sources(seen.sources, torch.ones(1, *SIZE, dtype=torch.int64), made.moves)
    assert like(made.drawn(seen, choices, features), moved)
    made.stress.fill_(16.0)
    assert torch.equal(made.drawn(seen, choices, features), seen.sources[:, 0])


def test_a_saved_one_draws_the_same(tmp_path):
    one, seen = world(codec()), shown(codec(), 2, seed=3)
    one.scene.over[2:5, 3] = True
    one.generator.stress.fill_(3.0)
    save_world(one, tmp_path / "world")
    again = load_world(tmp_path / "world")
    context = torch.cat([context_thumbnail(seen.sources[:, 0]), torch.zeros(2, 2 * SLOTS)], 1)
    for mine, other in zip(one.generator.choices(seen, context), again.generator.choices(seen, context)):
        assert torch.equal(mine, other)
    made = again.generator
    assert torch.equal(made.moves, MOVES) and made.stress == 3 and made.palette.dtype == torch.uint8
    assert again.scene.config == one.scene.config and torch.equal(again.scene.over, one.scene.over)


@pytest.mark.parametrize("device", ["meta"])
def test_a_step_stays_on_its_device(device):
    there = world(codec()).to(device)
    state = there.imagine(there.start(2, make_rng(0)), torch.zeros(2, 2, dtype=torch.int8), make_rng(0))
    assert there.render(state, ("rgb",))["rgb"].device.type == device
