"""The scorecard: what a world's dreams are worth beside the truth, as figures with 95% intervals."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch

from ..core.world import World, make_rng
from .clips import Clip, check_clips
from .closure import Closure
from .drift import COPY_LAST, Drift
from .encoder import MIN_SIDE, frame_features
from .endurance import Endurance
from .fidelity import blurred
from .frechet import frechet_interval
from .outcomes import Fate
from .risk import Risk, pooled, risk
from .roll import PREDICTED, TRUE, Dream, dream_all, frames_at, poses_at, stand_still, true_motion_works
from .speed import Speed
from .statistics import Band, Figure, mean_band, mean_interval, median_interval, ratio_band, ratio_interval

Progress = Callable[[float, str], None]  # share done in 0..1, what is being done


@dataclass(frozen=True)
class ScoreConfig:
    """horizons: steps at which figures are given; control_horizons: where true actions are set against another
    player's; batch: clips rolled together; strips: clips of each place whose pictures are kept; walked_m: clips that
    walked less have no position error; drop: PSNR at the first horizon less that at the second; frechet: compare looks
    through the fixed encoder, where frames are at least MIN_SIDE a side."""

    horizons: tuple[int, ...] = (1, 8, 32, 64, 128)
    control_horizons: tuple[int, ...] = (8, 32, 128)
    position_horizons: tuple[int, ...] = (32, 64, 128)
    drop: tuple[int, int] = (8, 64)
    batch: int = 8
    strips: int = 3
    walked_m: float = 0.5
    frechet: bool = True


@dataclass(frozen=True)
class Place:
    """What was shown: how many clips, the share of them in which the player moves, their lengths in steps."""

    name: str
    clips: int
    moving_share: float
    context: int
    horizon: int


@dataclass(frozen=True)
class Fidelity:
    """One arm at one horizon. gain: psnr - copy_last, paired; sharpness: gradient energy of dreams over the game's;
    frechet: distance of the dreams' looks from the game's (frechet.py), None where it was not asked for or frames are
    too small."""

    place: str
    arm: str
    motion: str
    horizon: int
    seconds: float
    psnr: Figure
    ssim: Figure
    copy_last: Figure
    gain: Figure
    sharpness: Figure
    frechet: Figure | None = None


@dataclass(frozen=True)
class Looks:
    """What a Frechet distance is worth at one horizon: copy_last: that of real frames of other moments (the last shown
    of each clip); blurred: that of the game's own frames behind a Gaussian blur of one pixel."""

    place: str
    horizon: int
    seconds: float
    copy_last: Figure
    blurred: Figure


@dataclass(frozen=True)
class Control:
    """PSNR under the true actions, under those of another clip, and their paired difference: does it obey?"""

    place: str
    arm: str
    horizon: int
    seconds: float
    true_actions: Figure
    other_actions: Figure
    difference: Figure


@dataclass(frozen=True)
class Position:
    """Predicted against true place after `horizon` steps, as a share of the distance walked; heading in degrees."""

    place: str
    arm: str
    horizon: int
    seconds: float
    mean_share: Figure
    median_share: Figure
    heading_deg: Figure


@dataclass(frozen=True)
class Drop:
    """PSNR at `first` steps less PSNR at `last` steps of the same clips, dB: how much a longer dream loses."""

    place: str
    arm: str
    motion: str
    first: int
    last: int
    loss: Figure


@dataclass(frozen=True)
class Curve:
    """A figure at each step from 1: what is "psnr", "sharpness" or "position" (error in metres)."""

    what: str
    place: str
    arm: str
    motion: str
    band: Band


@dataclass(frozen=True)
class Picture:
    """Rows of frames uint8 [K, H, W, 3] to look at: label -> frames, one column label for each frame."""

    title: str
    columns: list[str]
    rows: dict[str, np.ndarray]


@dataclass(frozen=True)
class Scorecard:
    """Everything measured, as data; `pictures` are for the page and stay out of the JSON."""

    worlds: dict[str, str]
    dt_s: float
    places: list[Place]
    fidelity: list[Fidelity] = field(default_factory=list)
    control: list[Control] = field(default_factory=list)
    position: list[Position] = field(default_factory=list)
    looks: list[Looks] = field(default_factory=list)
    drops: list[Drop] = field(default_factory=list)
    curves: list[Curve] = field(default_factory=list)
    drifts: list[Drift] = field(default_factory=list)
    risks: list[Risk] = field(default_factory=list)
    fates: list[Fate] = field(default_factory=list)
    closures: list[Closure] = field(default_factory=list)
    endurance: list[Endurance] = field(default_factory=list)
    speeds: list[Speed] = field(default_factory=list)
    pictures: list[Picture] = field(default_factory=list)


