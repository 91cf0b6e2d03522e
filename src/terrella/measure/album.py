"""Real frames of recordings, looked up by pose."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from ..space.camera import yaw
from .clips import Clip
from .fidelity import colour_statistics, gradient_energy

NEAR_M, NEAR_DEG = 0.5, 10.0  # within which a real frame counts as the same view


class Album:
    """Posed frames of recordings, looked up by pose. rgb arrays are read only for the frames that are used."""

    def __init__(self, pieces: Sequence[tuple[np.ndarray, np.ndarray, int]]):
        """pieces: (rgb uint8 [n, H, W, 3], pose [n, 7], episode number) each."""
        self._rgb = [rgb for rgb, _, _ in pieces]
        pose = torch.from_numpy(np.concatenate([np.asarray(poses, np.float32) for _, poses, _ in pieces]))
        self.place, self.heading = pose[:, :3], yaw(pose)
        lengths = torch.tensor([len(rgb) for rgb in self._rgb])
        self.first = torch.cat([torch.zeros(1, dtype=torch.long), lengths.cumsum(0)])
        self.episode = torch.tensor([episode for _, _, episode in pieces]).repeat_interleave(lengths)

    @staticmethod
    def of_clips(clips: Sequence[Clip]) -> Album:
        return Album([(clip.channels["rgb"], clip.pose, clip.episode) for clip in clips if clip.pose is not None])

    @staticmethod
    def of_cache(cache) -> Album:
        """All rows of a clip cache."""
        ranges = enumerate(cache.episodes)
        return Album([(cache.rgb[first:stop], cache.pose[first:stop], number) for number, (first, stop) in ranges])

    def nearest(self, pose: torch.Tensor, not_episode: torch.Tensor | None = None) -> torch.Tensor:
        """Rows of the nearest views to poses [M, 7], long [M]; -1 if none is near enough. not_episode [M]: episodes left out."""
        rows = []
        for start in range(0, len(pose), 64):
            part = pose[start : start + 64].float()
            away = torch.cdist(part[:, :3], self.place) / NEAR_M
            turn = torch.remainder(yaw(part)[:, None] - self.heading + torch.pi, 2 * torch.pi) - torch.pi
            turn = torch.rad2deg(turn.abs()) / NEAR_DEG
            cost = torch.where((away <= 1) & (turn <= 1), away + turn, torch.inf)
            if not_episode is not None:
                cost = cost.masked_fill(self.episode == not_episode[start : start + 64, None], torch.inf)
            least, row = cost.min(1)
            rows.append(torch.where(least.isfinite(), row, -1))
        return torch.cat(rows)

    def appearances(self, rows: torch.Tensor) -> torch.Tensor:
        """The appearance of the frames of rows [M]: float64 [M, 7]; zeros for -1."""
        out = torch.zeros(len(rows), 7, dtype=torch.float64)
        for number, row in enumerate(rows.tolist()):
            if row >= 0:
                piece = int(torch.searchsorted(self.first, row, right=True)) - 1
                frame = np.array(self._rgb[piece][row - int(self.first[piece])])
                out[number] = appearance(torch.from_numpy(frame)[None])[0]
        return out


def appearance(frames: torch.Tensor) -> torch.Tensor:
    """Gradient energy, then mean and standard deviation of the channels: uint8 [B, H, W, 3] -> float64 [B, 7]."""
    mean, deviation = colour_statistics(frames)
    return torch.cat([gradient_energy(frames)[:, None], mean, deviation], 1)
