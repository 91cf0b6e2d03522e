"""State: the laws of a batched value, over states that hypothesis makes up."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from safetensors.torch import save_file

from terrella.core import State
from terrella.core.errors import CheckpointError

DTYPES = (torch.float32, torch.float64, torch.float16, torch.uint8, torch.int64, torch.bool)


@st.composite
def states(draw, batch: int | None = None, like: State | None = None) -> State:
    batch = draw(st.integers(1, 4)) if batch is None else batch
    seed = torch.Generator().manual_seed(draw(st.integers(0, 2**31)))
    if like is None:
        names = draw(st.lists(st.text("abc_.", min_size=1, max_size=4), min_size=1, max_size=3, unique=True))
        kinds = {
            name: (draw(st.sampled_from(DTYPES)), tuple(draw(st.lists(st.integers(0, 3), max_size=2))))
            for name in names
        }
    else:
        kinds = {name: (tensor.dtype, tuple(tensor.shape[1:])) for name, tensor in like.items()}
    return State(
        {name: (torch.randn((batch, *shape), generator=seed) * 3).to(dtype) for name, (dtype, shape) in kinds.items()}
    )


@given(states())
def test_stacking_the_entries_gives_the_state_back(state):
    assert State.stack([state.at(i) for i in range(state.batch)]) == state
    assert state.at(slice(None)) == state
    assert state.at(torch.arange(state.batch)) == state


@given(states(), st.data())
def test_at_picks_what_was_stacked(first, data):
    second = data.draw(states(like=first))
    both = State.stack([first, second])
    assert both.batch == first.batch + second.batch
    assert both.at(slice(0, first.batch)) == first and both.at(slice(first.batch, None)) == second


@given(states(), st.integers(1, 3), st.data())
def test_fork_repeats_each_entry_in_a_row(state, n, data):
    forked, entry = state.fork(n), data.draw(st.integers(0, state.batch - 1))
    assert forked.batch == n * state.batch
    assert forked.at(slice(0, None, n)) == state
    assert forked.at(slice(entry * n, entry * n + n)) == State.stack([state.at(entry)] * n)
    assert state.fork(1) == state


@given(states(), st.data())
def test_at_takes_every_kind_of_index(state, data):
    i = data.draw(st.integers(-state.batch, state.batch - 1))
    picked = state.at(i)
    assert picked.batch == 1
    for same in (np.int64(i), [i], torch.tensor(i), torch.tensor([i]), np.array([i])):
        assert state.at(same) == picked
    mask = torch.zeros(state.batch, dtype=torch.bool)
    mask[i] = True
    assert state.at(mask) == picked


@given(state=states())
def test_saving_and_loading_is_the_identity(tmp_path_factory, state):
    path = tmp_path_factory.mktemp("states") / "state.safetensors"
    state.save(path)
    assert State.load(path) == state


def test_a_branch_is_saved_without_its_neighbours(tmp_path):
    crowd = State({"a": torch.arange(1000.0)})
    for branch in (crowd.at(slice(3, 4)), crowd.at(3)):
        branch.save(tmp_path / "branch")
        assert State.load(tmp_path / "branch") == branch and (tmp_path / "branch").stat().st_size < 1000
    assert crowd.nbytes == 4000 and crowd.at(3).nbytes == 4


def test_states_differ_by_name_value_dtype_and_batch():
    state = State({"a": torch.zeros(2)})
    others = [{"b": torch.zeros(2)}, {"a": torch.ones(2)}, {"a": torch.zeros(2).double()}, {"a": torch.zeros(1)}]
    assert state == State({"a": torch.zeros(2)})
    assert all(state != State(other) for other in others) and state != 3
    with pytest.raises(TypeError):
        hash(state)


def test_a_state_is_a_value():
    state = State({"a": torch.zeros(2)})
    with pytest.raises(AttributeError, match="replace"):
        state.a = 1
    with pytest.raises(TypeError):
        state["a"] = torch.ones(2)
    changed = state.replace(a=torch.ones(2), b=torch.ones(2, 3))
    assert set(changed) == {"a", "b"} and state == State({"a": torch.zeros(2)})
    assert "a[2]" in repr(state)


@pytest.mark.parametrize("tensors", [{}, {"a": torch.tensor(1.0)}, {"a": torch.zeros(2), "b": torch.zeros(3)}])
def test_tensors_without_a_common_batch_are_refused(tensors):
    with pytest.raises(ValueError, match="needs at least one tensor|same batch axis"):
        State(tensors)


def test_only_states_of_one_world_stack():
    with pytest.raises(ValueError, match="same world"):
        State.stack([State({"a": torch.zeros(1)}), State({"b": torch.zeros(1)})])
    with pytest.raises(ValueError, match="nothing to stack"):
        State.stack([])


def test_foreign_files_are_refused_in_one_sentence(tmp_path):
    (tmp_path / "text").write_text("not a state")
    save_file({"a": torch.zeros(1)}, str(tmp_path / "weights"))
    save_file({"a": torch.zeros(1)}, str(tmp_path / "list"), metadata={"terrella": "[]"})
    (tmp_path / "cut").write_bytes((tmp_path / "weights").read_bytes()[:20])
    for name in ("missing", "text", "weights", "cut", "list"):
        with pytest.raises(CheckpointError, match=name):
            State.load(tmp_path / name)


def test_where_takes_whole_entries():
    ours, theirs = (
        State({"a": torch.zeros(3, 2), "b": torch.zeros(3)}),
        State({"a": torch.ones(3, 2), "b": torch.ones(3)}),
    )
    mixed = ours.where(torch.tensor([True, False, True]), theirs)
    assert mixed["a"].tolist() == [[0, 0], [1, 1], [0, 0]] and mixed["b"].tolist() == [0, 1, 0]