def score(
    arms: Mapping[str, World],
    clips_by_place: Mapping[str, Sequence[Clip]],
    rng: torch.Generator,
    config: ScoreConfig | None = None,
    progress: Progress | None = None,
) -> Scorecard:
    """Dreams every clip of every place in every arm, with predicted motion and, where the world can, true motion.

    Each arm sees the same clips, the same random numbers and the same "other" actions, so differences are paired.
    The same generator seed gives the same scorecard.
    """
    config = config or ScoreConfig()
    tell = progress or (lambda share, words: None)
    first = next(iter(arms.values()))
    card = Scorecard({name: world.spec.name for name, world in arms.items()}, first.spec.dt_s, [])
    total, done = len(arms) * len(clips_by_place), 0
    doubted: dict[tuple[str, str], list[tuple[torch.Tensor, torch.Tensor]]] = {}
    for place, clips in clips_by_place.items():
        check_clips(place, clips, max(config.horizons))
        seed, order = _seed(rng), torch.randperm(len(clips), generator=rng).tolist()
        others = [clips[order[(order.index(number) + 1) % len(clips)]] for number in range(len(clips))]
        card.places.append(_describe(place, clips))
        truth = _truth(clips, config)
        _add_copy_last(card, place, truth, rng)
        _add_looks(card, place, clips, truth, config)
        rows: list[dict[str, np.ndarray]] = [{"truth": _kept(clip, config.horizons)} for clip in clips[: config.strips]]
        for arm, world in arms.items():
            tell(done / total, f"{place} places, {arm}")
            dreams = {PREDICTED: dream_all(world, clips, PREDICTED, config.horizons, config.batch, seed)}
            if true_motion_works(world, clips[0], make_rng(seed)):
                dreams[TRUE] = dream_all(world, clips, TRUE, config.horizons, config.batch, seed)
            for motion, dreamt in dreams.items():
                _add_fidelity(card, place, arm, motion, dreamt, truth, config, rng)
                if dreamt.error is not None and dreamt.uncertainty is not None:
                    doubted.setdefault((arm, motion), []).append((dreamt.error, dreamt.uncertainty))
                    chance = make_rng(seed)  # of its own: the other figures are those of a world that does not doubt
                    card.risks.append(risk(place, arm, motion, dreamt.error, dreamt.uncertainty, chance))
                for picture, clip, frames in zip(rows, clips, dreamt.frames):
                    picture[f"{arm}, {motion} motion"] = _with_context(clip, frames)
            steps = [step for step in config.control_horizons if step <= max(config.horizons)]
            if len(clips) > 1 and steps:
                wrong = dream_all(world, clips, PREDICTED, steps, config.batch, seed, others)
                _add_control(card, place, arm, dreams[PREDICTED], wrong, steps, rng)
            _add_position(card, place, arm, dreams[PREDICTED], clips, config, rng)
            done += 1
        columns = ["now", *(f"{step} step{'s'[: step > 1]}, {step * card.dt_s:.2f} s" for step in config.horizons)]
        card.pictures.extend(
            Picture(f"{place} place, clip {number + 1}", columns, row) for number, row in enumerate(rows)
        )
    for (arm, motion), parts in doubted.items():
        if len(parts) > 1:
            card.risks.append(pooled(parts, arm, motion, make_rng(len(card.risks))))
    tell(1.0, "scored")
    return card


def to_json(card: Scorecard, bars: Sequence = ()) -> str:
    """The scorecard, and bars where given, as one strict JSON document: no pictures, NaN as null, six digits."""
    return json.dumps(as_dict(card, bars), indent=1, allow_nan=False)


def as_dict(card: Scorecard, bars: Sequence = ()) -> dict:
    """What `to_json` writes, as plain data."""
    fields = {
        name.name: _plain(getattr(card, name.name)) for name in dataclasses.fields(card) if name.name != "pictures"
    }
    return {**fields, "bars": _plain(list(bars))}


