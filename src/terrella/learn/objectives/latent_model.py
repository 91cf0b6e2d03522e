"""The two halves of a latent-action model: the code that leads from one frame to another, and the effect of a code on a frame.

`Inverse` classifies which of K codes leads from one frame to the next; `Forward` predicts the next frame from a frame and a code.
Codes are a few integers, so that they carry little more than the motion (Genie, Bruce et al. 2024).
"""

import torch
import torch.nn.functional as F
from torch import nn

SWEEP = (3, 4)  # rows and columns of the coarse flow of a code
REACH = 2  # cells of 4 pixels, each way, within which features are correlated


class Inverse(nn.Module):
    """Logits over codes from the local correlation of the features of two frames."""

    def __init__(self, codes: int):
        super().__init__()
        self.features = nn.Sequential(
            nn.PixelUnshuffle(2), nn.Conv2d(12, 24, 3, padding=1), nn.SiLU(), nn.Conv2d(24, 32, 3, 2, padding=1)
        )
        shifts = (2 * REACH + 1) ** 2
        self.compare = nn.Sequential(nn.Conv2d(shifts, 48, 1), nn.SiLU(), nn.Conv2d(48, 32, 3, padding=1), nn.SiLU())
        self.decide = nn.Sequential(nn.Linear(32 * 12, 96), nn.SiLU(), nn.Linear(96, codes))

    def forward(self, before: torch.Tensor, after: torch.Tensor) -> torch.Tensor:
        """before, after: [B, 3, H, W] in [0, 1]. Returns logits [B, K]."""
        first, second = self._directions(before), self._directions(after)
        batch, channels, height, width = first.shape
        around = F.unfold(second, 2 * REACH + 1, padding=REACH).view(batch, channels, -1, height * width)
        alike = (first.flatten(2)[:, :, None] * around).sum(1).view(batch, -1, height, width)
        regions = F.adaptive_avg_pool2d(self.compare(3 * alike), (3, 4))
        return self.decide(regions.flatten(1))

    def _directions(self, frame: torch.Tensor) -> torch.Tensor:
        features = self.features(frame)
        return F.normalize(features - features.mean((2, 3), keepdim=True), dim=1)


