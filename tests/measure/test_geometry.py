"""Geometry against closed forms: spheres, Hénon's map, linear maps, and networks whose kinks are known."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import nn

from terrella.core import make_rng
from terrella.core.errors import DatasetError, TerrellaError
from terrella.core.policy import Idle
from terrella.data import record
from terrella.measure.geometry import (
    distance_to_data,
    effective_rank,
    intrinsic_dimension,
    jacobians,
    linear_regions,
    lyapunov_exponents,
    parting,
)
from terrella.sim.bodies import BodiesConfig, BodiesWorld
from terrella.workflows.geometry import GeometryConfig, measure_geometry
from terrella.worlds.controls import Controls
from terrella.worlds.folder import save_latent
from terrella.worlds.latent import LatentWorld
from terrella.worlds.latent_network import LatentConfig, LatentNetwork
from terrella.worlds.learned import About


@pytest.mark.parametrize("dimension", [1, 2, 4])
def test_the_dimension_is_that_of_the_set_not_of_the_space(dimension):
    rng = make_rng(0)
    points = torch.zeros(1500, 10)
    points[:, : dimension + 1] = torch.nn.functional.normalize(
        torch.randn(1500, dimension + 1, generator=rng), dim=1
    )  # a sphere
    turn = torch.linalg.qr(torch.randn(10, 10, generator=rng)).Q
    found = intrinsic_dimension((points @ turn)[:, None], rng)
    assert found.low < dimension * 1.02 and found.high > dimension * 0.98 and abs(found.value / dimension - 1) < 0.1


def test_neighbours_on_the_same_path_do_not_count():
    rng = make_rng(1)
    starts = torch.rand(400, 1, 2, generator=rng)
    paths = starts + 1e-4 * torch.arange(8.0)[:, None] * torch.tensor([1.0, 0.3])
    assert intrinsic_dimension(paths, rng).value == pytest.approx(2, abs=0.25)
    twice = torch.cat([starts, starts[:50]])
    assert math.isfinite(intrinsic_dimension(twice, rng).value), "a neighbour at the same point is left out"
    away = distance_to_data(paths[:50, 3], paths)
    assert bool((away == 0).all())


def test_the_distance_to_data_is_in_units_of_neighbours():
    data = torch.stack(torch.meshgrid(torch.arange(10.0), torch.arange(10.0), indexing="ij"), -1).flatten(0, 1)
    away = distance_to_data(torch.tensor([[[0.0, 0.0], [0.0, -3.0]]]), 2 * data[:, None])
    assert away.tolist() == [[0.0, 1.5]]


def henon(number, points):
    x, y = points.unbind(-1)
    return torch.stack([1 - 1.4 * x * x + y, 0.3 * x], -1)


def test_the_exponents_of_henons_map():
    start = torch.tensor([[0.1, 0.1], [0.2, -0.1]], dtype=torch.float64)
    found = lyapunov_exponents(henon, start, 1000, 2, make_rng(0))
    assert found[:, 0].tolist() == pytest.approx([0.419, 0.419], abs=0.04)
    assert found.sum(1).tolist() == pytest.approx([math.log(0.3)] * 2, abs=0.01), "the logarithm of the determinant"


def test_derivatives_rank_and_parting_of_a_linear_map():
    matrix = torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 2.0], [0.0, 0.0, 0.5]], dtype=torch.float64)
    found = jacobians(lambda number, points: points @ matrix.T, 0, torch.zeros(2, 3, dtype=torch.float64), slice(1, 3))
    assert torch.allclose(found, matrix[1:, 1:].expand(2, 2, 2))
    assert effective_rank(torch.eye(5)) == pytest.approx(5) and effective_rank(torch.diag(torch.tensor([2.0, 0]))) == 1

    def doubled(number, points):
        return 2 * points

    apart = parting(doubled, torch.zeros(1, 2), 3, torch.ones(2), lambda: torch.full((1, 2), 0.1))
    assert apart[0].tolist() == pytest.approx([0.1, 0.3, 0.7])


def test_linear_regions_are_counted_exactly():
    layer, out = nn.Linear(1, 3), nn.Linear(3, 1)
    layer.weight.data, layer.bias.data = torch.ones(3, 1), torch.tensor([-0.2, -0.5, 2.0])
    network = nn.Sequential(layer, nn.ReLU(), out)
    assert linear_regions(network, torch.zeros(1), torch.ones(1)) == 3, "two units have their kinks on the line"
    assert linear_regions(network, torch.tensor([0.6]), torch.ones(1)) == 1
    folds = []  # |2 |x - 1/2| - 1/2| and so on: each layer doubles the regions
    for _ in range(3):
        fold, back = nn.Linear(1, 2), nn.Linear(2, 1)
        fold.weight.data, fold.bias.data = torch.tensor([[2.0], [-2.0]]), torch.tensor([-1.0, 1.0])
        back.weight.data, back.bias.data = torch.ones(1, 2), torch.zeros(1)
        folds += [fold, nn.ReLU(), back]
    assert linear_regions(nn.Sequential(*folds), torch.zeros(1), torch.ones(1)) == 8
    with pytest.raises(ValueError, match="Linear and ReLU; this one has SiLU"):
        linear_regions(nn.Sequential(nn.SiLU()), torch.zeros(1), torch.ones(1))


def test_the_geometry_of_a_world_that_stands_still(tmp_path):
    bodies = BodiesWorld("bouncing", BodiesConfig(pictures=False))
    record(bodies, Idle(bodies.spec), tmp_path / "rec", 640, make_rng(0))
    controls = Controls.of(bodies.spec)
    vectors = (("position", 2), ("velocity", 2))
    network = LatentNetwork(LatentConfig(controls.numbers, vectors=vectors, latent=4, hidden=16, identity=True))
    torch.nn.init.zeros_(network.predictor.leave)
    network.scale.copy_(torch.tensor([0.5, 0.5, 1.5, 1.5]))
    world = LatentWorld(About("still", controls, bodies.spec.dt_s), network, torch.zeros(1, 4))
    save_latent(world, tmp_path / "world")
    config = GeometryConfig(tmp_path / "rec", steps=24, rollouts=5, fresh=True)
    found = measure_geometry(str(tmp_path / "world"), config)
    assert found.width == 4 and 2 < found.dimension.value < 6
    assert abs(found.exponents[0].value) * bodies.spec.dt_s < 0.05 and found.rank.value == pytest.approx(4, abs=1e-3)
    assert found.turning.value < 1e-3
    assert list(found.horizons) == ["by geometry", "by its uncertainty", "measured"]
    assert "nearby rollouts" in found.summary() or "e-fold" in found.summary()
    with pytest.raises(DatasetError, match="take fewer --steps"):
        measure_geometry(str(tmp_path / "world"), replace(config, steps=60, fresh=False))
    with pytest.raises(TerrellaError, match="has no latents"):
        measure_geometry("physics:bouncing", config)
