"""space fit: a recording with poses, or pictures, into a world of Gaussians; see space/fitting.py and worlds/splat.py."""

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from ...core.errors import ContractError, TrainingError
from ...space.files import replace_whole
from ...space.fitting import Fit, PosedViews, decibels, nearest_views, psnr
from ...space.occupancy import Occupancy, Walker
from ...space.pictures.posed import FEWEST
from ...space.raster import Gaussians
from ...worlds.additions import OBSERVED
from ...worlds.checkpoint import WORLD_FILE, read_about, write_about
from ...worlds.splat import SplatConfig, SplatWorld
from ...worlds.splat_folder import check_free, chosen_collider, save_splat
from ..trainer import Report
from .splat_views import SplatFit, read_views

RESUME = "resume.safetensors"
LOOK_S, LOOK_SHARE, LOOKED_AT = (
    2.0,
    20,
    4,
)  # seconds between previews, which take at most 1/20 of the time; their test pictures
LATER = ("save_every_s", "collider", "inside")  # settings that a fit which goes on may change
# Of held-out pictures, and above the nearest picture: below, a fit is called poor; but not from GOOD_DB on, for in a slow video the
# nearest picture is good.
POOR_DB, LITTLE_DB, GOOD_DB = 22.0, 3.0, 28.0
HELD_OUT, OF_FEW = (8, 4), 16  # every 8th picture is held out to measure the fit; of fewer than 16 every 4th

Watch = Callable[[Callable[[], SplatWorld], dict[str, Any]], None]


