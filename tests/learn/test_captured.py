"""What training has captured as CUDA graphs, on a stand-in for them: replays read new gradients, rates and weights, and wait for
nothing."""

import pytest
import torch
from tests.learn.graph_stand_in import distant, stand_in
from torch import nn

from terrella.learn.learners import Ema
from terrella.learn.muon import muon
from terrella.learn.update import Update


class Twin:
    """A network with its updates; the same numbers for the same seed."""

    def __init__(self):
        torch.manual_seed(0)
        self.net = nn.Sequential(nn.Conv2d(3, 8, 3), nn.SiLU(), nn.Conv2d(8, 2, 1))
        self.average = Ema(self.net, 0.995)
        self.learner = muon((self.net,), lambda now: 0.0, heads=(self.net[2],), average=self.average)
        self.update = Update(self.learner)

    def take(self, step: int, captured: bool, finite: bool = True) -> bool:
        rng = torch.Generator().manual_seed(step)
        for group in self.learner.optimiser.param_groups:
            group["lr"] = 0.02 / (1 + step)
        for weight in self.net.parameters():
            noise = torch.randn(weight.shape, generator=rng) * (1.0 if finite else torch.nan)
            weight.grad = noise if weight.requires_grad else None
        made = (self.update if captured else self.update.run)(distant(torch.tensor(True)))
        return bool(made.as_subclass(torch.Tensor))

    def numbers(self):
        kept = [each for state in self.learner.optimiser.state.values() for each in state.values()]
        return [*self.net.parameters(), *self.average.state_dict().values(), *kept]


def assert_same(one: Twin, other: Twin) -> None:
    for mine, theirs in zip(one.numbers(), other.numbers(), strict=True):
        torch.testing.assert_close(mine, theirs)


def test_updates_of_a_graph_are_those_kernel_by_kernel(monkeypatch):
    graphs, one, other = stand_in(monkeypatch), Twin(), Twin()
    for step in range(6):
        assert one.take(step, True, step != 4) == other.take(step, False, step != 4) == (step != 4)
        assert_same(one, other)
    assert graphs.made == 1 and one.learner.optimiser.param_groups[0]["lr"] == 0.02 / 6


def test_weights_that_are_no_longer_learned_need_another_graph(monkeypatch):
    graphs, one, other = stand_in(monkeypatch), Twin(), Twin()
    for step in range(6):
        if step == 3:
            for each in (one, other):
                each.net[0].requires_grad_(False)
        one.take(step, True)
        other.take(step, False)
        assert_same(one, other)
    assert graphs.made == 2


def test_a_first_update_without_memory_is_no_warm_up(monkeypatch):
    """What the optimiser keeps must not be made within the graph, which would begin it anew at every step."""
    graphs, one, other = stand_in(monkeypatch), Twin(), Twin()
    step = one.learner.optimiser.step
    monkeypatch.setattr(one.learner.optimiser, "step", lambda: (_ for _ in ()).throw(RuntimeError("out of memory")))
    with pytest.raises(RuntimeError, match="memory"):
        one.take(0, True)
    monkeypatch.setattr(one.learner.optimiser, "step", step)
    for number in range(4):
        one.take(number, True)
        other.take(number, False)
    assert_same(one, other)
    assert graphs.made == 1
