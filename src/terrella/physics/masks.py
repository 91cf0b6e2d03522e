"""A tracker that learns from masks what moves, whatever mostly lies still and however many colours the background has."""

import torch
import torch.nn.functional as F
from torch import Tensor

from ..core.errors import TerrellaError
from .tracker import COLOURS, NEAR, Tracker, common_colour

TRAVELS, LARGEST = 1.5, 0.25  # a thing covers this many times its area in all; and of a picture at most this share
SHOWN = 256  # pictures


def tracker_of_masks(pictures: Tensor, masks: Tensor) -> Tracker:
    """A tracker of what moves in uint8 pictures [F, H, W, 3] from one camera that stands still, by masks int [F, h, w]: the number
    of what is seen at each pixel. TerrellaError where nothing moves."""
    rows = torch.linspace(0, len(pictures) - 1, min(len(pictures), SHOWN)).long()
    some = pictures[rows].float()
    numbers = F.interpolate(masks[rows, None].float(), size=some.shape[1:3], mode="nearest")[:, 0].long()
    covers = [cover for number in numbers.unique() if _moves(cover := numbers == number)]
    if not covers:
        raise TerrellaError("nothing moves in the recorded masks, so there is nothing to track.")
    bare = ~torch.stack(covers).any(0)
    background = some.masked_fill(~bare[..., None], torch.nan).nanmedian(0).values
    background = torch.where(background.isnan(), common_colour(background[bare.any(0)]), background)
    colours: list[Tensor] = []
    for cover in covers:
        inner = 1 - F.max_pool2d(1 - cover[:, None].float(), 3, 1, 1)[:, 0] > 0
        colour = some[inner if inner.any() else cover].median(0).values
        if all(float((colour - other).norm()) >= NEAR for other in colours):
            colours.append(colour)
    areas = torch.cat([cover.sum((1, 2)) for cover in covers]).float()
    return Tracker(background, torch.stack(colours[:COLOURS]), float(areas[areas > 0].quantile(0.1)))


def _moves(cover: Tensor) -> bool:
    """Whether what covers these pixels, bool [F, H, W], travels; a background that things hide does not."""
    area = cover.sum((1, 2))
    usual = area[area > 0].median()
    return bool(cover.any(0).sum() > TRAVELS * usual) and float(usual) < LARGEST * cover[0].numel()
