"""What follows a backward pass: gradients are clipped, the optimiser steps, the weights are averaged; on a CUDA device one CUDA
graph."""

from __future__ import annotations

import warnings

import torch
from torch import nn

from ..core.errors import is_out_of_memory, reason_of
from .learners import Learner


class Update:
    """The updates of a learner. `Update(learner)(finite)`, finite bool [] whether the loss is finite, returns whether the gradients
    are, too. Unless they are, a CPU updates nothing; other devices, which are not waited for, take gradients of 0."""

    def __init__(self, learner: Learner):
        self.learner = learner
        self._capturable = getattr(learner.optimiser, "capturable", False)
        self._stepped: list[nn.Parameter] = []  # with gradients in the update before
        self._graph: torch.cuda.CUDAGraph | None = None
        self._fixed: list[torch.Tensor] = []  # places of `finite`, the rates and the gradients that the graph reads
        self._result = torch.empty(0)

    def __call__(self, finite: torch.Tensor) -> torch.Tensor:
        if not self._capturable or finite.device.type != "cuda":
            return self.run(finite)
        weights = [
            weight for module in self.learner.modules for weight in module.parameters() if weight.grad is not None
        ]
        same = len(weights) == len(self._stepped) and all(one is other for one, other in zip(weights, self._stepped))
        if not same:  # the optimiser makes what it keeps, and libraries choose their algorithms
            self._stepped, self._graph = [], None
            finite = self.run(finite)
            self._stepped = weights
            return finite
        gradients = [weight.grad for weight in weights if weight.grad is not None]
        try:
            if self._graph is None:
                self._capture(finite, weights, gradients)
        except RuntimeError as error:
            if is_out_of_memory(error):
                raise
            warnings.warn(f"CUDA graphs fail here ({reason_of(error)}); updates run kernel by kernel.", stacklevel=2)
            self._capturable = False
            return self.run(finite)
        assert self._graph is not None
        rates = [group["lr"] for group in self.learner.optimiser.param_groups]
        for place, rate in zip(self._fixed[1:], rates):
            place.fill_(rate)
        self._fixed[0].copy_(finite)
        torch._foreach_copy_(self._fixed[1 + len(rates) :], gradients)
        self._graph.replay()
        return self._result.clone()

    def run(self, finite: torch.Tensor) -> torch.Tensor:
        """The update, kernel by kernel."""
        learner = self.learner
        for module in learner.modules:
            finite = finite & torch.isfinite(nn.utils.clip_grad_norm_(module.parameters(), learner.clip))
        if finite.device.type == "cpu":
            if not finite:
                return finite
        else:
            for weight in (weight for module in learner.modules for weight in module.parameters()):
                if weight.grad is not None:
                    weight.grad.masked_fill_(~finite, 0)
        learner.optimiser.step()
        if learner.average is not None:
            learner.average.update(learner.modules[0])
        return finite

    def _capture(self, finite: torch.Tensor, weights: list[nn.Parameter], gradients: list[torch.Tensor]) -> None:
        groups = self.learner.optimiser.param_groups
        rates = [group["lr"] for group in groups]
        places = [finite.clone(), *(finite.new_tensor(rate, dtype=torch.float32) for rate in rates)]
        places += [gradient.clone() for gradient in gradients]
        try:
            for group, place in zip(groups, places[1:]):
                group["lr"] = place
            for weight, place in zip(weights, places[1 + len(rates) :]):
                weight.grad = place
            graph = torch.cuda.CUDAGraph()
            # a capture that fails leaves its own stream in force
            with torch.cuda.stream(torch.cuda.current_stream()), torch.cuda.graph(graph):
                self._result = self.run(places[0])
        finally:
            for group, rate in zip(groups, rates):
                group["lr"] = rate
            for weight, gradient in zip(weights, gradients):
                weight.grad = gradient
        self._graph, self._fixed = graph, places
