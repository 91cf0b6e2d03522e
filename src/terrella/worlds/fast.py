"""Fast play: on a CPU a world's generator through ONNX Runtime, on a GPU its steps as CUDA graphs, where that is faster.

The graph is made in memory when the world is loaded; nothing is stored and nothing unpickled.
"""

import copy
import statistics
import threading
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from torch import nn

from ..core import chance
from ..core.errors import TerrellaError
from ..core.world import make_rng
from ..space.keyframes import Glimpse
from .generator import Conditioning, UNet
from .learned import LearnedWorld
from .parts import newest_frame
from .step_program import StepPrograms

Forward = Callable[..., torch.Tensor]
TURNS = 15  # frames that each way draws in the comparison


@dataclass(frozen=True)
class Choice:
    """The faster way; milliseconds a frame, on a CPU of the generator alone, medians of alternating runs; seconds to prepare it."""

    way: str
    eager_ms: float
    other_ms: float
    prepared_s: float

    def __str__(self) -> str:
        other = f"{self.other_ms:.1f} ms" if self.way != EAGER else f"no faster way was found ({self.other_ms:.1f} ms)"
        return f"{self.way}: {other}, eager torch {self.eager_ms:.1f} ms; {self.prepared_s:.1f} s to prepare"


EAGER, ONNX = "eager torch", "ONNX Runtime"


def faster(world: LearnedWorld) -> tuple[LearnedWorld, Choice]:
    """The world with the faster of two ways, and which it is: on a CPU eager torch or ONNX Runtime for the generator; on a GPU
    steps as they are or as compiled programs, CUDA graphs (step_program.py), which have no gradients. TerrellaError where ONNX
    Runtime is not installed."""
    return with_faster_generator(world) if world.device.type == "cpu" else with_step_programs(world)


def with_step_programs(world: LearnedWorld, compiler: str | None = "inductor") -> tuple[LearnedWorld, Choice]:
    """The world whose steps are programs of one launch, one for each batch size, made when the size is first met, if they are
    faster than its steps as they are."""
    began, rng = time.perf_counter(), make_rng(0)
    quick = world.replaced()
    programs = quick.stepper = StepPrograms(quick, compiler)
    state, action = world.start(1, rng), world.spec.sample_action(1, rng)

    def frame(one: LearnedWorld) -> torch.Tensor:
        return newest_frame(one.imagine(state, action, rng))

    with torch.inference_mode():
        frame(quick)
        prepared = time.perf_counter() - began
        eager_ms, program_ms = alternating_ms([lambda: frame(world), lambda: frame(quick)])
    choice = Choice(programs.programs[1].way if program_ms < eager_ms else EAGER, eager_ms, program_ms, prepared)
    chosen = world.replaced(card={"fast": str(choice)})
    if program_ms < eager_ms:
        chosen.stepper = programs
    return chosen, choice


def with_faster_generator(world: LearnedWorld) -> tuple[LearnedWorld, Choice]:
    """The world whose generator draws by ONNX Runtime, if that is faster on this CPU. Frames that need a gradient are drawn by
    eager torch."""
    generator: nn.Module = copy.deepcopy(world.generator)
    if not isinstance(generator, UNet):
        raise TerrellaError("--fast is for worlds with depth and poses; play this one without it.")
    inputs = example_inputs(world)
    began = time.perf_counter()
    eager: Forward = generator.forward
    other = onnx_forward(generator, inputs)
    with torch.inference_mode():
        other(*inputs)
        prepared = time.perf_counter() - began
        slow, quick = alternating_ms([lambda: eager(*inputs), lambda: other(*inputs)])
    wins = quick < slow
    if wins:
        vars(generator)["forward"] = _either(eager, other)
    choice = Choice(ONNX if wins else EAGER, slow, quick, prepared)
    return world.replaced(generator=generator, card={"fast": str(choice)}), choice


