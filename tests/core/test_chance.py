"""Chance by counting: a batch equals its singles, on any device, and what is drawn is distributed as it says."""

from __future__ import annotations

import pytest
import torch

from terrella.core import make_rng
from terrella.core.chance import _halves, _halves_slowly, choice, normal, seeds, uniform


def test_a_batch_equals_its_singles():
    rng, whole = make_rng(5), seeds(33, make_rng(5))
    assert torch.equal(whole, torch.cat([seeds(1, rng) for _ in range(33)]))
    chance = torch.tensor([0.2, 0.0, 0.8]).expand(33, -1)
    for draw in (lambda s: normal(s, (3, 5)), lambda s: uniform(s, (7,), 2), lambda s: choice(s, chance[: len(s)])):
        assert torch.equal(draw(whole), torch.cat([draw(whole[n : n + 1]) for n in range(33)]))
    assert seeds(2, make_rng(0), "meta").device.type == "meta" and len(whole.unique()) == 33


@pytest.mark.parametrize("stream", [0, 1, 12345])
def test_the_kernel_equals_its_slow_twin(stream):
    some = torch.cat([seeds(5, make_rng(1)), torch.tensor([0, -1, 2**63 - 1, -(2**63)])])
    for fast, slow in zip(_halves(some, 11, stream), _halves_slowly(some, 11, stream)):
        assert torch.equal(fast, slow)


def test_streams_seeds_and_positions_are_independent():
    some = seeds(64, make_rng(2))
    first, other = normal(some, (400,)), normal(some, (400,), stream=1)
    alike = torch.corrcoef(torch.cat([first, other]))
    assert (alike - torch.eye(128)).abs().max() < 0.3 and len(first.unique()) > 0.99 * first.numel()


def test_what_is_drawn_is_distributed_as_it_says():
    some = seeds(8, make_rng(3))
    z, u = normal(some, (4, 50, 50)), uniform(some, (10000,))
    assert z.shape == (8, 4, 50, 50) and abs(z.mean()) < 0.02 and abs(z.std() - 1) < 0.02
    assert abs((z**4).mean() - 3) < 0.1 and (z.abs() < 1).float().mean().sub(0.6827).abs() < 0.01
    assert u.min() >= 0 and u.max() < 1 and (u.histc(10, 0, 1) / u.numel() - 0.1).abs().max() < 0.005
    assert torch.isfinite(normal(some, (100001,))).all() and normal(some).shape == (8,)


def test_choice_follows_its_probabilities():
    share = torch.tensor([0.0, 1.0, 0.0, 3.0, 0.0])
    drawn = choice(seeds(20000, make_rng(4)), share.expand(20000, 5)).bincount(minlength=5) / 20000
    assert drawn[[0, 2, 4]].tolist() == [0, 0, 0] and abs(drawn[3] - 0.75) < 0.02
    assert choice(seeds(3, make_rng(0)), torch.ones(3, 2, 4)).shape == (3, 2)


def test_noise_can_be_drawn_on_another_device():
    some = seeds(3, make_rng(0), "meta")
    assert normal(some, (4, 9)).device.type == "meta" and choice(some, torch.ones(3, 4, device="meta")).shape == (3,)


def test_choice_never_draws_an_entry_of_probability_0(monkeypatch):
    monkeypatch.setattr("terrella.core.chance.uniform", lambda seeds, *_: torch.zeros(len(seeds)))
    assert choice(seeds(2, make_rng(0)), torch.tensor([[0.0, 1.0, 0.0]] * 2)).tolist() == [1, 1]
