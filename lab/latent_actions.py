"""How far latent actions can be trusted: what the codes of a run of `terrella train latent-actions` explain of a recording.

python lab/latent_actions.py RUN RECORDING [--whole]
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import torch

from terrella.core.errors import DatasetError
from terrella.data import ClipCache, split
from terrella.learn.latent_codes import clips_of, infer_codes
from terrella.learn.objectives.latent_model import LatentModel
from terrella.learn.recipes.latent_actions import frames_at, load_latent, pair_rows, pictures
from terrella.learn.trainer import Report
from terrella.space.camera import yaw

ROLLED = 4  # predictions in a row, for the figure over several steps
CLIP = 16  # rows of the clips over which intervals are drawn


def examine_latent(
    run: str | Path, data: str | Path, report: Report, whole: bool = False, seed: int = 0, device: str = "auto"
) -> dict:
    """What the codes are worth on the held-out episodes of a recording (`whole`: on all of another one).

    psnr_db:  of the frame `stride` rows on, predicted with the inferred code, with a random one, and by copying; and the
              difference of the first two with its 95 % interval (bootstrap over clips of 16 rows). `rolled`: the same
              after four predictions in a row, each from the one before.
    codes:    per code, the share of frames; `drawn_px`, the mean motion that the model gives it, in pixels, x to the right and
              y down; `seen_px`, the median motion that the pictures themselves show where it was inferred (their phase
              correlation, which knows nothing of the model), and `agreement`, the share of frames within 2 pixels of it.
              With poses, `turn_deg` and `ahead_m`: mean and standard deviation of the recorded motion.
    explained: with poses, the share of the variance of turn and advance that the code explains.
    actions:  with actions, `purity` (share of frames that have the commonest action of their code), `commonest` (of all)
              and `information`, mutual over the entropy of the actions. Neither is used in training.
    """
    model = load_latent(run, device)
    cache, stride, codes = pictures(data, model.size, report), model.stride, model.codes
    episodes = list(range(len(cache.episodes))) if whole else split(len(cache.episodes))[1]
    rows = pair_rows(cache, episodes, stride)
    long = pair_rows(cache, episodes, stride * ROLLED)
    if not len(long):
        raise DatasetError(f"{data} has no held-out episode of {stride * ROLLED + 1} rows; record two or more.")
    code = infer_codes(model, cache, rows)
    of_row = dict(zip(rows.tolist(), code))
    rng = np.random.default_rng(seed)
    clips = clips_of(long, min(CLIP, len(long)))
    clips = [clips[i] for i in np.sort(rng.permutation(len(clips))[:128])]  # 2,048 frames are enough
    inferred, random, copied, flows = [], [], [], []
    for number, clip in enumerate(clips):
        steps = [np.array([of_row[row + stride * step] for row in clip]) for step in range(ROLLED)]
        true, flow = _rolled(model, cache, clip, steps)
        inferred.append(true)
        random.append(_rolled(model, cache, clip, [rng.integers(codes, size=len(clip)) for _ in steps])[0])
        first = frames_at(cache, clip)
        copied.append([_psnr(first, frames_at(cache, clip + stride * (step + 1))) for step in range(ROLLED)])
        flows.append((steps[0], flow, shown_shift(first, frames_at(cache, clip + stride))))
        report(number + 1, len(clips), "examining")
    better = np.array([[a - b for a, b in zip(x, y)] for x, y in zip(inferred, random)])  # [clips, ROLLED, CLIP]
    found: dict = {"frames": len(rows), "stride": stride}
    for name, step in (("psnr_db", 0), ("rolled", ROLLED - 1)):
        found[name] = {
            "inferred": float(np.mean([clip[step] for clip in inferred])),
            "random": float(np.mean([clip[step] for clip in random])),
            "copied": float(np.mean([clip[step] for clip in copied])),
            "difference": float(better[:, step].mean()),
            "interval": _interval(better[:, step].mean(1), rng),
        }
    which, drawn, seen = (np.concatenate(parts) for parts in zip(*flows))
    found["codes"] = [_of_code(float((code == k).mean()), drawn[which == k], seen[which == k]) for k in range(codes)]
    if cache.pose is not None:
        moved = _moved(cache, rows, stride)
        for k in range(codes):
            for name, values in moved.items():
                mine = values[code == k]
                found["codes"][k][name] = [float(mine.mean()), float(mine.std())] if len(mine) else None
        found["explained"] = {name: _explained(values, code, codes) for name, values in moved.items()}
    if cache.action is not None and cache.action_names:
        found["actions"] = agreement(np.asarray(cache.action[rows]), code)
    return found


def _rolled(model: LatentModel, cache: ClipCache, clip: np.ndarray, codes: list[np.ndarray]):
    """PSNR of each frame of a clip after 1, 2, ... predictions, and the mean flow [n, 2] in pixels of the first one."""
    frame, quality, flow = frames_at(cache, clip), [], None
    for step, code in enumerate(codes):
        frame, moved = model.predict(frame, torch.from_numpy(np.asarray(code)))
        flow = moved.mean((2, 3)).neg().numpy() if flow is None else flow  # from where it comes -> where it goes
        quality.append(_psnr(frame, frames_at(cache, clip + model.stride * (step + 1))))
    return quality, flow


def _psnr(a: torch.Tensor, b: torch.Tensor) -> np.ndarray:
    """Of each frame, in dB; 60 where they are all but equal."""
    return -10 * (a - b).square().mean((1, 2, 3)).clamp_min(1e-6).log10().numpy()


def _interval(values: np.ndarray, rng: np.random.Generator) -> list[float]:
    means = values[rng.integers(len(values), size=(2000, len(values)))].mean(1)
    return [float(edge) for edge in np.percentile(means, (2.5, 97.5))]


def _of_code(share: float, drawn: np.ndarray, seen: np.ndarray) -> dict:
    if not len(drawn):
        return {"share": share}
    usual = np.median(seen, axis=0)
    near = np.linalg.norm(seen - usual, axis=1) <= 2
    return {
        "share": share,
        "drawn_px": drawn.mean(0).tolist(),
        "seen_px": usual.tolist(),
        "agreement": float(near.mean()),
    }


def shown_shift(before: torch.Tensor, after: torch.Tensor) -> np.ndarray:
    """By how many whole pixels (x to the right, y down) most of what `before` [B, 3, H, W] shows lies elsewhere in `after`:
    int64 [B, 2], the peak of their phase correlation."""
    height, width = before.shape[-2:]
    window = torch.hann_window(height, periodic=False)[:, None] * torch.hann_window(width, periodic=False)
    one, two = (
        torch.fft.rfft2((grey - grey.mean((1, 2), keepdim=True)) * window) for grey in (before.mean(1), after.mean(1))
    )
    cross = two * one.conj()
    alike = torch.fft.irfft2(cross / cross.abs().clamp_min(1e-6), (height, width)).flatten(1).argmax(1)
    y, x = alike // width, alike % width
    return torch.stack([(x + width // 2) % width - width // 2, (y + height // 2) % height - height // 2], 1).numpy()


def _moved(cache: ClipCache, rows: np.ndarray, stride: int) -> dict[str, np.ndarray]:
    """Turn to the left in degrees and advance in metres from `rows` to `stride` rows later, as recorded."""
    assert cache.pose is not None
    before, after = (torch.from_numpy(np.array(cache.pose[some])).double() for some in (rows, rows + stride))
    heading, turned = yaw(before), yaw(after) - yaw(before)
    way = after[:, :2] - before[:, :2]
    ahead = way[:, 0] * heading.cos() + way[:, 1] * heading.sin()
    return {"turn_deg": torch.atan2(turned.sin(), turned.cos()).rad2deg().numpy(), "ahead_m": ahead.numpy()}


def _explained(values: np.ndarray, code: np.ndarray, codes: int) -> float:
    within = sum(((values[code == k] - values[code == k].mean()) ** 2).sum() for k in range(codes) if (code == k).any())
    return float(1 - within / max(((values - values.mean()) ** 2).sum(), 1e-12))


def agreement(actions: np.ndarray, code: np.ndarray) -> dict[str, float]:
    """How codes int64 [n] go with recorded actions [n, A]; see `examine_latent`."""
    kinds, which = np.unique(actions, axis=0, return_inverse=True)
    table = np.zeros((int(code.max()) + 1, len(kinds)))
    np.add.at(table, (code, which.reshape(-1)), 1 / len(code))
    codes, acts = table.sum(1), table.sum(0)
    there = table > 0
    mutual = float((table[there] * np.log(table[there] / np.outer(codes, acts)[there])).sum())
    entropy = float(-(acts * np.log(acts)).sum())
    return {
        "purity": min(1.0, float(table.max(1).sum())),
        "commonest": float(acts.max()),
        "information": mutual / entropy if entropy > 0 else 0.0,
    }


if __name__ == "__main__":
    if len(sys.argv) < 3:
        sys.exit(__doc__)
    print(json.dumps(examine_latent(sys.argv[1], sys.argv[2], lambda *_: None, "--whole" in sys.argv), indent=1))
