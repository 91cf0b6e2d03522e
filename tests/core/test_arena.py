"""Arena: rows lie once, stay what they are while somebody points at them, and are freed when nobody does."""

from __future__ import annotations

import gc
import threading

import pytest
import torch

from terrella.core import State
from terrella.core.arena import Arena
from terrella.core.errors import CheckpointError, ContractError

PARTS = {"a": (torch.float32, (3,)), "b": (torch.uint8, (2, 2))}


def rows_of(*numbers: float) -> dict[str, torch.Tensor]:
    value = torch.tensor(numbers)
    return {"a": value[:, None].expand(-1, 3), "b": value[:, None, None].expand(-1, 2, 2).to(torch.uint8)}


def pointing(*numbers: float, arena: Arena | None = None) -> State:
    """A state of one entry a number, whose row holds it."""
    arena = arena or Arena(PARTS)
    return State({"rows": arena.keep(rows_of(*numbers))[:, None], "x": torch.tensor(numbers)}, {"rows": arena})


def read(state: State) -> list[float]:
    return state.arenas["rows"].read("a")[state["rows"]][:, 0, 0].tolist()


def test_rows_stay_while_pointed_at_and_are_freed_after():
    arena = Arena(PARTS, room=8)
    kept = pointing(1.0, 2.0, arena=arena)
    for step in range(100):
        passing = pointing(float(step % 200), arena=arena)
        assert read(passing) == [float(step % 200)]
    assert read(kept) == [1.0, 2.0] and arena.capacity == 8 and int(arena.used().sum()) <= 5
    del passing
    gc.collect()
    assert (
        int(arena.used().sum()) == 4
    )  # two, the row that is nothing, and the newest, which may be on its way to a state


def test_an_arena_grows_when_all_its_rows_are_pointed_at():
    arena = Arena(PARTS, room=4)
    states = [pointing(float(n), arena=arena) for n in range(50)]
    assert [read(state)[0] for state in states] == list(range(50)) and arena.capacity >= 51


def test_the_copies_of_a_fork_take_no_room():
    big = State({"rows": torch.zeros(1, 100, dtype=torch.int64), "rgb": torch.zeros(1, 96, 128)})
    assert big.fork(300).nbytes == big.nbytes and big.fork(300).batch == 300


def test_verbs_copy_the_pointers_alone():
    one, other = pointing(1.0, 2.0), pointing(7.0, 8.0)
    arena = one.arenas["rows"]
    for state, numbers in (
        (one.at(1), [2]), (one.fork(2), [1, 1, 2, 2]), (one.put([0], other.at(1)), [8, 2]),
        (one.where(torch.tensor([False, True]), other), [7, 2]), (State.stack([one, other]), [1, 2, 7, 8]),
        (one.replace(x=torch.zeros(2)), [1, 2]), (one.put(torch.tensor([False, True]), other.at(0)), [1, 7]),
    ):  # fmt: skip
        assert read(state) == numbers and state.arenas["rows"] is arena
    assert one.put([1], other.at(0))["x"].tolist() == [1, 7]


def test_saving_takes_the_rows_along(tmp_path):
    state = pointing(*range(1, 40)).at([3, 5, 5])
    state = state.replace(rows=torch.cat([state["rows"], torch.zeros(3, 1, dtype=torch.int64)], 1))
    state.save(tmp_path / "state")
    loaded = State.load(tmp_path / "state")
    assert loaded == state and read(loaded) == [4, 6, 6] and not loaded["rows"][:, 1].any()
    assert (tmp_path / "state").stat().st_size < 1000
    mine = pointing(100.0)
    adopted = loaded.into(mine.arenas["rows"])
    assert adopted == state and adopted.arenas["rows"] is mine.arenas["rows"] and not adopted["rows"][:, 1].any()


def test_a_state_of_another_layout_is_refused():
    other = Arena({"a": (torch.float32, (4,))})
    with pytest.raises(ContractError, match="another layout"):
        pointing(1.0).into(other)
    with pytest.raises(ContractError, match="another layout"):
        State.stack([pointing(1.0), State({"rows": torch.zeros(1, 1).long(), "x": torch.zeros(1)}, {"rows": other})])
    for wrong in ({"a": torch.zeros(1, 3)}, {"a": torch.zeros(1, 3), "b": torch.zeros(2, 2, 2, dtype=torch.uint8)}):
        with pytest.raises(ContractError, match="keeps|needs n rows"):
            Arena(PARTS).keep(wrong)


def test_a_file_whose_rows_were_cut_off_is_refused(tmp_path):
    from safetensors.torch import load_file, save_file

    pointing(1.0, 2.0).save(tmp_path / "whole")
    tensors = load_file(tmp_path / "whole")
    about = '{"kind": "state", "arenas": {"rows": ["a", "b"]}}'
    save_file({**tensors, "rows": tensors["rows"] + 1}, tmp_path / "wrong", metadata={"terrella": about})
    save_file({"rows": tensors["rows"]}, tmp_path / "cut", metadata={"terrella": about})
    for name in ("wrong", "cut"):
        with pytest.raises(CheckpointError, match=name):
            State.load(tmp_path / name)


def test_threads_that_keep_and_drop_never_lose_a_row():
    arena, wrong = Arena(PARTS, room=16), []

    def work(seed: int) -> None:
        states: list[State] = []
        for step in range(150):
            states = [*states[-5:], pointing(float((seed * 31 + step) % 200), arena=arena)]
            wrong.extend(state for state in states if read(state) != state["x"].tolist())

    threads = [threading.Thread(target=work, args=(seed,)) for seed in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong and arena.capacity < 200


def test_an_arena_lives_on_any_device_and_in_inference_mode():
    meta = Arena(PARTS, "meta")
    assert meta.keep({name: value.to("meta") for name, value in rows_of(1.0, 2.0).items()}).shape == (2,)
    with torch.inference_mode():
        arena = Arena(PARTS, room=2)
        inside = pointing(1.0, arena=arena)
    outside = pointing(2.0, 3.0, arena=arena)
    assert read(inside) == [1.0] and read(outside) == [2.0, 3.0]
