"""The compiled kernel of chance.py; tests hold it against its slow, obvious twin."""

import numba
import numpy as np

GOLDEN, FIRST, SECOND = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)


@numba.njit(cache=True, nogil=True)
def hashed(x):
    """splitmix64's mixing of uint64."""
    x += GOLDEN
    x = (x ^ (x >> np.uint64(30))) * FIRST
    x = (x ^ (x >> np.uint64(27))) * SECOND
    return x ^ (x >> np.uint64(31))


@numba.njit(cache=True, nogil=True)
def halves(seeds, stream, high, low):
    """The kernel of chance._halves_slowly: seeds int64 [B]; fills high and low [B, N]."""
    step = np.float32(2.0**-24)
    for b in range(len(seeds)):
        key = hashed(np.uint64(seeds[b]) + hashed(np.uint64(stream)))
        for n in range(high.shape[1]):
            mixed = hashed(key + np.uint64(n) * GOLDEN)
            high[b, n] = np.float32(np.int64(mixed >> np.uint64(40))) * step
            low[b, n] = np.float32(np.int64((mixed >> np.uint64(8)) & np.uint64(0xFFFFFF))) * step