def _either(eager: Forward, quick: Forward) -> Forward:
    """`eager` where a gradient is needed, else `quick`."""

    def forward(*given) -> torch.Tensor:
        learns = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in _flat(given))
        return eager(*given) if learns else quick(*given)

    return forward


def example_inputs(world: LearnedWorld) -> tuple[torch.Tensor, torch.Tensor, Conditioning]:
    """Inputs of the generator for a frame of one episode: noise, flow time and conditioning."""
    rng = make_rng(0)
    state = world.start(1, rng)
    numbers = world.controls.encode(world.spec.sample_action(1, rng)).to(world.device)
    state, after = world.move(state, numbers)
    conditioning = world.look(after, state)
    noise = chance.normal(chance.seeds(1, rng, world.device), (4, *world.size))
    return noise, torch.zeros(1, device=world.device), conditioning


def onnx_forward(generator: nn.Module, inputs: tuple) -> Forward:
    """The generator in ONNX Runtime on the CPU, for any batch, with torch's number of threads."""
    # torch writes graphs with onnx
    if missing := [package for package in ("onnxruntime", "onnx") if not find_spec(package)]:
        raise TerrellaError(
            f"Fast play needs {' and '.join(missing)}: pip install 'terrella[fast]', or leave --fast out."
        )
    import onnxruntime

    graph, sessions, lock = _exported(generator, inputs), {}, threading.Lock()

    def forward(*given) -> torch.Tensor:
        threads = torch.get_num_threads()
        with lock:
            session = sessions.get(threads)
            if session is None:
                options = onnxruntime.SessionOptions()
                options.intra_op_num_threads = threads
                options.add_session_config_entry(
                    "session.intra_op.allow_spinning", "0"
                )  # leave the cores to other threads
                session = onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
                sessions.clear()
                sessions[threads] = session
        tensors = [tensor.numpy() for tensor in _flat(given)]
        wanted = [node.name for node in session.get_inputs()]
        return torch.from_numpy(session.run(None, {name: tensors[int(name[1:])] for name in wanted})[0])

    return forward


def alternating_ms(ways: list[Callable[[], object]], turns: int = TURNS) -> list[float]:
    """Median milliseconds of each way, run alternately so that all meet the same load."""
    times: list[list[float]] = [[] for _ in ways]
    for _ in range(turns):
        for way, took in zip(ways, times):
            began = time.perf_counter()
            way()
            if torch.cuda.is_available():
                torch.cuda.synchronize()
            took.append((time.perf_counter() - began) * 1e3)
    return [statistics.median(took) for took in times]


def _exported(generator: nn.Module, inputs: tuple) -> bytes:
    """The generator as an ONNX graph for any batch."""

    class Flat(nn.Module):
        """Takes tensors, since a graph has no dataclasses."""

        def __init__(self):
            super().__init__()
            self.generator = generator

        def forward(self, *tensors: torch.Tensor) -> torch.Tensor:
            noisy, time, *glimpse, last, context = tensors
            return self.generator(noisy, time, Conditioning(Glimpse(*glimpse), last, context))

    tensors = _flat(inputs)
    names = [f"x{number}" for number in range(len(tensors))]
    with warnings.catch_warnings(), torch.no_grad(), TemporaryDirectory() as folder:
        warnings.simplefilter("ignore")  # of torch about its own exporter
        free = {name: {0: "batch"} for name in [*names, "clean"]}
        file = Path(folder, "graph.onnx")
        named = {"input_names": names, "output_names": ["clean"], "dynamic_axes": free}
        torch.onnx.export(Flat(), tuple(tensors), str(file), **named, dynamo=False)
        return file.read_bytes()


def _flat(inputs: tuple) -> list[torch.Tensor]:
    """The tensors of noise, flow time and conditioning."""
    noisy, time, conditioning = inputs
    glimpse = conditioning.glimpse
    return [
        noisy,
        time,
        glimpse.rgb,
        glimpse.trust,
        glimpse.depth,
        glimpse.known,
        conditioning.last,
        conditioning.context,
    ]
