"""A learned policy as one ONNX file, with normalisation and action limits inside, to run without PyTorch."""

import warnings
from importlib.util import find_spec
from pathlib import Path

import torch
from torch import nn

from ..core.errors import CheckpointError, TerrellaError
from ..core.files import remedy_of, replacing
from .actor import Actor


class _Flat(nn.Module):
    """Observations, one tensor a channel, to the most likely action."""

    def __init__(self, actor: Actor):
        super().__init__()
        self.network, self.actor = actor.network, actor

    def forward(self, *seen: torch.Tensor) -> torch.Tensor:
        mode = self.network(dict(zip(self.actor.sees, seen))).mode()
        return self.network.config.actions(mode, self.actor.spec)


def write_onnx(actor: Actor, file: str | Path) -> dict[str, list[int]]:
    """Writes the policy, and returns its inputs by name with their shapes, -1 for the batch. Inputs are the channels that it sees,
    as rendered (float32, pictures uint8); the output is `action` [batch, *action.shape]. CheckpointError if it cannot be
    written."""
    if not find_spec("onnx"):
        raise TerrellaError("writing ONNX needs onnx, which is not installed: pip install 'terrella[fast]'.")
    kinds = {name: torch.uint8 if len(shape) == 3 else torch.float32 for name, shape in actor.network.config.sees}
    seen = tuple(torch.zeros(2, *shape, dtype=kinds[name]) for name, shape in actor.network.config.sees)
    names = [*actor.sees, "action"]
    try:
        with replacing(file) as staged, warnings.catch_warnings(), torch.no_grad():
            warnings.simplefilter("ignore")  # of tracing: conditions on shapes do not depend on values
            torch.onnx.export(
                _Flat(actor).eval(), seen, str(staged), input_names=names[:-1], output_names=names[-1:],
                dynamic_axes={name: {0: "batch"} for name in names}, dynamo=False,
            )  # fmt: skip
    except (OSError, RuntimeError) as error:
        raise CheckpointError(f"{file} cannot be written ({error}); {remedy_of(error)}, or choose another.") from error
    return {name: [-1, *shape] for name, shape in actor.network.config.sees}
