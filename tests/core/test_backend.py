"""Constants on a device: made once, each of its own type."""

import torch

from terrella.core.backend import constant, table

CPU = torch.device("cpu")


def test_a_constant_is_made_once_and_keeps_its_type():
    first = constant(torch.tensor, CPU, (-1.0, 0.0))
    assert constant(torch.tensor, CPU, (-1.0, 0.0)) is first and first.dtype == torch.float32
    whole = constant(torch.tensor, CPU, (-1, 0))
    assert whole.dtype == torch.int64 and constant(torch.tensor, CPU, (True, False)).dtype == torch.bool
    assert (
        constant(torch.arange, CPU, 2.0).dtype == torch.float32 and constant(torch.arange, CPU, 2).dtype == torch.int64
    )
    assert constant(table, CPU, ((1, 2), (3, 4))).shape == (1, 2, 2)
