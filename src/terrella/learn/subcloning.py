"""Weight subcloning (Samragh et al. 2023): a smaller flow network begins with the most important channels of a trained one."""

from __future__ import annotations

import torch

from ..worlds.flow import HEADS, FlowNetwork

GROUPS = 8  # of the normalisations
# of each block, which of the three maps it changes: at 1/4, 1/8 or 1/16 of the size
LEVELS = {
    "before.0": 0,
    "drawn": 0,
    "after.2": 0,
    "after.3": 0,
    "before.1": 1,
    "after.1": 1,
    "before.2": 2,
    "after.0": 2,
}
WHOLE = ("actions.0", "actions.2", "time.0", "time.2", "near", "output")  # layers that do not depend on the widths


@torch.no_grad()
def subclone(teacher: FlowNetwork, network: FlowNetwork) -> FlowNetwork:
    """Fills the weights of `network`, of the same inputs and of widths up to the teacher's, and returns it. The channels are kept
    whose readers have the largest weights; a layer that reads fewer is scaled so that its variance stays."""
    weights, mine = dict(teacher.named_parameters()), dict(network.named_parameters())
    wide, narrow = teacher.config.channels, network.config.channels
    gains = [(many / few) ** 0.5 for many, few in zip(wide, narrow)]
    importance = [torch.zeros(width, device=network.moves.device) for width in wide]
    readers = {f"{block}.first": level for block, level in LEVELS.items()}
    readers |= {"down.0": 0, "down_drawn.0": 0, "down.1": 1, "down_drawn.1": 1, "up.0": 2, "up.1": 1, "detail": 0}
    for layer, level in readers.items():
        importance[level] += _read(weights[f"{layer}.weight"])
    kept = [_kept(each, width, GROUPS) for each, width in zip(importance, narrow)]

    def fill(name: str, rows=None, columns=None, gain: float = 1.0) -> None:
        part = weights[name] if rows is None else weights[name][rows]
        mine[name].copy_(gain * (part if columns is None else part[:, columns]))

    def fill_layer(name: str, rows=None, columns=None, gain: float = 1.0) -> None:
        fill(f"{name}.weight", rows, columns, gain)
        fill(f"{name}.bias", rows)

    for name in WHOLE:
        fill_layer(name)
    for name in ("enter", "enter_drawn"):
        fill_layer(name, kept[0])
    for name, level in LEVELS.items():
        rows, gain = kept[level], gains[level]
        inner = _kept(_read(weights[f"{name}.second.weight"]), narrow[level], 1)
        fill_layer(f"{name}.norm", rows)
        fill_layer(f"{name}.first", inner, rows, gain)
        fill_layer(f"{name}.second", rows, inner, gain)
        fill_layer(f"{name}.embedding", torch.cat([rows, rows + wide[level]]))
    for name in ("down", "down_drawn"):
        for level in (0, 1):
            fill_layer(f"{name}.{level}", kept[level + 1], kept[level], gains[level])
    for number, level in ((0, 2), (1, 1)):
        fill_layer(f"up.{number}", _shuffled(kept[level - 1]), kept[level], gains[level])
    if network.norm is not None:
        fill_layer("norm", kept[0])
    fill_layer("detail", None, kept[0], gains[0])
    inner = _kept(_read(weights["attention.out_proj.weight"]), narrow[2], HEADS)
    three = torch.cat([inner + part * wide[2] for part in range(3)])
    fill("attention.in_proj_weight", three, kept[2], gains[2])
    fill("attention.in_proj_bias", three)
    fill_layer("attention.out_proj", kept[2], inner, gains[2])
    return network


def _read(weight: torch.Tensor) -> torch.Tensor:
    """How much a layer's weights [out, in, ...] read each of its inputs."""
    return weight.square().transpose(0, 1).flatten(1).sum(1)


def _kept(importance: torch.Tensor, count: int, groups: int) -> torch.Tensor:
    """The `count` most important channels, as many of each group, in their order."""
    best = importance.view(groups, -1).topk(count // groups, 1).indices.sort(1).values
    first = torch.arange(groups, device=best.device) * (len(importance) // groups)
    return (best + first[:, None]).flatten()


def _shuffled(channels: torch.Tensor) -> torch.Tensor:
    """The four channels before a pixel shuffle of each channel after it."""
    return (4 * channels[:, None] + torch.arange(4, device=channels.device)).flatten()
