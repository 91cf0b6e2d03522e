"""Direct alignment: the planar motion between two pictures, found by warping the first with its depth onto the second. Dense visual
odometry (Steinbruecker et al. 2011; Kerl et al. 2013) with three unknowns: robust Gauss-Newton on brightness, coarse to fine."""

import torch
import torch.nn.functional as F

from .camera import Intrinsics, rays

_ROUNDS = {8: 5, 4: 4, 2: 4, 1: 2}  # steps of the search at each downscaling factor
_HELD = 0.2  # strength of the prior for no motion


def align(
    before: torch.Tensor, after: torch.Tensor, depth: torch.Tensor, camera: Intrinsics, pace: torch.Tensor
) -> torch.Tensor:
    """The motion [B, 3] between `before` and `after` [B, 3, H, W], at any scale of brightness: metres forward and to the left in
    the frame of the first, radians to the left. depth [B, H, W]: metres, of the first; pace [3]: the usual step.

    Starts at the coarsest level from no motion, both turns, and steps forward and back, and refines the best."""
    grey = [picture.float().mean(1, keepdim=True) for picture in (before, after)]
    starts = torch.tensor([[0, 0, 0], [0, 0, 1], [0, 0, -1], [1, 0, 0], [-1, 0, 0]], device=depth.device) * 0.7 * pace
    motions = [start.expand(len(before), 3) for start in starts]
    levels = [level for level in _ROUNDS if min(before.shape[-2:]) >= 6 * level] or [1]
    for level in levels:
        first, second = (F.avg_pool2d(picture, level) for picture in grey)
        near = 1 / F.avg_pool2d(1 / depth[:, None].clamp_min(0.05), level)[:, 0]
        for _ in range(_ROUNDS[level]):
            motions = [_round(first, second, near, camera, motion, pace)[0] for motion in motions]
        if len(motions) > 1:
            best = torch.stack([_round(first, second, near, camera, motion, pace)[1] for motion in motions]).argmin(0)
            motions = [torch.stack(motions)[best, torch.arange(len(before))]]
    return motions[0]


def _round(
    first: torch.Tensor,
    second: torch.Tensor,
    depth: torch.Tensor,
    camera: Intrinsics,
    motion: torch.Tensor,
    pace: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """One step of Gauss-Newton: pictures [B, 1, h, w], depth [B, h, w], motion [B, 3] -> a better motion, and the error of the
    given one [B]."""
    fx, fy, cx, cy = camera
    height, width = depth.shape[-2:]
    points = depth[..., None] * rays(camera, height, width, depth.device)
    c, s = (part[:, None, None] for part in (motion[:, 2].cos(), motion[:, 2].sin()))
    x, y = points[..., 0] - motion[:, 0, None, None], points[..., 1] - motion[:, 1, None, None]
    ahead, left, up = x * c + y * s, y * c - x * s, points[..., 2]
    safe = ahead.clamp_min(0.05)
    u, v = cx - fx * left / safe, cy - fy * up / safe
    inside = (ahead > 0.05) & (u > 0) & (u < 1) & (v > 0) & (v < 1)
    grid = torch.stack([u, v], -1) * 2 - 1
    slopes = torch.cat([_slope(second, 3) * width, _slope(second, 2) * height], 1)
    seen = F.grid_sample(torch.cat([second, slopes], 1), grid, padding_mode="border", align_corners=False)
    warped, slope_u, slope_v = seen.unbind(1)
    here, _ = _even(first[:, 0], inside)
    warped, contrast = _even(warped, inside)
    slope_u, slope_v = slope_u / contrast, slope_v / contrast
    # how u and v change as the camera moves forward, to the left, and turns
    d_ahead = torch.stack([-c.expand_as(ahead), -s.expand_as(ahead), left], -1)
    d_left = torch.stack([s.expand_as(ahead), -c.expand_as(ahead), -ahead], -1)
    d_u = -fx * (d_left * safe[..., None] - left[..., None] * d_ahead) / safe[..., None] ** 2
    d_v = fy * up[..., None] * d_ahead / safe[..., None] ** 2
    change = slope_u[..., None] * d_u + slope_v[..., None] * d_v
    off = warped - here
    spread = (off.abs() * inside).sum((1, 2)) / inside.sum((1, 2)).clamp_min(1)
    weight = inside / (1 + (off / (2 * spread[:, None, None] + 1e-3)) ** 2)
    flat, rest, weight = change.flatten(1, 2), off.flatten(1), weight.flatten(1)
    normal = (flat * weight[..., None]).mT @ flat
    held = _HELD * (spread**2 * weight.sum(1) ** 0.5)[:, None] / pace**2  # unobservable components stay near zero
    damped = normal + torch.diag_embed(1e-3 * normal.diagonal(dim1=1, dim2=2) + 1e-6 + held)
    step = torch.linalg.solve(damped, -(flat * (weight * rest)[..., None]).sum(1) - held * motion)
    missing = 1 - inside.flatten(1).float().mean(1)
    return motion + step.clamp(-2 * pace, 2 * pace), spread * (1 + missing) + 1e-4 * (motion / pace).square().sum(1)


def _even(grey: torch.Tensor, inside: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """grey [B, h, w] with mean 0 and contrast 1 over the pixels `inside`, which both pictures show; and its contrast before
    [B, 1, 1]."""
    count = inside.sum((1, 2), keepdim=True).clamp_min(1)
    grey = grey - (grey * inside).sum((1, 2), keepdim=True) / count
    contrast = ((grey.square() * inside).sum((1, 2), keepdim=True) / count).sqrt().clamp_min(1e-3)
    return grey / contrast, contrast


def _slope(picture: torch.Tensor, axis: int) -> torch.Tensor:
    """Central differences per pixel along `axis`."""
    padded = F.pad(picture, (1, 1, 0, 0) if axis == 3 else (0, 0, 1, 1), mode="replicate")
    length = picture.shape[axis]
    return (padded.narrow(axis, 2, length) - padded.narrow(axis, 0, length)) / 2
