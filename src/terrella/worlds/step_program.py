"""A world's step as one program: traced once for each batch size into a graph of tensor operators, compiled as a whole, and on a
GPU captured as a CUDA graph, so that a step costs one launch.

Tracing fails where a step looks at a value: such a step would wait for the device.
"""

from __future__ import annotations

import threading
import warnings
from collections.abc import Callable, Mapping
from contextlib import ExitStack, nullcontext
from dataclasses import dataclass
from typing import Protocol

import torch
from torch.fx.experimental.proxy_tensor import make_fx

from ..core.backend import tensor_programs
from ..core.errors import reason_of
from ..core.state import State

WARM_UP = 3  # runs before a capture, in which libraries choose their algorithms
ROOM = 64  # steps that an arena has room for beyond a full memory, before it has to be tidied

Run = Callable[[list[torch.Tensor]], list[torch.Tensor]]


class Advancing(Protocol):
    """A world with the part of `imagine` that is tensors alone."""

    def advance(self, state: State, numbers: torch.Tensor, seeds: torch.Tensor, /) -> State: ...


@dataclass(frozen=True)
class StepProgram:
    """A step of one batch size: the names of the state's tensors before and after, the arenas and how large they were, the traced
    graph, what runs it, and how."""

    before: tuple[str, ...]
    after: tuple[str, ...]
    rooms: Mapping[str, int]
    graph: torch.fx.GraphModule
    run: Run
    way: str

    def fits(self, state: State) -> bool:
        """Whether the program is of states like this one, whose arenas have not grown since."""
        rooms = {name: arena.capacity for name, arena in state.arenas.items()}
        return self.before == tuple(sorted(state)) and self.rooms == rooms


class StepPrograms:
    """`StepPrograms(world)(state, numbers, seeds)` is `world.advance(state, numbers, seeds)`, without gradients. compiler: a
    backend of torch.compile; None: the traced graph runs as it is."""

    def __init__(self, world: Advancing, compiler: str | None = "inductor"):
        self.world, self.compiler = world, compiler
        self.programs: dict[int, StepProgram] = {}
        self._lock = threading.Lock()  # a captured graph has one place for its inputs

    def __call__(self, state: State, numbers: torch.Tensor, seeds: torch.Tensor) -> State:
        with self._lock, torch.inference_mode(False), torch.no_grad():
            program = self.programs.get(state.batch)
            if program is None or not program.fits(state):
                program = self.programs[state.batch] = self._made(state, numbers, seeds)
            rows = [arena.reserve(state.batch) for arena in state.arenas.values()]
            if not program.fits(state):  # the arena had to grow for that
                return self.world.advance(state, numbers, seeds)
            inputs = [*(state[name] for name in program.before), numbers, seeds, *rows]
            made = program.run([part.contiguous() for part in inputs])  # entries of a fork share their memory
        return State(dict(zip(program.after, made)), state.arenas)

    def _made(self, state: State, numbers: torch.Tensor, seeds: torch.Tensor) -> StepProgram:
        for name, arena in state.arenas.items():
            arena.make_room(state[name].numel() + ROOM * state.batch)
        with _as_a_device(state.device):
            dict(
                self.world.advance(state, numbers, seeds)
            )  # makes the constants of all that is drawn, outside of the trace
        rows = [arena.reserve(state.batch) for arena in state.arenas.values()]
        inputs = [*(state[name] for name in sorted(state)), numbers, seeds, *rows]
        # a tensor that stands for two inputs would be traced as one
        inputs = [part.clone(memory_format=torch.contiguous_format) for part in inputs]
        graph, after = traced(self.world, state, inputs)
        run, way = compiled(graph, inputs, self.compiler)
        if state.device.type == "cuda":
            run, way = with_graph(run, inputs, way)
        rooms = {name: arena.capacity for name, arena in state.arenas.items()}
        return StepProgram(tuple(sorted(state)), after, rooms, graph, run, way)


def traced(world: Advancing, like: State, inputs: list[torch.Tensor]) -> tuple[torch.fx.GraphModule, tuple[str, ...]]:
    """A step as a graph of operators, and the names of the tensors that it gives. inputs: the state's tensors in the order of
    their names, action numbers, seeds, and for each arena the rows that the step writes."""
    names, arenas, after = tuple(sorted(like)), dict(like.arenas), []

    def step(given: list[torch.Tensor]) -> list[torch.Tensor]:
        numbers, seeds, *rows = given[len(names) :]
        with ExitStack() as stack:
            stack.enter_context(_as_a_device(like.device))
            for arena, mine in zip(arenas.values(), rows):
                stack.enter_context(arena.writing_to(mine))
            state = world.advance(State(dict(zip(names, given)), arenas), numbers, seeds)
            after[:] = tuple(state)
            return [state[name] for name in state]

    return make_fx(step, tracing_mode="real")(inputs), tuple(after)


def compiled(graph: torch.fx.GraphModule, inputs: list[torch.Tensor], compiler: str | None) -> tuple[Run, str]:
    """What runs the graph, and how. Where the compiler fails, as without one on this machine, the graph runs as it is, with a
    warning."""
    if compiler is None:
        return graph, "traced"
    run: Run = torch.compile(graph, fullgraph=True, dynamic=False, backend=compiler)
    try:
        run(inputs)
    except Exception as error:  # compilers fail in many ways
        warnings.warn(f"torch.compile fails here ({reason_of(error)}); steps run uncompiled.", stacklevel=2)
        return graph, "traced"
    return run, f"torch.compile ({compiler})"


def with_graph(run: Run, inputs: list[torch.Tensor], way: str) -> tuple[Run, str]:
    """`run` as a CUDA graph, and how it runs then. Where that fails it stays as it is, with a warning."""
    try:
        return captured(run, inputs), f"{way}, captured as a CUDA graph"
    except RuntimeError as error:  # of the driver, or for lack of memory
        warnings.warn(f"CUDA graphs fail here ({reason_of(error)}); steps run kernel by kernel.", stacklevel=2)
        return run, way


def captured(run: Run, inputs: list[torch.Tensor]) -> Run:
    """`run` as a CUDA graph: its inputs are copied to fixed places, its outputs from them."""
    fixed = [part.clone() for part in inputs]
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        for _ in range(WARM_UP):
            run(fixed)
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    # a capture that fails leaves its own stream in force
    with torch.cuda.stream(torch.cuda.current_stream()), torch.cuda.graph(graph):
        made = run(fixed)

    def replay(given: list[torch.Tensor]) -> list[torch.Tensor]:
        torch._foreach_copy_(fixed, given)
        graph.replay()
        return [part.clone() for part in made]

    return replay


def _as_a_device(device: torch.device):
    """A CPU takes the way of a GPU here, since kernels of numba cannot be traced."""
    return tensor_programs() if device.type == "cpu" else nullcontext()
