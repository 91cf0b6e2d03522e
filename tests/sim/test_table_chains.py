"""Chains of tasks at the table: the instruction changes when one is done, and the tasks can follow each other."""

from __future__ import annotations

from importlib.util import find_spec

import pytest
import torch

import terrella
from terrella.core import check_world, make_rng
from terrella.core.instruction import bytes_to_text

if find_spec("mujoco") is None:
    pytest.skip("mujoco is not installed: pip install 'terrella[mujoco]'", allow_module_level=True)

from terrella.sim.table_chains import THEN
from terrella.sim.table_words import TASKS

BLIND = {"cameras": (), "threads": 1}


@pytest.fixture(scope="module")
def chain():
    return terrella.load("mujoco:table:chain", **BLIND)


def texts_of(world, state):
    return [bytes_to_text(row.numpy()) for row in world.render(state, ("text",))["text"]]


def test_the_contract_holds(chain):
    assert "a_batch_equals_its_singles" in check_world(chain, steps=2)
    assert chain.spec.max_episode_steps == 300


def test_the_teacher_does_one_after_the_other_and_the_instruction_changes(chain):
    rng, teacher = make_rng(0), terrella.load_policy("teacher", chain.spec)
    state, memory, total = chain.start(2, make_rng(4)), None, torch.zeros(2)
    due = chain.task.instructions(state)
    said = [[text] for text in texts_of(chain, state)]
    for _ in range(300):
        action, memory = teacher.act(chain.render(state, ("expert",)), memory, rng)
        state = chain.imagine(state, action, rng)
        total += state["reward"]
        assert torch.equal(state["success"], total == 3) and torch.equal(state["done"], state["success"])
        for row, text in enumerate(texts_of(chain, state)):
            said[row] += [text] if text != said[row][-1] else []
        if state["done"].all():
            break
    assert state["success"].all() and said == due


def test_every_chain_can_be_carried_out(chain):
    """The drawer is open before something is put in or it is closed, hands are empty, and what is put away stays there."""
    state = chain.start(400, make_rng(1))
    opening = chain.task.scene(chain.layout, state).opening
    seen = set()
    for jobs, first in zip(state["jobs"].tolist(), opening.tolist()):
        opened, held, gone = first > 0.05, None, set()
        for number, block, other, _ in jobs:
            task = TASKS[number]
            seen.add(task)
            assert held is None or (task in ("place", "store", "stack") and block == held)
            assert task in ("open", "close") or block not in gone
            assert opened == (task == "close") or task not in ("open", "close")
            assert task != "store" or opened
            assert task != "stack" or (other not in gone and other != block)
            held = block if task == "pick" else None
            opened = task == "open" or (opened and task != "close")
            gone |= {"place": {block}, "store": {block}, "stack": {block, other}}.get(task, set())
    assert seen == set(TASKS)


def test_a_sentence_says_all_of_it_and_a_free_table_nothing(chain):
    whole = terrella.load("mujoco:table:sentence", **BLIND)
    state = whole.start(3, make_rng(2))
    assert texts_of(whole, state) == [
        THEN.join(steps) for steps in chain.task.instructions(chain.start(3, make_rng(2)))
    ]
    other = terrella.load("mujoco:table:sentence:unseen", **BLIND)
    assert not set(texts_of(other, other.start(3, make_rng(2)))) & set(texts_of(whole, state))
    free = terrella.load("mujoco:table:free", **BLIND)
    state = free.start(2, make_rng(2))
    assert texts_of(free, state) == ["", ""]
    lifted = state.replace(job=torch.tensor([[TASKS.index("close"), 0, 1, 0]] * 2))
    assert not free.imagine(lifted, torch.zeros(2, 4), make_rng(0))["done"].any()
