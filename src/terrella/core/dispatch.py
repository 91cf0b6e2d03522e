"""What a piece of code dispatches: kernels, waits and crossings between devices. A machine without a GPU can count them, on `meta`
tensors, which have shapes but no values: what has to look at a value fails there."""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path

import torch
import torch.nn.functional as F
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

PACKAGE = str(Path(__file__).parent.parent)
WAITS = ("aten::_local_scalar_dense", "aten::nonzero", "aten::masked_select", "aten::unique_dim", "aten::_unique2")
FREE = ("aten::_unsafe_view", "aten::detach", "aten::empty", "aten::empty_like", "aten::empty_strided", "aten::new_empty",
        "aten::lift_fresh", "prim::device")  # fmt: skip


class _FusedOnCards(TorchFunctionMode):
    """On meta tensors: the operators of which PyTorch has one kernel for CUDA, and many elsewhere. Their result is empty."""

    def __init__(self, counts: Dispatches):
        super().__init__()
        self.counts = counts

    def __torch_function__(self, func, types, args=(), kwargs=None):
        if func in (torch.gru_cell, F.scaled_dot_product_attention) and args[0].is_meta:
            if func is torch.gru_cell:
                (seen, hidden), (of_seen, of_hidden, *biases) = args[:2], args[2:]
                F.linear(seen, of_seen, *biases[:1])
                F.linear(hidden, of_hidden, *biases[1:])
            self.counts.add(str(func.__name__))
            return torch.empty_like(args[1 if func is torch.gru_cell else 0])
        return func(*args, **(kwargs or {}))


class Dispatches(TorchDispatchMode):
    """Counts what is dispatched inside of `with Dispatches(device) as counts`, of tensors on that device: `kernels`, operators that
    compute (views and allocations do not); `waits`, those whose shape depends on values, boolean indices too; `crossings`, copies
    from and to other devices. `by_name` and `by_site`: how often each kernel, and each function of this package, dispatched one."""

    def __init__(self, device: torch.device | str):
        super().__init__()
        self.device = torch.device(device)
        self.kernels, self.waits, self.crossings = 0, 0, 0
        self.by_name: Counter[str] = Counter()
        self.by_site: Counter[str] = Counter()
        self._fused = _FusedOnCards(self)

    def __enter__(self):
        self._fused.__enter__()
        return super().__enter__()

    def __exit__(self, *failure):
        super().__exit__(*failure)
        self._fused.__exit__(*failure)

    def add(self, name: str) -> None:
        """Counts one kernel more."""
        self.kernels += 1
        self.by_name[name] += 1
        self.by_site[_call_site()] += 1

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        result = func(*args, **(kwargs or {}))
        name = func._schema.name
        given = [part for part in tree_leaves((args, kwargs)) if isinstance(part, torch.Tensor)]
        made = [part for part in tree_leaves(result) if isinstance(part, torch.Tensor)]
        here = [part.device.type == self.device.type for part in (*given, *made)]
        if any(here) and not func.is_view and name not in FREE:
            self.add(name)
            masks = name.startswith("aten::index") and any(
                part.dtype in (torch.bool, torch.uint8) for part in given[1:]
            )
            self.waits += name in WAITS or (masks and name != "aten::index_put_" and _selects(args))
            self.crossings += name in ("aten::_to_copy", "aten::copy_") and not all(here)
        return result

    def __str__(self) -> str:
        return f"{self.kernels} kernels, {self.waits} waits, {self.crossings} crossings"


def _call_site() -> str:
    """The innermost function of this package that is running, and its file."""
    frame = sys._getframe(3)
    while frame is not None and (PACKAGE not in frame.f_code.co_filename or frame.f_code.co_filename == __file__):
        frame = frame.f_back
    return "elsewhere" if frame is None else f"{Path(frame.f_code.co_filename).name} {frame.f_code.co_qualname}"


def _selects(args: tuple) -> bool:
    """Whether an index is a mask."""
    indices = args[1] if len(args) > 1 and isinstance(args[1], (list, tuple)) else ()
    return any(isinstance(part, torch.Tensor) and part.dtype in (torch.bool, torch.uint8) for part in indices)
