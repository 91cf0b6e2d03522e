"""Laws of memory: what it keeps, what it forgets, what it finds again, and that it never outgrows its budget."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from terrella.core import State
from terrella.space.camera import yaw
from terrella.space.keyframes import Keyframes, doubled
from terrella.space.memory import DREAMT, EMPTY, OBSERVED, PAGE, ROWS, Memory

from .rooms import CAMERA, SIZE, painted, pose_at, room_depth

ROOMY = Memory(CAMERA, SIZE, budget_mb=2.0)


def small(capacity: int) -> Memory:
    """A memory with room for `capacity` keyframes."""
    memory = Memory(CAMERA, SIZE, budget_mb=(capacity + 0.5) * ROOMY.keyframe_bytes / 2**20)
    assert memory.capacity == capacity
    return memory


def view(x: float, y: float, heading: float):
    """rgb, depth and pose of the room from one place."""
    pose = pose_at(x, y, heading)
    depth = room_depth(pose)
    return painted(pose, depth), depth, pose


def nothing_known(batch: int = 1) -> torch.Tensor:
    return torch.zeros(batch, *SIZE)


def after(memory: Memory, held, *views, kind: int = OBSERVED):
    """What is held after these views of one story came in one by one."""
    for seen in views:
        more = memory.observed(held, *seen) if kind == OBSERVED else memory.dreamt(held, *seen, nothing_known())
        held = {**held, **more}
    return held


def headings(memory: Memory, held, story: int = 0) -> list[int]:
    table = memory.table(held)[story]
    return sorted(round(math.degrees(row[2])) for row in table.tolist() if row[3] != EMPTY)


def test_evidence_is_kept_and_takes_the_place_of_what_was_held_of_that_view():
    held = after(ROOMY, ROOMY.empty(1), view(0, 0, 0.0), view(0, 0, 1.5), kind=DREAMT)
    held = after(ROOMY, held, view(0.05, 0, 0.03))
    kinds = held["memory_kind"][0]
    assert ROOMY.count(held).tolist() == [2] and kinds[:2].tolist() == [OBSERVED, DREAMT]
    page = ROOMY.keyframes(held, 0)
    rgb, depth, pose = view(0.05, 0, 0.03)
    assert torch.equal(page.rgb[0], rgb[0]) and torch.equal(page.depth[0], depth[0])
    assert torch.equal(page.pose[0], pose[0])


def test_a_dream_is_kept_only_if_its_view_is_new_and_much_of_it_invented():
    held = after(ROOMY, ROOMY.empty(1), view(0, 0, 0.0))
    assert ROOMY.dreamt(held, *view(0.1, 0, 0.1), nothing_known()) == {}, "too near to what it holds"
    assert ROOMY.dreamt(held, *view(1.0, 0, 1.0), nothing_known() + 0.96) == {}, "known anyway"
    assert "memory_rows" in ROOMY.dreamt(held, *view(1.0, 0, 1.0), nothing_known() + 0.9)


def test_stories_keep_their_own():
    held = ROOMY.empty(3)
    rgb, depth, pose = (torch.cat(parts) for parts in zip(*(view(0, 0, turn) for turn in (0.0, 1.0, 2.0))))
    known = torch.tensor([0.0, 1.0, 0.0])[:, None, None].expand(3, *SIZE)
    held = {**held, **ROOMY.dreamt(held, rgb, depth, pose, known)}
    assert ROOMY.count(held).tolist() == [1, 0, 1] and len(ROOMY.keyframes(held, 1)) == 0
    alone = after(ROOMY, ROOMY.empty(1), view(0, 0, 2.0), kind=DREAMT)
    mine, other = ROOMY.keyframes(held, 2), ROOMY.keyframes(alone, 0)
    assert torch.equal(mine.rgb, other.rgb) and torch.equal(mine.coarse, other.coarse)


def test_keeping_in_one_story_copies_small_tensors_alone_and_leaves_the_past_as_it_was():
    views = [view(0, 0, 0.3 * turn) for turn in range(PAGE)]
    state = State(after(ROOMY, ROOMY.empty(1), *views), ROOMY.arenas)
    assert state.nbytes < 0.01 * 2**20 and state.fork(300).nbytes == state.nbytes
    crowd = state.fork(300)
    rgb, depth, pose = (part.expand(300, *part.shape[1:]) for part in view(1, 1, 0.0))
    known = torch.ones(300, *SIZE)
    known[7] = 0
    before = int(state.arenas["memory_rows"].used().sum())
    changed = ROOMY.dreamt(crowd, rgb, depth, pose, known)
    later = crowd.replace(**changed)
    assert sum(part.numel() * part.element_size() for part in changed.values()) < 300 * ROOMY.capacity * 64
    assert int(state.arenas["memory_rows"].used().sum()) <= before + 1
    assert later.at([0, 299]) == state.fork(2) and ROOMY.count(later)[6:9].tolist() == [PAGE, PAGE + 1, PAGE]


def test_a_batch_keeps_and_recalls_as_its_singles():
    views = [view(0.2 * n, 0, 0.4 * n) for n in range(5)]
    singles = [after(ROOMY, ROOMY.empty(1), *views[n : n + 2], kind=DREAMT) for n in range(4)]
    batch = ROOMY.empty(4)
    for step in range(2):
        seen = [torch.cat(parts) for parts in zip(*views[step : step + 4])]
        batch |= ROOMY.dreamt(batch, *seen, nothing_known(4))
    here = torch.cat([pose_at(0.2, 0.1, 0.5)] * 4)
    together = ROOMY.look(batch, here)
    for n, single in enumerate(singles):
        alone = ROOMY.look(single, here[:1])
        assert all(torch.equal(vars(together)[name][n], part[0]) for name, part in vars(alone).items())
        assert torch.equal(ROOMY.walls(batch)[n], ROOMY.walls(single)[0])


def test_the_whole_memory_runs_on_another_device():
    """Nothing asks what the tensors hold: on `meta` they hold nothing."""
    memory = Memory(CAMERA, SIZE, budget_mb=0.2, device="meta")
    state = State(memory.empty(2), memory.arenas)
    rgb, depth, pose = (torch.cat([part, part]).to("meta") for part in view(0, 0, 0.0))
    recorded = Keyframes.of(doubled(rgb), depth, pose, CAMERA)
    state = state.replace(**memory.observed(state, rgb, depth, pose))
    state = state.replace(**memory.dreamt(state, rgb, depth, pose, nothing_known(2).to("meta")))
    glimpse = memory.look(state, pose, recorded=recorded)
    assert glimpse.rgb.shape == (2, 3, 3, *SIZE) and memory.walls(state).shape == (2, memory.capacity * 16, 4)
    assert {part.device.type for part in (*vars(glimpse).values(), *state.values())} == {"meta"}


def test_it_forgets_what_the_others_cover_best():
    memory = small(3)
    held = after(memory, memory.empty(1), *(view(0, 0, math.radians(turn)) for turn in (0, 20, 150)))
    assert memory.covered(held, held[ROWS], held["memory_kind"] == DREAMT)[0].argmax() != 2
    held = after(memory, held, view(0, 0, math.radians(-100)))
    assert 150 in headings(memory, held) and -100 in headings(memory, held)
    assert headings(memory, held)[1] in (0, 20)


@pytest.mark.parametrize(
    "kinds, gone",
    [((OBSERVED, OBSERVED, DREAMT), 2), ((OBSERVED, OBSERVED, OBSERVED), 0), ((OBSERVED, DREAMT, DREAMT), 1)],
)
def test_of_views_covered_alike_a_dream_goes_first_then_the_oldest(kinds, gone):
    memory = small(3)
    held = memory.empty(1)
    for slot, kind in enumerate(
        kinds
    ):  # all of one view; each is kept as a new one, for the others stand far off by then
        held = after(memory, held, view(0, 0, 0.0), kind=kind)
        held["memory_pose"] = held["memory_pose"].clone()
        held["memory_pose"][0, slot, 0] = 9.0
    held["memory_pose"][0, :, 0] = 0.0
    rgb, depth, _ = view(0, 0, 0.0)
    kept = after(memory, held, (rgb, depth, pose_at(3.0, 3.0, 3.0)))
    assert kept["memory_pose"][0, :, 0].tolist() == [3.0 if slot == gone else 0.0 for slot in range(3)]


def test_evidence_is_not_forgotten_because_a_dream_covers_it():
    memory = small(3)
    held = after(memory, memory.empty(1), view(0, 0, 0.0), view(0, 0, 2.0))
    held = after(memory, held, view(0.3, 0.1, 0.21), kind=DREAMT)
    given = held, held[ROWS], held["memory_kind"] == DREAMT
    covered = memory.covered(*given)[0]
    assert covered[0] == 0 and covered[2] > 0.3
    torch.testing.assert_close(memory.covered_slowly(*given)[0], covered, atol=0.05, rtol=0)
    held = after(memory, held, view(0, 0, -2.0))
    assert (held["memory_kind"][0] == OBSERVED).all() and headings(memory, held) == [-115, 0, 115]


places = st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.floats(-3, 3), st.booleans())


@settings(max_examples=12, deadline=None)
@given(st.lists(places, min_size=1, max_size=14), st.sampled_from([0, 1, 3, 5]))
def test_it_stays_within_its_budget_and_holds_the_newest(story, capacity):
    memory = small(capacity)
    held = memory.empty(1)
    for x, y, heading, dream in story:
        seen = view(x, y, heading)
        is_new = memory.nearest(held, seen[2])[0] > 1 if capacity else torch.tensor([False])
        held = after(memory, held, seen, kind=DREAMT if dream else OBSERVED)
        state = State({**held, "pose": seen[2]})
        rows = int((held["memory_rows"] > 0).sum()) * memory.arenas["memory_rows"].row_bytes
        assert rows + sum(part.numel() * part.element_size() for part in memory.of(state).values()) <= memory.nbytes
        assert memory.nbytes <= memory.budget_mb * 2**20 and memory.count(held) <= capacity
        if capacity and (is_new or not dream):
            newest = held["memory_pose"][0, held["memory_born"][0].argmax()]
            assert torch.equal(newest, seen[2][0])


def test_a_memory_survives_saving_bit_for_bit_and_forks(tmp_path):
    views = [view(0, 0, 0.3 * turn) for turn in range(PAGE + 3)]
    state = State(after(ROOMY, ROOMY.empty(1), *views), ROOMY.arenas)
    state.save(tmp_path / "state.safetensors")
    again = State.load(tmp_path / "state.safetensors")
    assert again == state
    here = pose_at(0.2, 0.1, 1.0)
    for one, other in zip(vars(ROOMY.look(state, here)).values(), vars(ROOMY.look(again, here)).values()):
        assert torch.equal(one, other)
    both = state.fork(2)
    both = both.replace(**ROOMY.observed(both, *(torch.cat([a, b]) for a, b in zip(view(1, 1, 0), view(-1, 1, 2)))))
    alone = state.replace(**ROOMY.observed(state, *view(-1, 1, 2)))
    assert both.at(1) == alone and both.at(0) != alone


def test_what_was_seen_is_seen_again_and_what_was_not_is_unknown():
    state = after(ROOMY, ROOMY.empty(2), *[tuple(torch.cat([part, part]) for part in view(0, 0, 0.0))])
    views = torch.cat([pose_at(0.4, 0.2, 0.05), pose_at(0, 0, math.pi)])
    glimpse = ROOMY.look(state, views, slots=2)
    truth = painted(views[:1], room_depth(views[:1])).float() / 255
    mask = glimpse.known[0] > 0
    assert mask.float().mean() > 0.8 and glimpse.known[1].mean() < 0.05
    assert (glimpse.rgb[0, 0] - truth[0]).abs().mean(0)[mask].mean() < 0.03


def test_pictures_of_any_size_can_be_kept():
    memory, size = Memory(CAMERA, (9, 13), budget_mb=0.01), (9, 13)
    assert 0 < memory.capacity < PAGE
    pose = torch.cat([pose_at(0, 0, 0.0), pose_at(1, 1, 2.0), pose_at(1, 0, 1.0)])
    depth = room_depth(pose, size)
    rgb = painted(pose, depth)
    held = memory.empty(3)
    held |= memory.observed(held, rgb, depth, pose)
    for story in range(3):
        page = memory.keyframes(held, story)
        assert torch.equal(page.depth[0], depth[story]) and torch.equal(page.rgb[0], rgb[story])


def test_an_empty_memory_knows_nothing():
    for memory in (ROOMY, small(0)):
        glimpse = memory.look(memory.empty(1), pose_at(0, 0, 0.0))
        assert glimpse.known.max() == 0 and glimpse.trust.max() == 0 and torch.isfinite(glimpse.depth).all()
    assert small(0).observed(small(0).empty(1), *view(0, 0, 0.0)) == {}


def test_it_finds_the_keyframe_that_looked_there():
    held = after(ROOMY, ROOMY.empty(1), *(view(0, 0, turn) for turn in (math.pi, 0.0, math.pi / 2)))
    assert ROOMY.look(held, pose_at(0.3, 0, 0.1), sources=1).known.mean() > 0.8


def test_the_table_shows_what_is_held():
    held = after(ROOMY, ROOMY.empty(1), view(1.5, -0.5, 0.7))
    held = after(ROOMY, held, view(-1, 0, 2.0), kind=DREAMT)
    table = ROOMY.table(held)
    assert table.shape == (1, ROOMY.capacity, 4) and table[0, 2:].abs().max() == 0
    assert table[0, :2].flatten().tolist() == pytest.approx([1.5, -0.5, 0.7, OBSERVED, -1, 0, 2.0, DREAMT], abs=1e-5)
    assert yaw(held["memory_pose"][0, 1]).item() == pytest.approx(2.0, abs=1e-5)
