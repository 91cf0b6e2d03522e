"""Muon: an optimiser with orthogonalised steps of weight matrices, so that all their directions are learned at one rate."""

from collections.abc import Callable, Sequence
from functools import reduce
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

    capturable = True  # in a CUDA graph

    def __init__(
        self, matrices: Sequence[nn.Parameter], others: Sequence[nn.Parameter], rate: float = 2e-3, decay: float = 1e-4
    ):
        groups = [{"params": list(matrices), "matrices": True}, {"params": list(others), "matrices": False}]
        super().__init__([group for group in groups if group["params"]], {"lr": rate, "decay": decay})

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> None:  # type: ignore[override]
        """Rates may be tensors; without a wait for the device."""
        assert closure is None, "closures are not supported."
        for group in self.param_groups:
            rate = group["lr"]
            weights: list[torch.Tensor] = [weight for weight in group["params"] if weight.grad is not None]
            gradients = [weight.grad for weight in weights if weight.grad is not None]
            if weights:
                steps = (self._momentum if group["matrices"] else self._adam)(weights, gradients)
                torch._foreach_mul_(weights, 1 - rate * group["decay"])
                torch._foreach_mul_(steps, rate)
                torch._foreach_sub_(weights, steps)

    def _kept(self, weights: Sequence[torch.Tensor], name: str) -> list[torch.Tensor]:
        """What is kept of each weight under this name; zeros at first."""
        for weight in weights:
            state = self.state[weight]
            if name not in state:
                state[name] = weight.new_zeros(()) if name == "step" else torch.zeros_like(weight)
            state[name] = state[name].to(weight.device)  # saved counts are loaded to the CPU
        return [self.state[weight][name] for weight in weights]

    def _momentum(self, weights: list[torch.Tensor], gradients: list[torch.Tensor]) -> list[torch.Tensor]:
        means = self._kept(weights, "mean")
        torch._foreach_lerp_(means, gradients, 1 - MOMENTUM)
        flat = [each.flatten(1) for each in torch._foreach_lerp(gradients, means, MOMENTUM)]
        wide = [each.T if len(each) > each.shape[1] else each for each in flat]
        steps = list(wide)
        for shape in {each.shape for each in wide}:  # those of one shape at once
            places = [place for place, each in enumerate(wide) if each.shape == shape]
            scaled = orthogonal(torch.stack([wide[place] for place in places])) * (LIKE_ADAM * max(shape) ** 0.5)
            for place, step in zip(places, scaled):
                steps[place] = (step if step.shape == flat[place].shape else step.T).reshape(weights[place].shape)
        return steps

    def _adam(self, weights: list[torch.Tensor], gradients: list[torch.Tensor]) -> list[torch.Tensor]:
        means, squares, counts = (self._kept(weights, name) for name in ("mean", "square", "step"))
        torch._foreach_add_(counts, 1)
        torch._foreach_lerp_(means, gradients, 1 - BETAS[0])
        torch._foreach_lerp_(squares, torch._foreach_mul(gradients, gradients), 1 - BETAS[1])
        steps, sizes = (torch._foreach_div(sums, 1 - beta ** counts[0]) for sums, beta in zip((means, squares), BETAS))
        torch._foreach_sqrt_(sizes)
        torch._foreach_add_(sizes, EPSILON)
        torch._foreach_div_(steps, sizes)
        return list(steps)


def orthogonal(matrices: torch.Tensor) -> torch.Tensor:
    """Approximately U V^T of each of the `matrices` [N, m, n] = U S V^T: singular values become 0.7 to 1.2, whatever their scale
    was. Fastest with m <= n."""
    first, third, fifth = QUINTIC
    x = matrices / (matrices.norm(dim=(1, 2), keepdim=True) + 1e-7)
    square, steps = x @ x.mT, []  # each round multiplies x by a polynomial of the small `square`
    while len(steps) < ROUNDS:
        square = steps[-1] @ square @ steps[-1] if steps else square
        step = torch.baddbmm(square, square, square, beta=third, alpha=fifth)
        step.diagonal(dim1=1, dim2=2).add_(first)
        steps.append(step)
    return reduce(lambda whole, step: step @ whole, steps) @ x


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
