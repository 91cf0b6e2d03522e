"""Muon: its step is orthogonal, what is no matrix goes as with AdamW, and what it remembers is saved and restored."""

import pytest
import torch
from torch import nn

from terrella.learn.muon import QUINTIC, ROUNDS, Muon, muon, orthogonal


@pytest.mark.parametrize("shape", [(8, 8), (5, 40), (40, 5)])
@pytest.mark.parametrize("scale", [1e-4, 1e4])
def test_orthogonal_keeps_the_directions_and_levels_the_sizes(shape, scale):
    matrix = torch.randn(shape, generator=torch.Generator().manual_seed(0)) * scale
    left, _, right = torch.linalg.svd(matrix, full_matrices=False)
    sizes = torch.diagonal(left.T @ orthogonal(matrix[None])[0] @ right.T)
    assert 0.6 < sizes.min() and sizes.max() < 1.3
    torch.testing.assert_close(left @ torch.diag(sizes) @ right, orthogonal(matrix[None])[0], atol=1e-3, rtol=1e-3)


def test_directions_that_hardly_count_do_not_run_away():
    left, _, right = torch.linalg.svd(
        torch.randn(24, 200, generator=torch.Generator().manual_seed(0)), full_matrices=False
    )
    matrix = left @ torch.diag(10.0 ** -torch.linspace(0, 7, 24)) @ right
    slow = matrix.double() / matrix.norm()
    for _ in range(ROUNDS):
        square = slow @ slow.T
        slow = QUINTIC[0] * slow + (QUINTIC[1] * square + QUINTIC[2] * square @ square) @ slow
    torch.testing.assert_close(orthogonal(matrix[None])[0], slow.float(), atol=3e-3, rtol=0)


def test_no_gradient_moves_nothing():
    assert torch.equal(orthogonal(torch.zeros(1, 3, 4)), torch.zeros(1, 3, 4))


def test_the_others_go_as_with_adamw():
    ours, theirs = (nn.Parameter(torch.linspace(-1, 1, 6)) for _ in range(2))
    mine = Muon([], [ours], rate=0.01, decay=0.1)
    adamw = torch.optim.AdamW([theirs], lr=0.01, betas=(0.9, 0.99), weight_decay=0.1)
    for step in range(5):
        for weight, optimiser in ((ours, mine), (theirs, adamw)):
            weight.grad = torch.cos(weight.detach() * (step + 1))
            optimiser.step()
    torch.testing.assert_close(ours, theirs)


def learner():
    torch.manual_seed(0)
    net = nn.Sequential(nn.Conv2d(3, 8, 3), nn.SiLU(), nn.Conv2d(8, 2, 1))
    return net, muon((net,), lambda now: 0.02, heads=(net[2],)).optimiser


def descend(net, optimiser, steps):
    pictures = torch.randn(2, 3, 6, 6, generator=torch.Generator().manual_seed(1))
    for _ in range(steps):
        optimiser.zero_grad()
        loss = (net(pictures) - 1).square().mean()
        loss.backward()
        optimiser.step()
    return loss.item()


def test_heads_and_vectors_are_left_to_adamw():
    net, optimiser = learner()
    matrices, others = (group["params"] for group in optimiser.param_groups)
    assert [weight.shape for weight in matrices] == [(8, 3, 3, 3)]
    assert len(others) == 3


def test_it_descends_and_goes_on_where_it_was_saved():
    whole, broken = learner(), learner()
    first = descend(*whole, 1)
    last = descend(*whole, 9)
    assert last < first
    descend(*broken, 4)
    net, optimiser = learner()
    net.load_state_dict(broken[0].state_dict())
    optimiser.load_state_dict(broken[1].state_dict())
    descend(net, optimiser, 6)
    for one, other in zip(net.parameters(), whole[0].parameters()):
        assert torch.equal(one, other)