class Forward(nn.Module):
    """A U-Net at half size that predicts, for each pixel, a flow to its source and an additive change, conditioned on a code.

    It sees one frame alone, so that a code means a motion, not a change of motion. Each code has a coarse flow of its own, the
    same for every frame, to which the frame adds a small bend (penalised in training), so that a code means the same everywhere.
    The code enters last, so that the predictions of all K codes cost little more than one.
    """

    def __init__(self, codes: int, widths: tuple[int, int, int] = (32, 48, 64)):
        super().__init__()
        one, two, three = widths
        self.fine = nn.Sequential(nn.PixelUnshuffle(2), _layer(12, one))
        self.middle = nn.Sequential(_layer(one, two, 2), _layer(two, two))
        self.coarse = nn.Sequential(_layer(two, three, 2), _layer(three, three))
        self.up_middle, self.up_fine = nn.Conv2d(three, two, 1), nn.Conv2d(two, one, 1)
        self.join_middle, self.join_fine = _layer(two, two), _layer(one, one)
        self.condition, self.mix = nn.Linear(codes, 2 * one), nn.Conv2d(one, one, 1)
        self.output = nn.Conv2d(one, 2 + 12, 3, padding=1)
        self.sweep = nn.Parameter(0.1 * torch.randn(codes, 2, 1, 1) + 0.01 * torch.randn(codes, 2, *SWEEP))  # 10 pixels
        nn.init.normal_(self.condition.weight, 0, 0.5)  # codes begin unlike each other
        nn.init.normal_(self.output.weight, 0, 0.01)
        self.output.bias.data = torch.zeros(2 + 12)

    def features(self, before: torch.Tensor) -> torch.Tensor:
        """[B, 3, H, W] in [0, 1] -> features that the predictions of all codes share."""
        fine = self.fine(before)
        middle = self.middle(fine)
        coarse = self.coarse(middle)
        middle = self.join_middle(middle + F.interpolate(self.up_middle(coarse), middle.shape[-2:]))
        return self.join_fine(fine + F.interpolate(self.up_fine(middle), fine.shape[-2:]))

    def outcome(
        self, features: torch.Tensor, before: torch.Tensor, code: torch.Tensor, half: bool = False
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """The next frame under one-hot `code` [B, K]: [B, 3, H, W]; the flow [B, 2, H/2, W/2] in pixels of the whole frame, from
        each pixel to its source (x to the right, y down); and the bend, the part of the flow that the frame adds to the code's own.

        half: `before` and the next frame have half the size."""
        scale, shift = self.condition(code)[:, :, None, None].chunk(2, 1)
        out = self.output(F.silu(self.mix(features) * (1 + scale) + shift))
        bend, added = 4 * out[:, :2], out[:, 2:]
        sweep = 10 * torch.einsum("bk,kchw->bchw", code, self.sweep)
        flow = F.interpolate(sweep, bend.shape[-2:], mode="bilinear", align_corners=True) + bend
        if half:
            return warped(before, flow / 2) + added.unflatten(1, (3, 4)).mean(2), flow, bend
        whole = F.interpolate(flow, before.shape[-2:], mode="bilinear")
        return warped(before, whole) + F.pixel_shuffle(added, 2), flow, bend

    def forward(self, before: torch.Tensor, code: torch.Tensor) -> torch.Tensor:
        return self.outcome(self.features(before), before, code)[0]

    def errors(self, features: torch.Tensor, before: torch.Tensor, after: torch.Tensor) -> torch.Tensor:
        """[B, K]: mean absolute error, at half size, of each code's prediction of `after`."""
        codes = self.condition.in_features
        small, truth = F.avg_pool2d(before, 2), F.avg_pool2d(after, 2)
        every = torch.eye(codes, device=before.device).repeat(len(before), 1)
        each = features.repeat_interleave(codes, 0), small.repeat_interleave(codes, 0)
        drawn = self.outcome(*each, every, half=True)[0]
        return (drawn.unflatten(0, (-1, codes)) - truth[:, None]).abs().mean((2, 3, 4))


def warped(frame: torch.Tensor, flow: torch.Tensor) -> torch.Tensor:
    """frame [B, C, H, W] sampled at each pixel + flow [B, 2, H, W] (pixels, x then y), bilinear, with border padding."""
    height, width = frame.shape[-2:]
    x = torch.arange(width, device=frame.device) + 0.5
    y = torch.arange(height, device=frame.device)[:, None] + 0.5
    place = torch.stack([(x + flow[:, 0]) / width, (y + flow[:, 1]) / height], -1) * 2 - 1
    return F.grid_sample(frame, place, padding_mode="border", align_corners=False)


def _layer(into: int, out: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(into, out, 3, stride, 1), nn.SiLU())


class LatentModel:
    """The `inverse` and the `forward` model; the two frames are `stride` rows apart."""

    def __init__(self, codes: int, stride: int, size: tuple[int, int], device: torch.device):
        self.codes, self.stride, self.size, self.device = codes, stride, size, device
        self.inverse, self.forward = Inverse(codes).to(device), Forward(codes).to(device)

    @torch.inference_mode()
    def infer(self, before: torch.Tensor, after: torch.Tensor) -> torch.Tensor:
        """Codes int64 [B] that led from one frame [B, 3, H, W] in [0, 1] to the other."""
        return self.inverse(before.to(self.device), after.to(self.device)).argmax(1).cpu()

    @torch.inference_mode()
    def predict(self, before: torch.Tensor, code: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """The frame [B, 3, H, W] in [0, 1] that follows under codes int64 [B], and the flow (see Forward.outcome)."""
        before = before.to(self.device)
        onehot = F.one_hot(code.to(self.device), self.codes).float()
        frame, flow, _ = self.forward.outcome(self.forward.features(before), before, onehot)
        return frame.clamp(0, 1).cpu(), flow.cpu()
