"""space fit: a recording with depth and poses into a world of Gaussians; see space/fitting.py and worlds/splat.py."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from ...core.errors import ContractError, DatasetError, TrainingError
from ...data import Dataset
from ...space.camera import FAR_M
from ...space.files import replace_whole
from ...space.fitting import Fit, FitConfig, Views, decibels, nearest_views, psnr
from ...space.occupancy import Body, Occupancy
from ...space.raster import Gaussians
from ...worlds.additions import OBSERVED
from ...worlds.splat import SplatConfig, SplatWorld
from ...worlds.splat_folder import WORLD_FILE, check_free, save_splat
from ..trainer import Report

RESUME = "resume.safetensors"
LOOK_S, LOOK_SHARE, LOOKED_AT = (
    2.0,
    20,
    4,
)  # seconds between looks, which cost a twentieth at most; pictures that measure one
HELD_OUT = 8  # every so-manyth picture is kept from the fit, to measure it


@dataclass(frozen=True)
class SplatFit:
    """Settings of a fit.

    Args:
        name: Name of the world.
        frames: Pictures that are taken from the recording, spread evenly over what is asked for.
        episodes: The first so many episodes are used. Default: all.
        box: Corners x0 y0 x1 y1 in metres: only pictures taken within, one room say.
        save_every_s: Seconds between saves.
    """

    name: str = "place"
    frames: int = 300
    episodes: int | None = None
    box: tuple[float, float, float, float] | None = None
    save_every_s: float = 20.0
    fit: FitConfig = field(default_factory=FitConfig)


Watch = Callable[[Callable[[], SplatWorld], dict[str, Any]], None]


def fit_splat(
    data: str | Path, out: str | Path, config: SplatFit, report: Report | None = None, watch: Watch | None = None
) -> dict[str, Any]:
    """Fits, saves OUT/world, and goes on where an earlier run stopped. Returns the figures on held-out pictures (dB, with half the
    width of their 95% interval) beside the baseline of the nearest picture of the fit.

    watch: called every few seconds with what gives the world as it is then, and `step`, `steps` and `db` of a few kept pictures.
    """
    out, began = Path(out), time.monotonic()
    if config.frames < 16 or (config.episodes is not None and config.episodes < 1):
        raise TrainingError("--frames is 16 or more, --episodes 1 or more.")
    views, spec = read_views(data, config)
    held = torch.arange(len(views)) % HELD_OUT == HELD_OUT // 2
    kept, asked = views.at(~held), views.at(held)
    try:
        fit = Fit(kept, config.fit)
    except ContractError as error:
        raise TrainingError(f"{data}: {error}") from error
    told = {"data": str(data), **{name: str(value) for name, value in asdict(config).items() if name != "save_every_s"}}
    _restore(out / RESUME, fit, told)
    finished = fit.done >= config.fit.steps and (out / "world" / WORLD_FILE).exists()
    if not finished:
        check_free(out / "world")
    saved, looked, error = time.monotonic(), -np.inf, 0.0

    def look() -> float:
        """Has the fit watched, and says when next."""
        if watch is None:
            return np.inf
        start, now = time.monotonic(), fit.gaussians.each(torch.Tensor.detach)
        db = float(psnr(now, asked.at(torch.arange(len(asked))[:: max(len(asked) // LOOKED_AT, 1)])).mean())
        facts = {"step": fit.done, "steps": config.fit.steps, "db": round(db, 1)}
        watch(lambda: _world(now, kept, spec, config, {}), facts)
        return start + max(LOOK_S, LOOK_SHARE * (time.monotonic() - start))

    try:
        while fit.done < config.fit.steps:
            if time.monotonic() > looked:
                looked = look()
            error = 0.95 * error + 0.05 * fit.step() if error else fit.step()
            if report:
                report(
                    fit.done, config.fit.steps, f"{len(fit.leaves['means']):,} Gaussians, colours off by {error:.3f}"
                )
            if time.monotonic() - saved > config.save_every_s:
                _save(out / RESUME, fit, told)
                saved = time.monotonic()
    except KeyboardInterrupt:
        _save(out / RESUME, fit, told)
        raise KeyboardInterrupt(f"stopped after {fit.done} steps; the same command goes on.") from None
    look()
    figures = _figures(fit, kept, asked)
    if not finished:  # else it may have been edited since
        _save(out / RESUME, fit, told)
        save_splat(_world(fit.gaussians, kept, spec, config, {"data": str(data), **figures}), out / "world")
    return {**figures, "seconds": round(time.monotonic() - began, 1), "world": str(out / "world")}


def read_views(data: str | Path, config: SplatFit) -> tuple[Views, Mapping[str, Any]]:
    """Pictures of a recording, and what it says of its world; DatasetError where it has no depth, poses or lens."""
    dataset = Dataset(data)
    missing = [name for name in ("rgb", "depth", "pose") if not dataset.has(name)]
    lens = dataset.camera_models.get("rgb")
    if missing or lens is None:
        raise DatasetError(
            f"{data} has no {', '.join(missing) or 'lens of its camera'}: a place is fitted to pictures with depth and poses."
        )
    found: dict[str, list[np.ndarray]] = {"rgb": [], "depth": [], "pose": []}
    episodes = range(len(dataset.episodes))[: config.episodes]
    poses = [dataset.episode(number, ["pose"])["pose"] for number in episodes]
    inside = [np.flatnonzero(_within(pose, config.box)) for pose in poses]
    total = sum(map(len, inside))
    if total < 16:
        raise DatasetError(f"{data} has {total} pictures there, and a fit needs 16 or more; ask for more of it.")
    chosen = np.linspace(0, total - 1, min(config.frames, total)).round().astype(int)
    first = 0
    for number, rows in zip(episodes, inside):
        some = rows[chosen[(chosen >= first) & (chosen < first + len(rows))] - first]
        first += len(rows)
        if len(some):
            arrays = dataset.episode(number, ["rgb", "depth", "pose"])
            for name, parts in found.items():
                parts.append(arrays[name][some])
    rgb, depth, pose = (torch.from_numpy(np.concatenate(parts)) for parts in found.values())
    depth = depth.float()
    depth = torch.where(depth.isfinite() & (depth < 65), depth, FAR_M)
    return Views(rgb.permute(0, 3, 1, 2).contiguous(), depth, pose.float(), lens.intrinsics), dataset.world


def _within(pose: np.ndarray, box: tuple[float, float, float, float] | None) -> np.ndarray:
    if box is None:
        return np.ones(len(pose), bool)
    x0, y0, x1, y1 = box
    return (pose[:, 0] >= x0) & (pose[:, 0] <= x1) & (pose[:, 1] >= y0) & (pose[:, 1] <= y1)


def _figures(fit: Fit, kept: Views, asked: Views) -> dict[str, Any]:
    near = nearest_views(kept, asked)
    copied = torch.stack([decibels(kept.rgb[one].float() - truth.float()) for one, truth in zip(near, asked.rgb)])
    found = psnr(fit.gaussians, asked)
    both = {"held_out_db": found, "nearest_picture_db": copied}
    figures = {
        name: [round(float(v.mean()), 2), round(float(1.96 * v.std() / len(v) ** 0.5), 2)] for name, v in both.items()
    }
    return {
        **figures,
        "held_out": len(asked),
        "pictures": len(kept),
        "gaussians": len(fit.gaussians),
        "steps": fit.done,
    }


def _world(
    gaussians: Gaussians, kept: Views, spec: Mapping[str, Any], config: SplatFit, card: dict[str, Any]
) -> SplatWorld:
    """The world of a fit, in which one is as tall as the recording's camera was over its floor."""
    gaussians = gaussians.at(gaussians.opacities > 0.01)
    eye = kept.pose[:, :3]
    below = Occupancy.of(gaussians).floor(eye, Body(eye_m=0.5, step_m=0.0))
    tall = float((eye[:, 2] - below).median())
    body = Body(eye_m=tall, step_m=min(0.45, 0.4 * tall)) if 0.3 < tall < 3 else Body()
    observed = torch.full((len(gaussians),), OBSERVED, dtype=torch.uint8)
    starts = kept.pose[:: max(len(kept) // 64, 1)]
    made = SplatConfig(kept.camera, kept.size, body=body)
    return SplatWorld(config.name, gaussians, observed, starts, made, {"game": str(spec.get("name", "")), **card})


def _save(path: Path, fit: Fit, told: dict[str, str]) -> None:
    replace_whole(
        path, lambda file: save_file({k: v.contiguous() for k, v in fit.state().items()}, file, metadata=told)
    )


def _restore(path: Path, fit: Fit, told: dict[str, str]) -> None:
    if not path.exists():
        return
    try:
        with safe_open(str(path), "pt") as file:
            said = dict(file.metadata() or {})
            tensors = {name: file.get_tensor(name) for name in file.keys()}
    except (OSError, SafetensorError) as error:
        raise TrainingError(f"{path} cannot be read ({error}); remove it, or give another --out.") from error
    if said != told:
        raise TrainingError(f"{path} is of a fit with other settings; remove it, or give another --out.")
    fit.restore(tensors)