def _plain(value):
    if dataclasses.is_dataclass(value):
        names = (name.name for name in dataclasses.fields(value))
        return {name: _plain(getattr(value, name)) for name in names if name != "picture"}
    if isinstance(value, Mapping):
        return {str(key): _plain(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(inner) for inner in value]
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    return value


@dataclass(frozen=True)
class _Truth:
    """Of the recording, [n, T]: PSNR of the last context frame against each later one, and gradient energy; features
    of the frames at the horizons [n, K, D], or None where looks are not compared."""

    copy_last: torch.Tensor
    energy: torch.Tensor
    features: torch.Tensor | None


def _seed(rng: torch.Generator) -> int:
    return int(torch.randint(2**31 - 1, (1,), generator=rng).item())


def _describe(place: str, clips: Sequence[Clip]) -> Place:
    moving = sum(clip.moves() for clip in clips) / len(clips)
    return Place(place, len(clips), moving, clips[0].context, clips[0].horizon)


def _truth(clips: Sequence[Clip], config: ScoreConfig) -> _Truth:
    context, steps = clips[0].context, max(config.horizons)
    copied, energy = stand_still(clips, steps)
    features = None
    if config.frechet and min(clips[0].rgb.shape[1:3]) >= MIN_SIDE:
        features = torch.stack([frame_features(frames_at(clips, context - 1 + step)) for step in config.horizons], 1)
    return _Truth(copied, energy, features)


def _kept(clip: Clip, horizons: Sequence[int]) -> np.ndarray:
    return np.stack([np.asarray(clip.rgb[clip.context - 1 + step]) for step in (0, *horizons)])


def _with_context(clip: Clip, frames: torch.Tensor) -> np.ndarray:
    return np.concatenate([np.asarray(clip.rgb[clip.context - 1])[None], frames.numpy()])


def _add_copy_last(card: Scorecard, place: str, truth: _Truth, rng: torch.Generator) -> None:
    card.curves.append(Curve("psnr", place, COPY_LAST, "", mean_band(truth.copy_last, rng)))


def _add_looks(card: Scorecard, place: str, clips: Sequence[Clip], truth: _Truth, config: ScoreConfig) -> None:
    if truth.features is None:
        return
    context = clips[0].context
    last = frame_features(frames_at(clips, context - 1))
    for number, step in enumerate(config.horizons):
        soft = frame_features(blurred(frames_at(clips, context - 1 + step)))
        figures = [frechet_interval(truth.features[:, number], seen) for seen in (last, soft)]
        card.looks.append(Looks(place, step, step * card.dt_s, *figures))


def _add_fidelity(card, place, arm, motion, dreamt: Dream, truth: _Truth, config: ScoreConfig, rng) -> None:
    seen = None if truth.features is None else frame_features(dreamt.frames)
    for number, step in enumerate(config.horizons):
        at = step - 1
        card.fidelity.append(
            Fidelity(
                place=place,
                arm=arm,
                motion=motion,
                horizon=step,
                seconds=step * card.dt_s,
                psnr=mean_interval(dreamt.psnr[:, at], rng),
                ssim=mean_interval(dreamt.ssim[:, number], rng),
                copy_last=mean_interval(truth.copy_last[:, at], rng),
                gain=mean_interval(dreamt.psnr[:, at] - truth.copy_last[:, at], rng),
                sharpness=ratio_interval(dreamt.energy[:, at], truth.energy[:, at], rng),
                frechet=None if seen is None else frechet_interval(truth.features[:, number], seen[:, number]),
            )
        )
    first, last = config.drop
    if last <= max(config.horizons):
        loss = dreamt.psnr[:, first - 1] - dreamt.psnr[:, last - 1]
        card.drops.append(Drop(place, arm, motion, first, last, mean_interval(loss, rng)))
    card.curves.append(Curve("psnr", place, arm, motion, mean_band(dreamt.psnr, rng)))
    card.curves.append(Curve("sharpness", place, arm, motion, ratio_band(dreamt.energy, truth.energy, rng)))


def _add_control(card, place, arm, right: Dream, wrong: Dream, steps: Sequence[int], rng) -> None:
    for step in steps:
        mine, theirs = right.psnr[:, step - 1], wrong.psnr[:, step - 1]
        figures = [mean_interval(values, rng) for values in (mine, theirs, mine - theirs)]
        card.control.append(Control(place, arm, step, step * card.dt_s, *figures))


def _add_position(card, place, arm, dreamt: Dream, clips: Sequence[Clip], config: ScoreConfig, rng) -> None:
    if dreamt.pose is None or clips[0].pose is None:
        return
    steps = dreamt.pose.shape[1]
    context = clips[0].context
    truth = torch.stack([poses_at(clips, context + step) for step in range(steps)], 1).double()
    walked = torch.from_numpy(np.stack([clip.walked_m()[:steps] for clip in clips]))
    away = (dreamt.pose[..., :3].double() - truth[..., :3]).norm(dim=-1)
    alike = (dreamt.pose[..., 3:].double() * truth[..., 3:]).sum(-1).abs().clamp(max=1)
    turned = torch.rad2deg(2 * torch.arccos(alike))
    card.curves.append(Curve("position", place, arm, PREDICTED, mean_band(away, rng)))
    for step in (step for step in config.position_horizons if step <= steps):
        went = walked[:, step - 1] > config.walked_m
        if not went.any():
            continue
        share = away[went, step - 1] / walked[went, step - 1]
        figures = mean_interval(share, rng), median_interval(share, rng), mean_interval(turned[:, step - 1], rng)
        card.position.append(Position(place, arm, step, step * card.dt_s, *figures))
