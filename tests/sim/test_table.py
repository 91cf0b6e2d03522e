"""A table with blocks, a cup and a drawer: instructions, a teacher that follows them, and success by the state alone."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
import pytest
import torch

import terrella
from terrella.core import check_world, make_rng
from terrella.core.errors import TerrellaError
from terrella.core.instruction import bytes_to_text

if find_spec("mujoco") is None:
    pytest.skip("mujoco is not installed: pip install 'terrella[mujoco]'", allow_module_level=True)

from terrella.sim.table_scene import BLOCK_M, PLACED
from terrella.sim.table_words import ALONE, TASKS, WORDINGS

BLIND = {"cameras": (), "threads": 1}


@pytest.fixture(scope="module")
def table():
    return terrella.load("mujoco:table", **BLIND)


def played(world, policy: str, batch: int, seed: int = 0, steps: int = 100):
    """The state in which a policy's episodes end."""
    rng, player = make_rng(seed), terrella.load_policy(policy, world.spec)
    state, memory = world.start(batch, rng), player.begin(batch, rng)
    for _ in range(steps):
        if state["done"].all():
            break
        action, memory = player.act(world.render(state, ("expert",)), memory, rng)
        state = world.imagine(state, action, rng)
    return state


def test_the_contract_holds(table):
    assert "a_batch_equals_its_singles" in check_world(table, steps=2)
    assert table.spec.action_names == ("x", "y", "z", "grip") and table.spec.idle == (0, 0, 0, 0)
    assert not {"qpos", "qvel", "contacts", "sensor.hand"} & set(table.spec.channels), "they hold where things are"


@pytest.mark.parametrize("task", TASKS)
def test_the_teacher_does_every_task(task):
    world = terrella.load(f"mujoco:table:{task}", **BLIND)
    state = played(world, "teacher:0.1", 2, seed=1)
    assert state["success"].all() and state["done"].all()
    assert {TASKS[at] for at in state["job"][:, 0].tolist()} == {task}


@pytest.mark.parametrize("policy", ["idle", "random"])
def test_nothing_is_done_by_resting_or_by_chance(table, policy):
    state = played(table, policy, 8, steps=20)
    assert not state["success"].any() and not state["done"].any()


def test_instructions_name_the_job_in_the_wordings_of_training_or_in_others(table):
    unseen = terrella.load("mujoco:table:all:unseen", **BLIND)
    for world, column in ((table, 0), (unseen, 1)):
        state = world.start(200, make_rng(0))
        texts = [bytes_to_text(row.numpy()) for row in world.render(state, ("text",))["text"]]
        assert len(set(texts)) > 50 and {TASKS[at] for at in state["job"][:, 0].tolist()} == set(ALONE)
        patterns = {one.split(" ")[0] for pair in WORDINGS.values() for one in pair[column]}
        assert {text.split(" ")[0] for text in texts} <= patterns
    train, other = ({one for pair in WORDINGS.values() for one in pair[at]} for at in (0, 1))
    assert len(train) == len(other) == 3 * len(TASKS) and not train & other


def test_things_are_apart_and_elsewhere_in_every_episode(table):
    state = table.start(300, make_rng(3))
    blocks = table.task.scene(table.layout, state).blocks[..., :2]
    apart = torch.cdist(blocks, blocks) + torch.eye(3) > 0.09 - 1e-6
    assert apart.all() and blocks.flatten(1).unique(dim=0).shape[0] == 300
    again = table.start(300, make_rng(3))
    assert torch.equal(again["physics"], state["physics"]) and torch.equal(again["job"], state["job"])


def moved(world, state, **places):
    """The state with blocks ("red", ...) or the cup put elsewhere [3], m; all rows alike."""
    columns = list(range(world.layout.qpos.start, world.layout.qpos.stop))[-PLACED:]
    physics = state["physics"].clone()
    for name, place in places.items():
        first = 7 * ("red", "green", "blue", "cup").index(name)
        physics[:, columns[first : first + 3]] = torch.tensor(place, dtype=torch.float64)
    return state.replace(physics=physics)


def test_success_is_a_matter_of_the_state(table):
    rest = table.start(1, make_rng(0)).replace(job=torch.tensor([[TASKS.index("stack"), 0, 1, 0]]))

    def succeeds(task, side=0, **places):
        job = torch.tensor([[TASKS.index(task), 0, 1, side]])
        state = moved(table, rest, **places).replace(job=job, began=torch.zeros(1, 3, 2, dtype=torch.float64))
        return bool(table.imagine(state, torch.zeros(1, 4), make_rng(0))["success"][0])

    low, top = BLOCK_M, 3 * BLOCK_M
    assert succeeds("stack", red=(0, 0, top), green=(0, 0, low)) and not succeeds(
        "stack", red=(0, 0.1, low), green=(0, 0, low)
    )
    assert succeeds("place", red=(-0.05, -0.24, low + 0.01), cup=(-0.05, -0.24, 0.002), green=(0, 0, low))
    assert not succeeds("place", red=(-0.05, 0.1, low), cup=(-0.05, -0.24, 0.002))
    assert succeeds("push", 1, red=(0, 0.06, low)) and not succeeds("push", 0, red=(0, 0.06, low))
    assert succeeds("push", 0, red=(0, -0.06, low)) and not succeeds("push", 0, red=(0.05, -0.06, low))
    assert succeeds("pick", red=(0, 0, 0.2)) and not succeeds("pick", red=(0, 0, low))


def test_the_hand_goes_where_it_is_sent_and_points_down(table):
    rng, state = make_rng(0), table.start(1, make_rng(0))
    began = table.render(state, ("hand",))["hand"][0].numpy()
    for _ in range(8):
        state = table.imagine(state, torch.tensor([[0.1, -0.1, -0.05, -1.0]]), rng)
    hand = table.render(state, ("hand",))["hand"][0].numpy()
    np.testing.assert_allclose(hand[:3] - began[:3], [0.08, -0.08, -0.04], atol=0.015)
    assert hand[3] < 0.002 < 0.07 < began[3], "the gripper has closed"
    for _ in range(20):  # it stops above the table
        state = table.imagine(state, torch.tensor([[0.0, 0.0, -0.25, 0.0]]), rng)
    assert 0.005 < table.render(state, ("hand",))["hand"][0, 2] < 0.02


def test_what_is_unknown_is_named_with_what_there_is(table):
    with pytest.raises(TerrellaError, match="no task 'stak'; did you mean 'stack'.*all, all:unseen, reach"):
        terrella.load("mujoco:table:stak", **BLIND)
    with pytest.raises(TerrellaError, match="no task 'pick:3'"):
        terrella.load("mujoco:table:pick:3", **BLIND)
    with pytest.raises(TerrellaError, match="no robot 'table-ur9'.*table"):
        terrella.load("mujoco:table-ur9", **BLIND)
    with pytest.raises(TerrellaError, match="noise of its actions, 0 to 1"):
        terrella.load_policy("teacher:2", table.spec)
    with pytest.raises(TerrellaError, match="has no teacher.*mujoco:table"):
        terrella.load_policy("teacher", terrella.load("mujoco:arm", **BLIND).spec)


@pytest.mark.parametrize(("body", "package"), [("yam", "mjlab"), ("panda", "robotblockset")])
def test_other_bodies_pick_a_block_up_or_say_what_to_install(body, package):
    if find_spec(package) is None:
        with pytest.raises(TerrellaError, match=f"pip install --no-deps {package}"):
            terrella.load(f"mujoco:table-{body}", **BLIND)
        return
    assert played(terrella.load(f"mujoco:table-{body}:pick", **BLIND), "teacher", 1)["success"].all()
