"""A step as one traced, compiled program gives what the world's own step gives, whatever the batch, and while its arena grows."""

from __future__ import annotations

from typing import Any

import pytest
import torch

import terrella
from terrella.core import chance, make_rng
from terrella.core.backend import tensor_programs
from terrella.core.state import State
from terrella.worlds import step_program
from terrella.worlds.controls import Controls
from terrella.worlds.step_program import StepPrograms

from .made import place
from .test_dispatch import flow, latent

MADE = {
    "with depth": lambda: place(Controls.buttons(3)),
    "flow": lambda: flow(0),
    "flow that scrolls": lambda: flow(3),
    "latent": lambda: latent(True),
    "arm": lambda: latent(False),
}


def walk(world, step, batch: int, steps: int):
    rng = make_rng(1)
    with tensor_programs(), torch.no_grad():
        state = world.start(batch, rng)
        for number in range(steps):
            action = world.spec.sample_action(batch, make_rng(number))
            state = step(state, world.controls.encode(action), chance.seeds(batch, rng))
        return State({name: state[name] for name in state}, state.arenas)  # with its frame drawn, in the same way


def slow(*case):
    return pytest.param(*case, marks=pytest.mark.slow)  # compilers take a minute for a world with depth


CASES = [
    ("with depth", None), slow("flow", "aot_eager"),
    slow("flow that scrolls", "aot_eager"), slow("latent", "aot_eager"), ("arm", "aot_eager"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "compiler"), CASES)
def test_the_whole_step_compiles_and_gives_the_same(name, compiler):
    world = MADE[name]()
    steps = StepPrograms(world, compiler)
    mine, program = walk(world, world.advance, 2, 3), walk(world, steps, 2, 3)
    assert steps.programs[2].way == (f"torch.compile ({compiler})" if compiler else "traced")
    assert set(mine) == set(program) and set(steps.programs) == {2}
    for part in set(mine) - set(mine.arenas):
        torch.testing.assert_close(
            program[part], mine[part], atol=2e-3, rtol=1e-3, msg=lambda text, part=part: f"{part}: {text}"
        )


def test_parts_that_share_a_tensor_are_traced_apart():
    """The first state of a latent world has one tensor of zeros for its reward, its spread and the probability of its end."""
    torch.manual_seed(1)  # episodes end at once, so that the last step keeps what was
    world = latent(True)
    mine, program = walk(world, world.advance, 2, 3), walk(world, StepPrograms(world, None), 2, 3)
    assert mine["done"].all()
    torch.testing.assert_close(program["done_probability"], mine["done_probability"], atol=2e-3, rtol=1e-3)


@pytest.mark.slow
def test_a_bundled_world_compiles_whole():
    """Of them all the one with the most parts: things that move, rewards and vitals."""
    world: Any = terrella.load("doom-corridor")
    steps = StepPrograms(world, "aot_eager")
    mine, program = walk(world, world.advance, 1, 2), walk(world, steps, 1, 2)
    assert steps.programs[1].way == "torch.compile (aot_eager)"
    off = (mine["rgb"].int() - program["rgb"].int()).abs()
    assert float((off > 2).float().mean()) < 2e-3


def test_an_arena_that_grows_is_no_other_world(monkeypatch):
    monkeypatch.setattr(step_program, "ROOM", 8)
    world = place(Controls.buttons(3))
    steps = StepPrograms(world, None)
    with tensor_programs():
        forks = [walk(world, steps, 1, 2) for _ in range(step_program.ROOM * 3)]
    assert all(forks[0] == fork for fork in forks[1:])


def test_where_a_step_cannot_be_captured_it_runs_as_it_is(monkeypatch):
    def failing(run, inputs):
        raise torch.OutOfMemoryError("CUDA out of memory.\nTried to allocate")

    monkeypatch.setattr(step_program, "captured", failing)
    with pytest.warns(UserWarning, match=r"CUDA graphs fail here \(CUDA out of memory.\); steps run kernel by kernel"):
        run, way = step_program.with_graph(list, [], "traced")
    assert (run, way) == (list, "traced")


@pytest.mark.exact
def test_without_a_compiler_a_step_runs_as_it_is(monkeypatch):
    world = place(Controls.buttons(3))

    def broken(graph, **options):
        def run(inputs):
            raise RuntimeError("no compiler is installed")

        return run

    monkeypatch.setattr(torch, "compile", broken)
    steps = StepPrograms(world)
    with pytest.warns(
        UserWarning, match=r"torch.compile fails here \(no compiler is installed\); steps run uncompiled"
    ):
        walked = walk(world, steps, 1, 2)
    assert steps.programs[1].way == "traced" and walked == walk(world, world.advance, 1, 2)
