"""Which of two ways computes: kernels of numba on a CPU, or programs of tensors, which run on every device and can be compiled."""

from collections.abc import Callable, Hashable, Iterator, MutableMapping
from contextlib import contextmanager
from functools import lru_cache
from typing import Any

import torch
from torch.utils.weak import WeakTensorKeyDictionary

_tensors_alone = False


def kernels_do(tensor: torch.Tensor) -> bool:
    """Whether kernels of numba compute with the tensor: it lies on a CPU, and `tensor_programs` is not in force."""
    return tensor.device.type == "cpu" and not _tensors_alone


@contextmanager
def tensor_programs() -> Iterator[None]:
    """Inside, a CPU takes the way of other devices: for the compiler, and for tests of one way against the other."""
    global _tensors_alone
    before, _tensors_alone = _tensors_alone, True
    try:
        yield
    finally:
        _tensors_alone = before


def constant(make: Callable[..., torch.Tensor], device: torch.device, *given: Hashable) -> torch.Tensor:
    """`make(*given)` on a device, made once: a constant that would be written by kernels, or copied to the device, at every step.
    Nobody may write to it."""
    return _made(make, device, _types(given), *given)


@lru_cache(maxsize=512)
def _made(make: Callable[..., torch.Tensor], device: torch.device, types: Hashable, *given: Hashable) -> torch.Tensor:
    with torch.inference_mode(False), torch.no_grad():
        return make(*given).to(device)


def _types(given: tuple[Hashable, ...]) -> Hashable:
    """The types of numbers, also in tuples: (1,) and (1.0,) are equal, and make tensors of other types."""
    return tuple(_types(one) if isinstance(one, tuple) else type(one) for one in given)


def derived(make: Callable[..., torch.Tensor], source: torch.Tensor, *given: Hashable) -> torch.Tensor:
    """`make(source, *given)`, made once for a tensor and again after it was written to. Nobody may write to it."""
    if source.is_inference():  # nobody counts what is written to it
        return make(source, *given)
    held = _derived.setdefault(source, {})
    version, made = held.get((make, given), (None, None))
    if made is None or version != source._version:
        with torch.inference_mode(False), torch.no_grad():
            made = make(source, *given)
        held[make, given] = source._version, made
    return made


_derived: MutableMapping[torch.Tensor, dict] = WeakTensorKeyDictionary()


def table(*rows: Any) -> torch.Tensor:
    """float32 numbers of nested tuples, for `constant`."""
    return torch.tensor(rows, dtype=torch.float32)


def plus(number: float, tensor: torch.Tensor, times: float = 1) -> torch.Tensor:
    """number + times * tensor, in one kernel."""
    return torch.add(constant(torch.tensor, tensor.device, number), tensor, alpha=times)


def where(mask: torch.Tensor, one: torch.Tensor, other: float) -> torch.Tensor:
    """torch.where(mask, one, other) with a number that is not written to the device at every call."""
    return torch.where(mask, one, constant(torch.tensor, one.device, other))
