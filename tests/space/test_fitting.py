"""Fitting a small room: better than it began and than copying, exactly resumed; and its cubes, that stop whoever walks."""

from __future__ import annotations

import pytest
import torch

from terrella.space.camera import planar_pose
from terrella.space.fitting import Fit, FitConfig, PosedViews, decibels, nearest_views, psnr
from terrella.space.occupancy import Occupancy, Walker
from terrella.space.raster import Gaussians, rasterise
from terrella.space.raster.gaussians import plain_sh

LENS, SIZE = (0.5, 0.5, 0.5, 0.5), (24, 24)


def room(side=4.0, high=2.5, count=1500) -> Gaussians:
    """A room from 0 to `side` along x and y with painted walls."""
    rng = torch.Generator().manual_seed(0)
    means = torch.rand(count, 3, generator=rng) * torch.tensor([side, side, high])
    face = torch.arange(count) % 6
    axis, end = face // 2, (face % 2).float()
    means[torch.arange(count), axis] = end * torch.tensor([side, side, high])[axis]
    colours = 0.5 + 0.4 * torch.sin(means * 2.5)
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1)
    return Gaussians(means, quats, torch.full((count, 3), 0.12), torch.full((count,), 0.95), plain_sh(colours))


def views(count=20) -> PosedViews:
    turn = torch.arange(count) * 2.4
    x, y = 2 + 0.8 * torch.cos(turn * 1.7), 2 + 0.8 * torch.sin(turn * 0.9)
    pose = planar_pose(x, y, torch.full((count,), 1.2), turn)
    seen = rasterise(room(), pose, LENS, SIZE)
    rgb = (seen.rgb.clamp(0, 1) * 255).round().to(torch.uint8)
    return PosedViews(rgb, seen.depth / seen.alpha.clamp_min(0.5), pose, LENS)


@pytest.mark.slow
def test_a_fit_learns_and_goes_on_exactly():
    all_views = views()
    held = torch.arange(20) % 5 == 2
    kept, asked = all_views.at(~held), all_views.at(held)
    config = FitConfig(gaussians=900, steps=120)
    fit = Fit(kept, config)
    first = psnr(fit.gaussians, asked).mean()
    state = None
    while fit.done < config.steps:
        if fit.done == 70:
            state = fit.state()
        fit.step()
    near = nearest_views(kept, asked)
    copied = torch.stack([decibels(kept.rgb[n].float() - r.float()) for n, r in zip(near, asked.rgb)]).mean()
    last = psnr(fit.gaussians, asked).mean()
    assert last > first + 1 and last > copied + 1
    assert len(fit.gaussians) <= 900
    again = Fit(kept, config)
    again.restore(state)
    while again.done < config.steps:
        again.step()
    assert all(torch.equal(one, other) for one, other in zip(fit.state().values(), again.state().values()))


def test_walls_stop_and_floors_carry():
    place, body = Occupancy.of(room(count=6000)), Walker()
    here = torch.tensor([[2.0, 2.0, 1.6]]).repeat(16, 1)
    assert not place.blocked(here, body).any()
    assert torch.allclose(place.floor(here, body), torch.zeros(16), atol=0.1)
    angle = torch.arange(16) * (torch.pi / 8)
    wish = 0.2 * torch.stack([angle.cos(), angle.sin(), torch.zeros(16)], 1)
    for _ in range(40):
        here = place.walk(here, wish, body)
    assert (here[:, :2] > 0.1).all() and (here[:, :2] < 3.9).all()  # nobody got out
    assert (here[:, :2] - 2).norm(dim=1).min() > 1.2  # and everybody got somewhere
