"""A learned policy as one ONNX file, normalisation and action limits inside, which runs at control rate without PyTorch."""

from __future__ import annotations

import warnings
from importlib.util import find_spec
from pathlib import Path

import torch
from torch import nn

from ..core.errors import CheckpointError, TerrellaError
from ..core.files import replacing
from .actor import Actor


class _Flat(nn.Module):
    """What it sees, one tensor a channel, to the likeliest action."""

    def __init__(self, actor: Actor):
        super().__init__()
        self.network, self.actor = actor.network, actor

    def forward(self, *seen: torch.Tensor) -> torch.Tensor:
        likeliest = self.network(dict(zip(self.actor.sees, seen))).mode()
        return self.network.config.actions(likeliest, self.actor.spec)


def write_onnx(actor: Actor, file: str | Path) -> dict[str, list[int]]:
    """Writes the policy; its inputs by name with their shapes, -1 for the batch. Inputs are the channels that it sees, as they
    are rendered (float32, pictures uint8), the output is `action` [batch, *action.shape]. CheckpointError where it cannot be
    written."""
    if not find_spec("onnx"):
        raise TerrellaError("writing ONNX needs onnx, which is not installed: pip install 'terrella[fast]'.")
    kinds = {name: torch.uint8 if len(shape) == 3 else torch.float32 for name, shape in actor.network.config.sees}
    seen = tuple(torch.zeros(2, *shape, dtype=kinds[name]) for name, shape in actor.network.config.sees)
    names = [*actor.sees, "action"]
    try:
        with replacing(file) as staged, warnings.catch_warnings(), torch.no_grad():
            warnings.simplefilter("ignore")  # of tracing: what is asked of shapes does not depend on the numbers
            torch.onnx.export(
                _Flat(actor).eval(), seen, str(staged), input_names=names[:-1], output_names=names[-1:],
                dynamic_axes={name: {0: "batch"} for name in names}, dynamo=False,
            )  # fmt: skip
    except (OSError, RuntimeError) as error:
        raise CheckpointError(f"{file} cannot be written ({error}); free some space, or choose another.") from error
    return {name: [-1, *shape] for name, shape in actor.network.config.sees}
