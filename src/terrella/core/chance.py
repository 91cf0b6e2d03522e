"""Counter-based random numbers: one seed for each batch entry gives the same noise on any device and in any batch, at any time.

The noise of an entry is a hash of (seed, stream, position): splitmix64 (Steele, Lea & Flood 2014), used as a counter-based
generator (Salmon et al. 2011).
"""

import math
from collections.abc import Mapping, Sequence

import torch

from .backend import constant, kernels_do
from .kernels_numba import halves

GOLDEN, FIRST, SECOND = -0x61C8864680B583EB, -0x40A7B892E31B1A47, -0x6B2FB644ECCEEE15  # of splitmix64, as signed 64 bit


def seeds(batch: int, rng: torch.Generator, device: torch.device | str | None = None) -> torch.Tensor:
    """int64 [batch], one seed for each entry, drawn from `rng`. One call for B equals B calls for 1."""
    low, high, on = -(2**63), 2**63 - 1, rng.device
    if on.type == "cpu":
        drawn = torch.randint(low, high, (batch,), generator=rng)
    else:  # a CUDA generator gives other numbers in a batch than one by one
        ones = [torch.randint(low, high, (1,), generator=rng, device=on) for _ in range(batch)]
        drawn = torch.cat(ones) if ones else torch.zeros(0, dtype=torch.int64, device=on)
    return drawn if device is None else drawn.to(device)


def uniform(seeds: torch.Tensor, shape: Sequence[int] = (), stream: int = 0) -> torch.Tensor:
    """float32 [B, *shape], uniform in [0, 1), multiples of 2**-24. Each `stream` gives independent numbers."""
    return _halves(seeds, math.prod(shape), stream)[1].view(len(seeds), *shape)


def uniforms(seeds: torch.Tensor, shapes: Mapping[int, Sequence[int]]) -> dict[int, torch.Tensor]:
    """`uniform` of several streams, {stream: shape}, at once."""
    if kernels_do(seeds) or not shapes:
        return {stream: uniform(seeds, shape, stream) for stream, shape in shapes.items()}
    counts = [math.prod(shape) for shape in shapes.values()]
    streams, which, steps = constant(_layout, seeds.device, tuple(shapes), tuple(counts)).split(
        (len(counts), *[sum(counts)] * 2)
    )
    keys = _mixed(seeds[:, None] + streams)
    numbers = _scaled(_mixed(keys[:, which] + steps), 8).split(counts, 1)
    return {stream: part.view(len(seeds), *shape) for part, (stream, shape) in zip(numbers, shapes.items())}


def normal(seeds: torch.Tensor, shape: Sequence[int] = (), stream: int = 0) -> torch.Tensor:
    """float32 [B, *shape], standard normal (Box & Muller 1958)."""
    count = math.prod(shape)
    high, low = _shares_and_angles(seeds, (count + 1) // 2, stream)
    radius = torch.xlogy(constant(torch.tensor, high.device, -2.0), high).sqrt_()
    both = torch.view_as_real(torch.polar(radius, low)).mT
    return both.flatten(1)[:, :count].reshape(len(seeds), *shape)


def choice(seeds: torch.Tensor, probabilities: torch.Tensor, stream: int = 0) -> torch.Tensor:
    """int64 [B, ...] drawn from `probabilities` [B, ..., K], which need not sum to 1; entries of 0 are never drawn."""
    return chosen(uniform(seeds, probabilities.shape[1:-1], stream), probabilities)


def chosen(point: torch.Tensor, probabilities: torch.Tensor) -> torch.Tensor:
    """The same as `choice`, by numbers of `uniform` [B, ...]."""
    sums = probabilities.cumsum(-1, dtype=torch.float64)
    picked = torch.searchsorted(sums, point[..., None] * sums[..., -1:], right=True)[..., 0]
    return picked.clamp_max(probabilities.shape[-1] - 1)


def _shares_and_angles(seeds: torch.Tensor, count: int, stream: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Numbers [B, count] above 0 and up to 1, and angles [B, count]."""
    if kernels_do(seeds):
        high, low = _halves(seeds, count, stream)
        return high.add_(2.0**-25), low.mul_(2 * math.pi)
    whole = _hashes(seeds, count, stream) & 0xFFFFFF
    above, unit = (constant(torch.tensor, seeds.device, row)[:, None, None] for row in (_ABOVE, _UNIT))
    high, low = torch.addcmul(above, whole, unit).unbind(0)
    return high, low


_ABOVE, _UNIT = (2.0**-25, 0.0), (2.0**-24, 2 * math.pi * 2.0**-24)


def _halves(seeds: torch.Tensor, count: int, stream: int) -> tuple[torch.Tensor, torch.Tensor]:
    """The upper and the lower half of `count` hashes of each seed, as float32 [B, count] in [0, 1), multiples of 2**-24."""
    if not kernels_do(seeds):
        return _halves_slowly(seeds, count, stream)
    high, low = torch.empty(2, len(seeds), count).unbind(0)
    halves(seeds.contiguous().numpy(), stream, high.numpy(), low.numpy())
    return high, low


def _halves_slowly(seeds: torch.Tensor, count: int, stream: int) -> tuple[torch.Tensor, torch.Tensor]:
    """The same as `_halves` in plain tensor algebra, for GPUs."""
    high, low = ((_hashes(seeds, count, stream) & 0xFFFFFF) * 2.0**-24).unbind(0)
    return high, low


def _hashes(seeds: torch.Tensor, count: int, stream: int) -> torch.Tensor:
    """int64 [2, B, count], of which the lower 24 bits are the upper and the lower half of hashes."""
    key = _mixed(seeds + constant(_stream, seeds.device, stream))[:, None]
    return _mixed(key + constant(_steps, seeds.device, count))[None] >> constant(_shifts, seeds.device)


def _layout(streams: tuple[int, ...], counts: tuple[int, ...]) -> torch.Tensor:
    """For `uniforms`, one after another: what streams add to seeds; the stream of each number; what its place adds to the key."""
    which = torch.arange(len(counts)).repeat_interleave(torch.tensor(counts))
    return torch.cat([*(_stream(number)[None] for number in streams), which, *(_steps(count) for count in counts)])


def _scaled(mixed: torch.Tensor, shift: int | torch.Tensor) -> torch.Tensor:
    return ((mixed >> shift) & 0xFFFFFF) * 2.0**-24


def _stream(number: int) -> torch.Tensor:
    return _mixed(torch.tensor(number) + GOLDEN) + GOLDEN


def _steps(count: int) -> torch.Tensor:
    return torch.arange(count) * GOLDEN + GOLDEN


def _shifts() -> torch.Tensor:
    return torch.tensor([40, 8])[:, None, None]


def _mixed(x: torch.Tensor) -> torch.Tensor:
    """splitmix64 of int64, but for its first addition; a shift to the right brings in zeros."""
    x = (x ^ ((x >> 30) & (2**34 - 1))) * FIRST
    x = (x ^ ((x >> 27) & (2**37 - 1))) * SECOND
    return x ^ ((x >> 31) & (2**33 - 1))
