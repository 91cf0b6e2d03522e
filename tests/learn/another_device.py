"""A device that is pretended: tensors that refuse to meet those of the CPU, as a GPU's do; and the losses of flat
worlds on it.

Run as a program, for the pretence changes torch for the whole process. `test_devices.py` does.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map_only
from torch.utils.backend_registration import _setup_privateuseone_for_python_backend

from terrella.act.actor_network import ActorConfig, ActorNetwork
from terrella.act.choices import Choices
from terrella.core import make_rng
from terrella.learn.objectives.flow_frames import RECORDED, FlowClips, FlowFrames
from terrella.learn.objectives.group_relative import GroupRelative
from terrella.learn.objectives.scroll import LENGTH, ScrollClips, ScrollObjective
from terrella.learn.train_step import TrainStep
from terrella.learn.verified_rollouts import GroupedRollouts
from terrella.worlds.flow import FlowConfig, FlowNetwork

_setup_privateuseone_for_python_backend("other")
OTHER, CPU = torch.device("other:0"), torch.device("cpu")
INDEXED = ("aten::index", "aten::index_put", "aten::index_put_")  # which take indices of the CPU on a GPU, too


class Other(torch.Tensor):
    """A tensor that says it lies on the other device; `here` holds its numbers."""

    here: torch.Tensor

    @staticmethod
    def __new__(cls, here):
        layout = {"strides": here.stride(), "storage_offset": here.storage_offset()}
        made = torch.Tensor._make_wrapper_subclass(cls, here.shape, dtype=here.dtype, device=OTHER, **layout)
        made.here = here
        return made

    def __init__(self, here):
        pass

    @classmethod
    def __torch_dispatch__(cls, op, types, args=(), kwargs=None):
        return _run(op, args, kwargs or {})


class Pretended(TorchDispatchMode):
    def __torch_dispatch__(self, op, types, args=(), kwargs=None):
        return _run(op, args, kwargs or {})


def _gru_cell(given, hidden, state, given_bias, hidden_bias):
    """What a GPU computes in one kernel."""
    (reset, update, new), (r, z, n) = (
        (one + bias).chunk(3, 1) for one, bias in ((given, given_bias), (hidden, hidden_bias))
    )
    reset, update = (reset + r).sigmoid(), (update + z).sigmoid()
    new = (new + reset * n).tanh()
    return new + update * (state - new), torch.cat([reset, update, new, state, n], 1)


def _run(op, args, kwargs):
    given = [part for part in tree_leaves((args, kwargs)) if isinstance(part, torch.Tensor)]
    other, name = [part for part in given if isinstance(part, Other)], op._schema.name
    wanted = kwargs.get("device")
    plain_args, plain = tree_map_only(Other, lambda part: part.here, (args, {**kwargs}))
    if wanted is not None:
        plain["device"] = CPU
    found = _gru_cell(*plain_args) if name == "aten::_thnn_fused_gru_cell" else op(*plain_args, **plain)
    if name == "aten::copy_":
        return args[0]
    if name not in ("aten::_to_copy", *INDEXED) and other and any(p.ndim and not isinstance(p, Other) for p in given):
        raise RuntimeError(f"{name}: tensors of two devices, {[tuple(part.shape) for part in given]}")
    if not (wanted.type == OTHER.type if wanted is not None else other):
        return found
    same = {id(part.here): part for part in other} if op._schema.is_mutable else {}
    return tree_map_only(torch.Tensor, lambda part: same[id(part)] if id(part) in same else Other(part), found)


def main() -> None:
    size, moves = (32, 40), torch.tensor([[0, 0], [1, 0], [0, -2]])
    over = (torch.arange(size[0]) < 5)[:, None].expand(size)
    now = TrainStep(RECORDED, 0.0, OTHER, np.random.default_rng(0), make_rng(0))
    truth = torch.randint(0, 256, (4, 7, 3, *size), dtype=torch.uint8, generator=make_rng(0))
    piece = ScrollClips(
        torch.cat([truth, truth[:, :1]], 1), torch.zeros(4, LENGTH, 36 + 4 * 2), torch.rand(4, 3 + LENGTH, 3)
    )
    network = FlowNetwork(FlowConfig(size, 4, 36 + 4 * 2, 2, (8, 8, 8)))
    network.moves[:], network.over[:] = moves, over
    flow = FlowFrames(network, 1e-3, 3, 2.0)
    seen = FlowClips(truth, torch.zeros(4, 7, 2), torch.randint(0, 256, (4, 3, 4, *size), dtype=torch.uint8))
    scrolling = object.__new__(ScrollObjective)  # without a recording
    assert network.scrolling is not None
    scrolling.scroll, scrolling.moves, scrolling.slots = network.scrolling, moves, 4
    actor = ActorNetwork(ActorConfig((("observation", (3,)),), "axes", (2,), (-1.0, -1.0), (1.0, 1.0), 8))
    groups = GroupRelative(actor, 1e-3, 0.3)
    rollouts = torch.ones(2, 8), torch.arange(8.0).view(2, 4) ** 2  # weights and rewards lie on the CPU
    with Pretended():
        for module in (*flow.modules.values(), actor):
            module.to(OTHER)
        try:
            network.moves + moves
        except RuntimeError:
            print("mixing is refused")
        late = replace(now, share=0.9)
        choices = Choices({"observation": torch.rand(16, 3).to(OTHER)}, torch.rand(16, 2).to(OTHER))
        grouped = groups.losses(GroupedRollouts(choices, *rollouts), now)
        for losses in (flow.losses(seen, late), scrolling.losses(piece, now), [next(grouped)]):
            for loss in losses:
                assert {part.device for part in (loss.value, *loss.parts.values())} == {OTHER}
                print(f"{loss.learner} has a loss")


if __name__ == "__main__":
    main()
