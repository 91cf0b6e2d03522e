"""CUDA graphs without a card: a capture notes each call of an operator and undoes what it wrote, as a card runs none of them
then; a replay runs them again on the same tensors."""

from contextlib import contextmanager, nullcontext
from types import SimpleNamespace

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves


class Distant(torch.Tensor):
    """A tensor that says that it lies on a GPU."""

    device = torch.device("cuda")  # type: ignore[assignment]


def distant(tensor: torch.Tensor) -> torch.Tensor:
    return tensor.as_subclass(Distant)


class Graph(TorchDispatchMode):
    made = 0

    def __init__(self):
        super().__init__()
        Graph.made += 1
        self.calls, self.known = [], {}

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        if function is torch.ops.aten._local_scalar_dense.default:
            raise RuntimeError("operation not permitted when stream is capturing")
        for one in _storages((args, kwargs)):
            self.known.setdefault(one.data_ptr(), (one, one.clone()))
        out = function(*args, **(kwargs or {}))
        for one in _storages(out):
            self.known.setdefault(one.data_ptr(), (one, None))
        self.calls.append((function, args, kwargs or {}, out))
        return out

    def undo(self) -> None:
        for one, before in self.known.values():
            if before is not None:
                one.copy_(before)

    @torch.no_grad()
    def replay(self) -> None:
        for function, args, kwargs, out in self.calls:
            for place, value in zip(tree_leaves(out), tree_leaves(function(*args, **kwargs))):
                if isinstance(place, torch.Tensor) and place.data_ptr() != value.data_ptr():
                    place.copy_(value)


def _storages(tree) -> list[torch.UntypedStorage]:
    return [one.untyped_storage() for one in tree_leaves(tree) if isinstance(one, torch.Tensor)]


@contextmanager
def _graph(graph: Graph):
    with graph:
        yield
    graph.undo()


def stand_in(monkeypatch) -> type[Graph]:
    """Replaces the graphs of torch.cuda; `made` of the result counts them."""
    Graph.made, stream = 0, SimpleNamespace(wait_stream=lambda other: None)
    fakes = {"CUDAGraph": Graph, "graph": _graph, "Stream": lambda: stream, "current_stream": lambda: stream}
    for name, fake in {**fakes, "stream": lambda given: nullcontext()}.items():
        monkeypatch.setattr(torch.cuda, name, fake)
    return Graph
