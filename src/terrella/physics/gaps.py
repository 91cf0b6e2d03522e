"""Signed distances between rounded boxes, by the separating axes (Gottschalk et al. 1996): exact for spheres and for the overlap of
boxes, a lower bound for boxes that are farther apart than their size."""

from collections.abc import Sequence

import torch
from torch import Tensor

from .system import Wall


def rotated(quaternion: Tensor) -> Tensor:
    """Quaternions w, x, y, z [..., 4] as rotation matrices [..., 3, 3], whose columns are the body's axes."""
    w, x, y, z = quaternion.unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def body_gaps(position: Tensor, rotation: Tensor, half: Tensor, radius: Tensor) -> Tensor:
    """Distances [T, B, N, N], infinite on the diagonal. position [T, B, N, 3]; rotation [T, B, N, 4]; half [N, 3]; radius
    [T, B, N]."""
    gaps = torch.full((*position.shape[:3], position.shape[2]), torch.inf, dtype=position.dtype)
    reach = half.norm(dim=-1)
    for one in range(position.shape[2]):
        for other in range(one + 1, position.shape[2]):
            apart = position[:, :, other] - position[:, :, one]
            pair = apart.norm(dim=-1) - reach[one] - reach[other]
            near = pair < reach[one] + reach[other]  # spheres, without half extents, are exact already
            if near.any():
                turns = rotated(rotation[:, :, one][near]), rotated(rotation[:, :, other][near])
                pair[near] = _separation(apart[near], turns[0], half[one], turns[1], half[other])
            gaps[:, :, one, other] = gaps[:, :, other, one] = pair - radius[:, :, one] - radius[:, :, other]
    return gaps


def wall_gaps(position: Tensor, rotation: Tensor, half: Tensor, radius: Tensor, walls: Sequence[Wall]) -> Tensor:
    """Distances [T, B, N, W] of bodies to walls."""
    gaps = position.new_full((*position.shape[:3], len(walls)), torch.inf)
    reach = half.norm(dim=-1)
    boxes = bool((reach > 0).any())  # spheres have no turn
    turn = rotated(rotation) if boxes else rotation.new_zeros(()).expand(*rotation.shape[:-1], 3, 3)
    planes = [at for at, wall in enumerate(walls) if wall.normal is not None]
    if planes:
        normals = position.new_tensor([walls[at].normal for at in planes])
        heights = (normals * position.new_tensor([walls[at].centre_m for at in planes])).sum(-1)
        flat = position @ normals.T - heights - radius[..., None]
        if boxes:
            flat = flat - ((normals @ turn).abs() * half[:, None]).sum(-1)
        gaps[..., planes] = flat
    for at, wall in enumerate(walls):
        if wall.normal is not None:
            continue
        centre = position.new_tensor(wall.centre_m)
        fixed, size = rotated(position.new_tensor(wall.rotation)), position.new_tensor(wall.half_m)
        local = ((position - centre) @ fixed).abs() - size
        gap = local.clamp_min(0).norm(dim=-1) + local.amax(-1).clamp_max(0) - reach  # exact for spheres
        near = (gap < reach) & (reach > 0)
        if near.any():
            sizes = half.expand_as(position)[near]
            gap[near] = _separation(centre - position[near], turn[near], sizes, fixed.expand(len(sizes), 3, 3), size)
        gaps[..., at] = gap - radius
    return gaps


def _separation(apart: Tensor, turn: Tensor, half: Tensor, other: Tensor, size: Tensor) -> Tensor:
    """The largest gap [M] over the separating axes of two boxes: apart [M, 3] from centre to centre; turn and other [M, 3, 3];
    half and size [M, 3] or [3]."""
    axes = [_nearest(apart, other, size), _nearest(-apart, turn, half)]
    axes += [turn[..., at] for at in range(3)] + [other[..., at] for at in range(3)]
    axes += [torch.linalg.cross(turn[..., i], other[..., j]) for i in range(3) for j in range(3)]
    most = torch.full_like(apart[:, 0], -torch.inf)
    for axis in axes:
        length = axis.norm(dim=-1, keepdim=True)
        unit = axis / length.clamp_min(1e-12)
        mine = ((unit[:, None] @ turn)[:, 0].abs() * half).sum(-1)
        theirs = ((unit[:, None] @ other)[:, 0].abs() * size).sum(-1)
        gap = (apart * unit).sum(-1).abs() - mine - theirs
        most = torch.maximum(most, torch.where(length[:, 0] > 1e-6, gap, -torch.inf))
    return most


def _nearest(apart: Tensor, turn: Tensor, half: Tensor) -> Tensor:
    """The vector [..., 3] from the nearest point of a box at `apart` to the origin."""
    local = torch.einsum("...ij,...i->...j", turn, -apart)
    inside = torch.minimum(torch.maximum(local, -half), half)
    return torch.einsum("...ij,...j->...i", turn, local - inside)