def fit_splat(
    data: str | Path, out: str | Path, config: SplatFit, report: Report | None = None, watch: Watch | None = None
) -> dict[str, Any]:
    """Fits, or resumes, a world of Gaussians and saves it to OUT/world. Returns PSNR on held-out pictures (dB, with half the width
    of the 95% interval) beside the baseline of the nearest picture of the fit.

    watch: called every few seconds with a function that gives the current world, and `step`, `steps` and `db` of a few held-out
    pictures.
    """
    out, began = Path(out), time.monotonic()
    _check(config)
    named = replace(config, name=config.name or Path(data).stem or Path(data).resolve().stem)
    config = replace(config, name=config.name or "place")  # as in the recipes of earlier runs
    views, spec, left_out = read_views(data, out, config)
    every = HELD_OUT[len(views) < OF_FEW]
    held = torch.arange(len(views)) % every == every // 2
    seen, tested = views.at(~held), views.at(held)
    try:
        fit = Fit(seen, config.fit)
    except ContractError as error:
        raise TrainingError(f"{data}: {error}") from error
    recipe = {
        "data": str(data),
        **{name: str(value) for name, value in asdict(config).items() if name not in LATER},
    }
    _restore(out / RESUME, fit, recipe)
    finished = fit.done >= config.fit.steps and (out / "world" / WORLD_FILE).exists()
    if not finished:
        check_free(out / "world")
        _world(fit.gaussians.each(torch.Tensor.detach), seen, spec, named, {})  # refuses a wrong --inside

    def preview() -> float:
        """Calls `watch`; returns the time of the next preview."""
        if watch is None:
            return math.inf
        start, now = time.monotonic(), fit.gaussians.each(lambda part: part.detach().clone())
        db = float(psnr(now, tested.at(torch.arange(len(tested))[:: max(len(tested) // LOOKED_AT, 1)])).mean())
        facts = {"step": fit.done, "steps": config.fit.steps, "db": round(db, 1)}
        watch(lambda: _world(now, seen, spec, named, {}), facts)
        return start + max(LOOK_S, LOOK_SHARE * (time.monotonic() - start))

    try:
        _run(fit, config, report, preview, lambda: _save(out / RESUME, fit, recipe))
    except KeyboardInterrupt:
        _save(out / RESUME, fit, recipe)
        raise KeyboardInterrupt(f"stopped after {fit.done} steps; the same command continues.") from None
    preview()
    figures = _figures(fit, seen, tested)
    if not finished:  # else it may have been edited since
        _save(out / RESUME, fit, recipe)
        card = {"data": str(data), "left_out": left_out, **figures, "doubts": doubts(figures)}
        save_splat(_world(fit.gaussians, seen, spec, named, card), out / "world")
    elif (config.collider, config.inside) != ("auto", None):
        _set_collider(out / "world", _world(fit.gaussians, seen, spec, named, {}).config)
    kind = read_about(out / "world")["config"].get("collider", "open")
    taken = {"left_out": left_out, "seconds": round(time.monotonic() - began, 1)}
    return {**figures, **taken, "doubts": doubts(figures), "collider": kind, "world": str(out / "world")}


def doubts(figures: Mapping[str, Any]) -> list[str]:
    """Why a fit may be poor, by its PSNR on held-out pictures: dB, of the place and of the nearest picture."""
    ours, copied = figures["held_out_db"][0], figures["nearest_picture_db"][0]
    if ours >= min(GOOD_DB, max(POOR_DB, copied + LITTLE_DB)):
        return []
    return [
        f"the place is poor: it meets held-out pictures by {ours:.1f} dB (good ones {POOR_DB:.0f} or more, {LITTLE_DB:.0f} above "
        f"the nearest picture's {copied:.1f}); more --steps and --gaussians may mend it, or things moved between the pictures, or "
        "their poses are wrong."
    ]


def _set_collider(world: Path, config: SplatConfig) -> None:
    """Closes the collider of a finished fit as `config` says; its edits stay."""
    about = read_about(world)
    about["config"] |= {"collider": config.collider, "inside": config.inside}
    write_about(world, about)


def _check(config: SplatFit) -> None:
    if config.frames < FEWEST or (config.episodes is not None and config.episodes < 1):
        raise TrainingError(f"--frames is {FEWEST} or more, --episodes 1 or more.")
    if not 1e-4 <= config.scale <= 1e4 or not 32 <= config.longest <= 4096:
        raise TrainingError("--scale is from 0.0001 to 10,000, --longest from 32 to 4096.")


def _run(
    fit: Fit, config: SplatFit, report: Report | None, preview: Callable[[], float], save: Callable[[], None]
) -> None:
    """All steps of the fit that are left."""
    saved, next_preview, error = time.monotonic(), -math.inf, 0.0
    while fit.done < config.fit.steps:
        if time.monotonic() > next_preview:
            next_preview = preview()
        error = 0.95 * error + 0.05 * fit.step() if error else fit.step()
        if report:
            words = f"{len(fit.leaves['means']):,} Gaussians, colour error {error:.3f}"
            report(fit.done, config.fit.steps, words)
        if time.monotonic() - saved > config.save_every_s:
            save()
            saved = time.monotonic()


def _figures(fit: Fit, seen: PosedViews, tested: PosedViews) -> dict[str, Any]:
    near = nearest_views(seen, tested)
    copied = torch.stack([decibels(seen.rgb[one].float() - truth.float()) for one, truth in zip(near, tested.rgb)])
    both = {"held_out_db": psnr(fit.gaussians, tested), "nearest_picture_db": copied}
    figures = {
        name: [round(float(v.mean()), 2), round(float(1.96 * v.std() / len(v) ** 0.5), 2)] for name, v in both.items()
    }
    return {
        **figures,
        "held_out": len(tested),
        "pictures": len(seen),
        "gaussians": len(fit.gaussians),
        "steps": fit.done,
    }


def _world(
    gaussians: Gaussians, seen: PosedViews, spec: Mapping[str, Any], config: SplatFit, card: dict[str, Any]
) -> SplatWorld:
    """The world of a fit, with a walker whose eyes are as high above the floor as the recording's camera."""
    gaussians = gaussians.at(gaussians.opacities > 0.01)
    eye = seen.pose[:, :3]
    filled = Occupancy.of(gaussians)
    below = filled.floor(eye, Walker(eye_m=0.5, step_m=0.0))
    tall = float((eye[:, 2] - below).median())
    body = Walker(eye_m=tall, step_m=min(0.45, 0.4 * tall)) if 0.3 < tall < 3 else Walker()
    observed = torch.full((len(gaussians),), OBSERVED, dtype=torch.uint8)
    starts = seen.pose[:: max(len(seen) // 64, 1)]
    made = SplatConfig(seen.camera, seen.size, body=body, inside=config.inside)
    made = replace(made, collider=chosen_collider(filled, starts, made, config.collider))
    return SplatWorld(config.name, gaussians, observed, starts, made, {"game": str(spec.get("name", "")), **card})


def _save(path: Path, fit: Fit, recipe: dict[str, str]) -> None:
    replace_whole(
        path, lambda file: save_file({k: v.contiguous() for k, v in fit.state().items()}, file, metadata=recipe)
    )


def _restore(path: Path, fit: Fit, recipe: dict[str, str]) -> None:
    if not path.exists():
        return
    try:
        with safe_open(str(path), "pt") as file:
            saved = dict(file.metadata() or {})
            tensors = {name: file.get_tensor(name) for name in file.keys()}
    except (OSError, SafetensorError) as error:
        raise TrainingError(f"{path} cannot be read ({error}); remove it, or give another --out.") from error
    if saved != recipe:
        raise TrainingError(f"{path} is of a fit with other settings; remove it, or give another --out.")
    fit.restore(tensors)
