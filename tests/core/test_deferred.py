"""Deferred tensors: what they are does not depend on when, in which batch or by whom they are read."""

from __future__ import annotations

import gc
import threading
import weakref

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from terrella.core import State
from terrella.core.arena import Arena
from terrella.core.deferred import Deferred, Step

DRAWN = []  # batches that were drawn


def draw(before: State, now) -> dict[str, torch.Tensor]:
    DRAWN.append(before.batch)
    return {"frame": before["frame"] * 0.5 + now["seed"].double()}


def begin(batch: int) -> State:
    return State({"place": torch.zeros(batch), "frame": torch.arange(batch).double()})


def step(state: State, seed: torch.Tensor, lazy: bool = True) -> State:
    place = state["place"] + 1
    if not lazy:
        return State({"place": place, **draw(state, {"seed": seed})})
    return State({"place": place}, state.arenas, Deferred(["frame"], Step(draw, state, {"seed": seed})))


@given(
    st.lists(st.sampled_from(["step", "at", "fork", "put", "where", "stack", "read"]), max_size=12), st.integers(0, 9)
)
def test_lazy_equals_eager(verbs, seed):
    rng = torch.Generator().manual_seed(seed)
    lazy = eager = begin(2)
    for verb in verbs:
        batch = lazy.batch
        noise, index = (torch.randint(0, n, (batch,), generator=rng) for n in (100, batch))
        if verb == "step":
            lazy, eager = step(lazy, noise), step(eager, noise, lazy=False)
        elif verb == "at":
            lazy, eager = lazy.at(index[: 1 + batch // 2]), eager.at(index[: 1 + batch // 2])
        elif verb == "fork" and batch < 9:
            lazy, eager = lazy.fork(2), eager.fork(2)
        elif verb == "put":
            lazy, eager = lazy.put([0], lazy.at(-1)), eager.put([0], eager.at(-1))
        elif verb == "where":
            flags, other = noise > 50, begin(batch)
            lazy, eager = lazy.where(flags, other), eager.where(flags, other)
        elif verb == "stack" and batch < 9:
            lazy, eager = State.stack([lazy, begin(1)]), State.stack([eager, begin(1)])
        elif verb == "read":
            assert torch.equal(lazy["frame"], eager["frame"])
    assert lazy == eager and lazy.batch == eager.batch


def test_nothing_is_drawn_that_nobody_reads():
    DRAWN.clear()
    state = begin(64)
    for n in range(10):
        state = step(state, torch.full((64,), n))
    one = state.fork(2).at(5).replace(place=torch.zeros(1))
    assert not DRAWN and "frame[1, not yet computed]" in repr(one) and one.deferred.length > 10
    assert one["frame"].shape == (1,) and DRAWN == [1] * 10
    again = one["frame"]
    assert again is one["frame"] and DRAWN == [1] * 10 and one.deferred is None
    assert torch.equal(again, state["frame"][2:3])


def test_a_chain_of_thousands_is_drawn_and_let_go():
    state = begin(1)
    first = weakref.ref(state)
    for n in range(3000):
        state = step(state, torch.tensor([n % 7]))
        state = state.at(0) if n % 2 else state
    assert torch.isfinite(state["frame"]).all()
    gc.collect()
    assert first() is None


def test_a_chain_that_nobody_reads_is_dropped_without_a_crash():
    state = begin(1)
    for n in range(20000):
        state = step(state, torch.tensor([n]))
    del state


def test_threads_that_read_the_same_chain_get_the_same():
    state = begin(4)
    for n in range(200):
        state = step(state, torch.full((4,), n))
    found = []
    threads = [threading.Thread(target=lambda: found.append(state["frame"])) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 4 and all(frame is found[0] for frame in found)


def test_rows_that_are_kept_while_drawing_stay():
    arena = Arena({"v": (torch.float64, ())}, room=2)

    def remember(before: State, now) -> dict[str, torch.Tensor]:
        frame = before["frame"] + now["seed"].double()
        return {"frame": frame, "rows": torch.cat([before["rows"], arena.keep({"v": frame})[:, None]], 1)}

    start = State({"frame": torch.zeros(2).double(), "rows": torch.zeros(2, 1, dtype=torch.int64)}, {"rows": arena})
    state = start
    for n in range(5):
        state = State(
            {}, state.arenas, Deferred(["frame", "rows"], Step(remember, state, {"seed": torch.tensor([n, 1])}))
        )
    other = state.fork(2).at([1, 2])
    for rows in (state["rows"][:, 1:], other["rows"][:, 1:]):
        assert arena.read("v")[rows].tolist() == [[0, 1, 3, 6, 10], [1, 2, 3, 4, 5]]


def test_saving_and_gradients_pass_through(tmp_path):
    seed = torch.tensor([3.0], requires_grad=True)
    state = step(step(begin(1), seed), seed)
    with torch.inference_mode():
        assert not state["frame"].is_inference()
    state["frame"].sum().backward()
    assert seed.grad.tolist() == [1.5]
    with torch.no_grad():
        plain = step(begin(2), torch.tensor([1, 2]))
        plain.save(tmp_path / "state")
    assert State.load(tmp_path / "state") == step(begin(2), torch.tensor([1, 2]), lazy=False)


def test_a_step_that_gives_something_else_is_refused():
    late = Deferred(["frame"], Step(lambda before, now: {"other": before["frame"]}, begin(1), {}))
    with pytest.raises(ValueError, match="owes"):
        State({"place": torch.zeros(1)}, None, late)["frame"]
    with pytest.raises(KeyError):
        State({"place": torch.zeros(1)}, None, late)["nothing"]


@pytest.mark.parametrize("nothing", [[], torch.zeros(3, dtype=torch.bool)], ids=["list", "mask"])
def test_no_entry_of_what_waits_is_nothing_of_its_shape(nothing):
    state = step(State.stack([step(begin(3), torch.arange(3)), begin(1)]), torch.arange(4)).at([0, 1, 2])
    assert state.at(nothing)["frame"].shape == (0,) and state.at(nothing).at([])["frame"].dtype == torch.float64
    joined = State.stack([state.at(nothing), state.at([1])])
    assert torch.equal(joined["frame"], state["frame"][1:2])


def test_what_another_thread_computes_meanwhile_keeps_its_rows(monkeypatch):
    arena = Arena({"v": (torch.float64, ())}, room=3)

    def remember(before: State, now) -> dict[str, torch.Tensor]:
        return {"frame": before["frame"] + 7, "rows": arena.keep({"v": before["frame"] + 7})[:, None]}

    start = State({"frame": torch.arange(2).double(), "rows": torch.zeros(2, 1, dtype=torch.int64)}, {"rows": arena})
    state = State({}, start.arenas, Deferred(["frame", "rows"], Step(remember, start, {})))
    planned = Deferred.at
    monkeypatch.setattr(Deferred, "at", lambda self, *given: (self.values(), planned(self, *given))[1])
    one = state.at([1]).at([0])  # reading it narrows the state
    row = one["rows"]
    assert one.arenas["rows"] is arena and arena.read("v")[row].tolist() == [[8.0]]
    kept = one.replace(frame=torch.zeros(1).double())
    del one, state, row
    gc.collect()
    for _ in range(8):
        arena.keep({"v": torch.full((1,), -1.0).double()})
    assert arena.read("v")[kept["rows"]].tolist() == [[8.0]]


def test_the_device_of_a_state_whose_tensors_are_all_deferred_is_that_of_its_plan():
    before = State({"place": torch.zeros(2, 3, device="meta")})
    late = State({}, deferred=Deferred(["frame"], Step(lambda state, now: {"frame": state["place"] + 1}, before, {})))
    assert late.device.type == late.at(0).device.type == late["frame"].device.type == "meta"
