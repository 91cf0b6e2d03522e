"""An update clips, steps and averages; a gradient that is not finite is no step on a CPU, and of size 0 elsewhere."""

import pytest
import torch
from torch import nn

from terrella.learn.learners import Ema
from terrella.learn.muon import muon
from terrella.learn.update import Update


@pytest.fixture
def net():
    torch.manual_seed(0)
    return nn.Sequential(nn.Conv2d(3, 8, 3), nn.SiLU(), nn.Conv2d(8, 2, 1))


def updated(net, gradient=1.0):
    average = Ema(net, 0.995)
    learner = muon((net,), lambda now: 0.02, heads=(net[2],), average=average)
    for weight in net.parameters():
        weight.grad = torch.full_like(weight, gradient)
    return Update(learner)(torch.tensor(True)), learner, average


def test_it_clips_steps_and_averages(net):
    before = [weight.clone() for weight in net.parameters()]
    finite, learner, average = updated(net)
    assert finite
    assert torch.stack([weight.grad.norm() for weight in net.parameters()]).norm() == pytest.approx(
        learner.clip, rel=1e-4
    )
    for was, now, mean in zip(before, net.parameters(), average.module.parameters()):
        assert not torch.equal(was, now)
        torch.testing.assert_close(mean, torch.lerp(was, now.detach(), 1 - 1 / 20))  # at first the average forgets fast
    assert average.updates == 1


@pytest.mark.parametrize("gradient", [float("nan"), float("inf")])
def test_what_is_not_finite_is_no_step(net, gradient):
    before = [weight.clone() for weight in net.parameters()]
    finite, learner, average = updated(net, gradient)
    assert not finite
    assert all(torch.equal(was, now) for was, now in zip(before, net.parameters()))
    assert average.updates == 0 and not learner.optimiser.state


def test_rates_may_be_tensors(net):
    """As in a CUDA graph, which reads them from the device."""
    other = nn.Sequential(nn.Conv2d(3, 8, 3), nn.SiLU(), nn.Conv2d(8, 2, 1))
    other.load_state_dict(net.state_dict())
    for one, rate in ((net, 0.02), (other, torch.tensor(0.02))):
        optimiser = muon((one,), lambda now: 0.0, heads=(one[2],)).optimiser
        for group in optimiser.param_groups:
            group["lr"] = rate
        for weight in one.parameters():
            weight.grad = torch.ones_like(weight)
        optimiser.step()
    for mine, theirs in zip(net.parameters(), other.parameters()):
        torch.testing.assert_close(mine, theirs)
