"""The rasteriser against its slow twin, in value and gradient, and against finite differences."""

from __future__ import annotations

import pytest
import torch

from terrella.core.errors import ContractError
from terrella.space.raster import Gaussians, join, rasterise
from terrella.space.raster.slow import rasterise_slowly

LENS = (0.6, 0.8, 0.45, 0.55)
POSES = torch.tensor([[0, 0, 0, 1, 0, 0, 0], [0.5, -0.3, 0.2, 0.9, 0.1, -0.2, 0.3]], dtype=torch.float32)


def cloud(count=150, degree=3, seed=0, opaque=0.6) -> Gaussians:
    rng = torch.Generator().manual_seed(seed)
    means = torch.randn(count, 3, generator=rng) * torch.tensor([1.5, 1.5, 0.8]) + torch.tensor([3.0, 0, 0])
    return Gaussians(
        means,
        torch.randn(count, 4, generator=rng),
        torch.rand(count, 3, generator=rng) * 0.3 + 0.03,
        torch.rand(count, generator=rng) * opaque + 0.02,
        torch.randn(count, (degree + 1) ** 2, 3, generator=rng) * 0.4,
    )


def parts(gaussians):
    return [getattr(gaussians, name) for name in ("means", "quats", "scales", "opacities", "sh")]


def gradients(draw, gaussians, lens, size):
    leaves = [part.clone().requires_grad_() for part in parts(gaussians)]
    seen = draw(Gaussians(*leaves), POSES, lens, size)
    rng = torch.Generator().manual_seed(5)
    loss = sum((torch.randn(part.shape, generator=rng) * part).sum() for part in seen[:3])
    return torch.autograd.grad(loss, leaves)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("lens", [LENS, None], ids=["pinhole", "panorama"])
def test_values_and_gradients_are_those_of_the_twin(lens, degree):
    gaussians, size = cloud(degree=degree), (37, 50)
    double = gaussians.each(torch.Tensor.double)
    seen, truth = rasterise(gaussians, POSES, lens, size), rasterise_slowly(double, POSES, lens, size)
    for one, other in zip(seen[:3], truth[:3]):
        assert (one - other).abs().mean() < 1e-4 * other.abs().mean()
        assert ((one - other).abs() > 2e-3).float().mean() < 1e-3  # those on the very edge of a splat
    assert (seen.ids == truth.ids).float().mean() > 0.995
    assert seen.alpha.max() > 0.5
    for one, other in zip(gradients(rasterise, gaussians, lens, size), gradients(rasterise_slowly, double, lens, size)):
        assert (one - other).norm() < 1e-4 * other.norm()


@pytest.mark.parametrize("lens", [LENS, None], ids=["pinhole", "panorama"])
def test_gradients_are_finite_differences(lens):
    gaussians, size = cloud(12, 1, opaque=0.3).each(torch.Tensor.double), (16, 20)
    weights = torch.randn(3, *size, generator=torch.Generator().manual_seed(1)).double()

    def loss(*leaves):  # of the twin: differences of float32 are too coarse, and the test above ties the two
        return (rasterise_slowly(Gaussians(*leaves), POSES[:1], lens, size).rgb[0] * weights).sum()

    leaves = [part.requires_grad_() for part in parts(gaussians)]
    found = torch.autograd.grad(loss(*leaves), leaves)
    ours = gaussians.each(lambda part: part.detach().float().requires_grad_())
    given = torch.autograd.grad((rasterise(ours, POSES[:1], lens, size).rgb[0] * weights).sum(), parts(ours))
    rng = torch.Generator().manual_seed(2)
    for at, (one, other) in enumerate(zip(given, found)):
        assert (one - other).norm() < 1e-3 * other.norm()
        way = torch.randn(one.shape, generator=rng).double()
        way = way / way.norm()
        ends = []
        for step in (1e-6, -1e-6):
            moved = [
                leaf.detach() + step * way if at == number else leaf.detach() for number, leaf in enumerate(leaves)
            ]
            ends.append(loss(*moved))
        difference = (ends[0] - ends[1]) / 2e-6
        assert abs(difference - (other * way).sum()) < 1e-3 * other.norm()


def test_a_panorama_closes_on_itself():
    one = Gaussians(torch.tensor([[-3.0, 0.0, 0.0]]), torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), 0.5),
                    torch.tensor([0.9]), torch.ones(1, 1, 3))  # fmt: skip
    alpha = rasterise(one, POSES[:1], None, (32, 64)).alpha[0]
    assert alpha[16, 0] > 0.5 and torch.allclose(alpha, alpha.flip(1), atol=1e-4)


def test_a_batch_is_its_single_views_and_a_scene_its_parts():
    gaussians = cloud(80)
    both = rasterise(gaussians, POSES, LENS, (40, 40))
    for view in range(2):
        alone = rasterise(gaussians, POSES[view : view + 1], LENS, (40, 40))
        assert all(torch.equal(one[0], other[view]) for one, other in zip(alone, both))
    joined = join([gaussians.at(torch.arange(40)), gaussians.at(torch.arange(40, 80))])
    assert torch.equal(rasterise(joined, POSES, LENS, (40, 40)).rgb, both.rgb)


def test_nothing_and_what_cannot_be_drawn():
    empty = cloud(5).at(torch.zeros(5, dtype=torch.bool))
    seen = rasterise(empty, POSES, LENS, (20, 33))
    assert seen.rgb.shape == (2, 3, 20, 33) and not seen.alpha.any() and (seen.ids == -1).all()
    behind = cloud(20).each(lambda part: part.clone())
    behind.means[:, 0] = -5
    assert not rasterise(behind, POSES[:1], LENS, (20, 20)).alpha.any()
    with pytest.raises(ContractError, match="sh of 1, 4, 9 or 16"):
        Gaussians(torch.zeros(2, 3), torch.zeros(2, 4), torch.zeros(2, 3), torch.zeros(2), torch.zeros(2, 2, 3))
