"""Where training computes: the device by its name, its free memory, and the cores of a busy CPU."""

import math
import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch._functorch import config as functorch_config

from ..core.errors import TrainingError, is_out_of_memory, reason_of

BUSY = 1.5  # processes that run, for each core, from which a machine is busy


def device_named(name: str) -> torch.device:
    """cpu, cuda, or auto (CUDA if there is one, else the CPU). TrainingError for a device that PyTorch does not have here."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.zeros(1, device=device)
        return device
    except (RuntimeError, AssertionError, NotImplementedError, ModuleNotFoundError) as error:
        raise TrainingError(
            f"--device {name}: PyTorch has no such device here ({reason_of(error)}); say cpu, cuda or auto."
        ) from None


def describe_device(name: str) -> str:
    """A device in words: what it is, its memory in GiB or its threads."""
    device = torch.device(name)
    if device.type == "cuda":
        facts = torch.cuda.get_device_properties(device)
        return f"{name} ({facts.name}, {facts.total_memory / 2**30:.0f} GiB)"
    threads = torch.get_num_threads()
    return f"{name} ({threads} thread{'s'[: threads > 1]})" if device.type == "cpu" else name


def free_bytes(device: torch.device) -> float:
    """Memory of a GPU that is free; infinite for other devices, of which PyTorch does not say."""
    return float(torch.cuda.mem_get_info(device)[0]) if device.type == "cuda" else math.inf


def yield_cores() -> None:
    """Sets PyTorch to one thread where other processes use all cores: its threads would wait for each other."""
    if os.getloadavg()[0] > BUSY * (os.cpu_count() or 1):
        torch.set_num_threads(1)


@contextmanager
def one_thread() -> Iterator[None]:
    """Inside, PyTorch computes in one thread: with small tensors, on busy cores, threads wait for each other."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


class Compiled:
    """A function of tensors, compiled at its first call. Where the compiler fails, it runs as it is, which a warning says."""

    def __init__(self, function: Callable[..., Any]):
        self._function, self._fast = function, torch.compile(function, dynamic=False)
        if hasattr(functorch_config, "force_non_lazy_backward_lowering"):  # gradients fail to compile at that call, too
            functorch_config.force_non_lazy_backward_lowering = True

    def __call__(self, *given: Any) -> Any:
        if self._fast is None:
            return self._function(*given)
        try:
            return self._fast(*given)
        except Exception as error:  # compilers fail in many ways
            if is_out_of_memory(error):
                raise
            warnings.warn(f"torch.compile fails here ({reason_of(error)}): training goes on uncompiled.", stacklevel=2)
        self._fast = None
        return self._function(*given)
