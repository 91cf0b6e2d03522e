"""Recall: the memory of a flat world whose pictures change as a whole and come back, as rooms and turns do. It keeps earlier frames
of an episode; of these the one that is most like a draft of the next frame is shown to the generator."""

import torch
import torch.nn.functional as F

from ..core.backend import plus

KEPT = 24  # frames of an episode
CELLS = 8  # rows and columns of the tiny picture by which frames are compared: its key
NEW = 0.03  # mean difference of keys, colours in 0..1, from all kept frames above which a frame is kept
EMPTY = 9.0  # numbers of the keys where nothing is kept


def nothing_kept(
    batch: int, size: tuple[int, int], device: torch.device | str = "cpu"
) -> tuple[torch.Tensor, torch.Tensor]:
    """No frames: uint8 [B, KEPT, 3, H, W], and their keys float32 [B, KEPT, n]."""
    frames = torch.zeros(batch, KEPT, 3, *size, dtype=torch.uint8, device=device)
    return frames, torch.full((batch, KEPT, 3 * CELLS * CELLS), EMPTY, device=device)


def keys_of(colours: torch.Tensor) -> torch.Tensor:
    """Of pictures [..., 3, H, W] with colours in 0..1: float32 [..., n]."""
    return F.adaptive_avg_pool2d(colours.flatten(0, -4), CELLS).flatten(1).unflatten(0, colours.shape[:-3])


def keep(frames: torch.Tensor, keys: torch.Tensor, frame: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Frames and keys, the newest first, after the next frame uint8 [B, 3, H, W]: it is kept if it is new, and the oldest goes."""
    key = keys_of(frame / 255)
    new = (keys - key[:, None]).abs().mean(2).amin(1) > NEW
    more = torch.cat([frame[:, None], frames[:, :-1]], 1), torch.cat([key[:, None], keys[:, :-1]], 1)
    return torch.where(new[:, None, None, None, None], more[0], frames), torch.where(new[:, None, None], more[1], keys)


def most_alike(frames: torch.Tensor, keys: torch.Tensor, draft: torch.Tensor) -> torch.Tensor:
    """The kept frame that is most like a draft [B, 3, H, W] in -1..1: uint8 [B, 4, H, W], its colours and 255. All is 0 where
    nothing is kept."""
    key = keys_of(plus(0.5, draft.float(), 0.5))
    away, number = (keys - key[:, None]).abs().mean(2).min(1)
    colours = frames.take_along_dim(number[:, None, None, None, None], 1)[:, 0]
    some = (away < EMPTY / 2)[:, None, None, None].expand(-1, 1, *colours.shape[-2:])
    return torch.cat([colours * some, some * colours.new_tensor(255)], 1)
