"""Muon: an optimiser with orthogonalised steps of weight matrices, so that all their directions are learned at one rate."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import nn

from .learners import Ema, Learner
from .train_step import TrainStep

ROUNDS, QUINTIC = 5, (3.4445, -4.7750, 2.0315)  # of Newton and Schulz; the polynomial is Jordan's
MOMENTUM = 0.95
LIKE_ADAM = 0.2  # the root mean square of AdamW's steps, in learning rates (Liu et al. 2025, "Muon is scalable for LLM training")
BETAS, EPSILON = (0.9, 0.99), 1e-8


class Muon(torch.optim.Optimizer):
    """Orthogonalised momentum for `matrices` (weights of convolutions as matrices, one row for each output), AdamW for `others`.
    Jordan et al. 2024, https://kellerjordan.github.io/posts/muon. The learning rate is on the scale of AdamW for both.

    PyTorch's own Muon takes two-dimensional matrices alone, and needs another optimiser beside it.
    """

    def __init__(
        self, matrices: Sequence[nn.Parameter], others: Sequence[nn.Parameter], rate: float = 2e-3, decay: float = 1e-4
    ):
        groups = [{"params": list(matrices), "matrices": True}, {"params": list(others), "matrices": False}]
        super().__init__([group for group in groups if group["params"]], {"lr": rate, "decay": decay})

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> None:  # type: ignore[override]
        assert closure is None, "closures are not supported."
        for group in self.param_groups:
            direction = self._momentum if group["matrices"] else self._adam
            for weight in group["params"]:
                if weight.grad is not None:
                    weight.mul_(1 - group["lr"] * group["decay"]).sub_(
                        direction(weight, weight.grad), alpha=group["lr"]
                    )

    def _momentum(self, weight: nn.Parameter, gradient: torch.Tensor) -> torch.Tensor:
        state = self.state[weight]
        if "mean" not in state:
            state["mean"] = torch.zeros_like(weight)
        mean = state["mean"].lerp_(gradient, 1 - MOMENTUM)
        step = orthogonal(gradient.lerp(mean, MOMENTUM).flatten(1))
        return step.reshape(weight.shape) * (LIKE_ADAM * max(step.shape) ** 0.5)

    def _adam(self, weight: nn.Parameter, gradient: torch.Tensor) -> torch.Tensor:
        state = self.state[weight]
        if "mean" not in state:
            state["step"] = torch.zeros(())
            state["mean"], state["square"] = torch.zeros_like(weight), torch.zeros_like(weight)
        state["step"] += 1
        count = float(state["step"])
        mean = state["mean"].lerp_(gradient, 1 - BETAS[0]) / (1 - BETAS[0] ** count)
        square = state["square"].lerp_(gradient.square(), 1 - BETAS[1]) / (1 - BETAS[1] ** count)
        return mean / (square.sqrt() + EPSILON)


def orthogonal(matrix: torch.Tensor) -> torch.Tensor:
    """Approximately U V^T of `matrix` [m, n] = U S V^T: singular values become 0.7 to 1.2, whatever their scale was."""
    first, third, fifth = QUINTIC
    x = matrix / (matrix.norm() + 1e-7)
    x = x.T if len(x) > x.shape[1] else x
    square, steps = x @ x.T, []  # each round multiplies x by a polynomial of the small `square`
    for _ in range(ROUNDS):
        step = torch.addmm(third * square, square, square, alpha=fifth)
        step.diagonal().add_(first)
        square = step @ square @ step
        steps.append(step)
    x = torch.linalg.multi_dot([*reversed(steps), x])
    return x if x.shape == matrix.shape else x.T


def muon(
    modules: Sequence[nn.Module],
    rate: Callable[[TrainStep], float],
    heads: Sequence[nn.Module] = (),
    average: Ema[Any] | None = None,
) -> Learner:
    """Muon for the matrices of the modules, AdamW for their vectors and for `heads`, the last layers."""
    own = {id(weight) for head in heads for weight in head.parameters()}
    weights = [weight for module in modules for weight in module.parameters()]
    matrices = [weight for weight in weights if weight.ndim > 1 and id(weight) not in own]
    return Learner(Muon(matrices, [w for w in weights if w.ndim < 2 or id(w) in own]), modules, rate, average)
