"""train_video: a recording into a VideoWorld, by flow matching with the last frame dreamt and a sharpness critic."""

from __future__ import annotations

import copy
import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from torch import nn

from ..core.errors import DatasetError, TrainingError
from ..core.world import make_rng
from ..data import ClipCache, Dataset, split
from ..space.keyframes import Glimpse, Keyframes
from ..worlds.controls import BUTTONS
from ..worlds.folder import save_world, video_spec
from ..worlds.history import HistoryWorld, Starts
from ..worlds.outcome import Outcome
from ..worlds.video import Generator, Motion, VideoConfig, VideoWorld, channels_last, generate, merge
from .lessons import history_lesson, place_lesson
from .motion import train_motion
from .moving import moving_lesson
from .outcome import Happenings, train_outcome
from .run_folder import load_run, save_run
from .samples import THINGS, Box, Lesson, Recording, choose_keyframes, controls_of, open_views, usable_rows
from .senses import SensesConfig, learn_senses


@dataclass(frozen=True)
class TrainConfig:
    """Settings of a training run.

    Args:
        name: What the world will be called.
        size: Height and width of its frames in pixels.
        geometry: Use the depth and poses of a recording that has them; --no-geometry learns from pictures and actions alone.
        channels: Of the generator at 1/2, 1/4, 1/8, ... of the size.
        frames: Last frames that a world without geometry sees.
        outcome_steps: Training steps of what reads reward, end and vitals off the frames, which is learned first.
        moving: Learn what moves (monsters, doors, pick-ups), where a recording with depth and poses marks it as `things`.
        flow_steps: Steps in which a frame is drawn. With more than one the whole flow from noise to frame is learned, so that
            a frame is one of those that could be and not their mean: a teacher for `train distil`.
        steps: Training steps; training ends here or after `hours`.
        hours: Hours of training, those of earlier runs counted in.
        batch: Frames a step; by itself 8 on a CPU and 64 on a GPU.
        learning_rate: Of the generator at its height.
        motion_steps: Training steps of the motion model, which is learned first.
        keyframes: Of the recording, that become the world's memory.
        keep_out: A box x0 y0 x1 y1 of the map, in metres, that training never sees, to score new places.
        critic_from: The step from which a critic judges sharpness.
        critic_weight: How hard it pulls, beside the loss itself.
        eye_steps: Training steps of the eye that sees depth in a lone picture, which is learned last; 0 leaves it out.
        doubt_frames: Dreamt frames from which the finished world learns to say when it invents; 0 leaves it out.
        save_every_s: Seconds between saves.
        strip_every_s: Seconds between pictures of truth against dream.
        seed: Of everything random.
        device: cpu, cuda or auto.
    """

    name: str = "world"
    size: tuple[int, int] = (96, 128)
    geometry: bool = True
    channels: tuple[int, ...] = (32, 56, 88, 128)
    frames: int = 4
    outcome_steps: int = 1500
    moving: bool = True
    flow_steps: int = 1
    steps: int = 8000
    hours: float = 24.0
    batch: int | None = None
    learning_rate: float = 8e-4
    motion_steps: int = 6000
    keyframes: int = 640
    keep_out: Box | None = None
    critic_from: int = 1500
    critic_weight: float = 0.3
    eye_steps: int = 2500
    doubt_frames: int = 9000
    save_every_s: float = 120.0
    strip_every_s: float = 300.0
    seed: int = 0
    device: str = "auto"


class Critic(nn.Module):
    """Judges 16-pixel patches: real or dreamt, given what memory knew (hinge loss)."""

    def __init__(self):
        super().__init__()
        widths = (3 + 3 + 1, 32, 48, 64)
        self.layers = nn.ModuleList(
            nn.utils.parametrizations.spectral_norm(nn.Conv2d(a, b, 4, 2, 1)) for a, b in zip(widths, widths[1:])
        )
        self.judge = nn.utils.parametrizations.spectral_norm(nn.Conv2d(widths[-1], 1, 3, 1, 1))

    def forward(self, rgb: torch.Tensor, glimpse) -> torch.Tensor:
        x = torch.cat([rgb, merge(glimpse) * 2 - 1, glimpse.known[:, None]], 1)
        for layer in self.layers:
            x = F.leaky_relu(layer(x), 0.2)
        return self.judge(x)


def train_video(
    data: str | Path, out: str | Path, config: TrainConfig, report: Callable[[float, float, str], None]
) -> dict:
    """Trains, or goes on with, the run in `out`; the finished world lies in `out`/world. Returns its facts."""
    out = Path(out)
    if any(length < 16 or length % 8 for length in config.size):
        raise TrainingError(f"--size {config.size[0]} {config.size[1]}: give multiples of 8, 16 or more.")
    if config.device.startswith("cuda") and not torch.cuda.is_available():
        raise TrainingError("there is no GPU that PyTorch can use here: leave --device out, or say cpu.")
    out.mkdir(parents=True, exist_ok=True)
    dataset = Dataset(data)
    cache = ClipCache.open(dataset, config.size, lambda done, total: report(done, total, "building the clip cache"))
    if cache.rgb is None:
        raise DatasetError(f"{data} holds no pictures (rgb); a world of pictures cannot be learned from it.")
    run = _Run(dataset, cache, out, config)
    run.learn(report)
    return run.finish(report)


class _Run:
    """The pieces of one training run."""

    def __init__(self, dataset: Dataset, cache: ClipCache, out: Path, config: TrainConfig):
        self.dataset, self.cache, self.out, self.config = dataset, cache, out, config
        self.device = torch.device(_device(config.device))
        torch.manual_seed(config.seed)
        posed = (
            config.geometry and cache.depth is not None and cache.pose is not None and bool(cache.world.get("camera"))
        )
        camera = tuple(cache.world["camera"]) if posed else (1.0, 1.0, 0.5, 0.5)
        controls = controls_of(cache)
        if posed and controls.kind != BUTTONS:
            raise DatasetError(
                f"{dataset.root} has actions that are no buttons (0 or 1 each), from which a world with depth and poses is "
                "learned; --no-geometry learns one from pictures and any actions."
            )
        self.video = VideoConfig(
            camera,
            controls.told,
            config.size,
            config.channels,
            slots=3 if posed else config.frames,
            geometry=posed,
            steps=config.flow_steps,
            residual=not posed and config.flow_steps == 1,
            moving=posed and config.moving and THINGS in cache.arrays,
        )
        if config.keep_out is not None and not posed:
            raise DatasetError(f"{dataset.root} has no poses, so no part of its map can be kept out; drop --keep-out.")
        train, self.held_out = split(len(cache.episodes))
        start = np.zeros(cache.length, np.int64)
        for first, last in cache.episodes:
            start[first:last] = first
        usable = usable_rows(cache, train, config.keep_out, self.video.camera)
        if usable.sum() < 64:
            raise DatasetError(
                f"{dataset.root} leaves {usable.sum()} frames to train on; record more, or a smaller keep_out."
            )
        self.recording = Recording(cache, start, usable, controls)
        self.happened, self.outcome = self._begin_outcome(usable, posed)
        self.memory = self._choose_memory() if posed else None
        self.generator = channels_last(Generator(self.video)).to(self.device)
        self.critic = Critic().to(self.device)
        self.motion = Motion(self.video)
        self.smooth = copy.deepcopy(self.generator).eval().requires_grad_(False)
        self.modules = {
            "generator": self.generator,
            "smooth": self.smooth,
            "motion": self.motion,
            "critic": self.critic,
        }
        if self.outcome is not None:
            self.modules["outcome"] = self.outcome
        self.optimisers = {
            "optimiser": torch.optim.AdamW(
                self.generator.parameters(), config.learning_rate, (0.9, 0.99), weight_decay=1e-4
            ),
            "critic_optimiser": torch.optim.Adam(self.critic.parameters(), 3e-4, (0.0, 0.99)),
        }
        self.facts = {"recipe": _recipe(config, dataset), "step": 0, "seconds": 0.0, "motion": None, "outcome": None}

    def _begin_outcome(self, usable: np.ndarray, posed: bool) -> tuple[Happenings, Outcome | None]:
        """What the recording tells of rewards, ends and vitals, and what will learn it, if there is anything to learn."""
        happened = Happenings.of(self.cache, self.recording.action(slice(None)).numpy(), usable)
        if (posed and not self.video.moving) or not happened.tells_something:
            return happened, None
        self.video = replace(self.video, vitals=_at_first(happened.vitals, self.recording))
        return happened, Outcome(happened.config()).to(self.device)

    def _choose_memory(self) -> Keyframes:
        rows = choose_keyframes(
            np.asarray(self.cache.pose), np.flatnonzero(self.recording.usable), self.config.keyframes
        )
        return self._keyframes_at(rows)

    def _keyframes_at(self, rows: np.ndarray) -> Keyframes:
        rgb = torch.from_numpy(self.dataset.rgb_at(rows)).permute(0, 3, 1, 2).float()
        size = [2 * length for length in self.config.size]  # as the keyframes of a dream, whatever size was recorded
        rgb = F.interpolate(rgb, size, mode="area" if rgb.shape[-1] >= size[1] else "nearest-exact")
        return Keyframes.of(
            rgb.round().to(torch.uint8), self.recording.lasting(rows), self.recording.pose(rows), self.video.camera
        )

    def learn(self, report) -> None:
        found = load_run(self.out, self.modules, self.optimisers)
        if found:
            if found["recipe"] != self.facts["recipe"]:
                raise TrainingError(f"{self.out} holds a run with other settings; repeat them, or give another --out.")
            self.facts = found
        if self.facts["motion"] is None and self.memory is not None:
            self.facts["motion"] = train_motion(
                self.motion, self.recording, self.memory, self.video, self.config.motion_steps, self.config.seed, report
            )
            self._save()
        if self.outcome is not None and self.facts.get("outcome") is None:
            settings = self.config.outcome_steps, self.config.seed, report
            self.facts["outcome"] = train_outcome(self.outcome, self.recording.rgb, self.happened, *settings)
            self._save()
        began = saved = drawn = time.monotonic()
        before = self.facts["seconds"]
        recent: list[dict] = []
        self._whole = True
        try:
            while self.facts["step"] < self.config.steps and self.facts["seconds"] < 3600 * self.config.hours:
                self._whole = False  # a step that Ctrl-C cuts is not saved: the last save goes on exactly
                recent.append(self._step(self.facts["step"]))
                self.facts["step"] += 1
                self._whole = True
                now = time.monotonic()
                self.facts["seconds"] = before + now - began
                if len(recent) == 20:
                    self._log(recent, report)
                    recent = []
                if now - saved > self.config.save_every_s:
                    self._save()
                    saved = now
                if now - drawn > self.config.strip_every_s:
                    self.draw_strip()
                    drawn = time.monotonic()
        except KeyboardInterrupt:
            if self._whole:
                self._save()
            raise
        self._save()

    def _step(self, step: int) -> dict[str, float]:
        """One step; all its randomness comes from (seed, step), so a resumed run sees what an unbroken one would."""
        config = self.config
        rng = np.random.default_rng([config.seed, step])
        batch = config.batch or (64 if self.device.type == "cuda" else 8)
        noise_rng = make_rng(int(rng.integers(2**62)))
        for group in self.optimisers["optimiser"].param_groups:
            group["lr"] = config.learning_rate * min(1, (step + 1) / 200) * (0.05 + 0.95 * _cosine(step / config.steps))
        with torch.no_grad():
            lesson = self._lesson(batch, rng, noise_rng).to(self.device)
            glimpse, truth = lesson.glimpse, lesson.truth
            noise = torch.randn(truth.shape, generator=noise_rng).to(self.device)
            from_noise = 0.75 if config.flow_steps == 1 else 0.0
            time_ = np.where(rng.random(batch) < from_noise, 0, rng.random(batch))
            time_ = torch.from_numpy(time_).float().to(self.device)
            noisy = truth * time_[:, None, None, None] + noise * (1 - time_[:, None, None, None])
        with half_precision(self.device):
            clean = self.generator(noisy, time_, glimpse, lesson.last, lesson.told).float()
            drawn, found = clean[:, :4], truth[:, :4]
            losses = (
                frame_losses(drawn, found, lesson.weight)
                if config.flow_steps == 1
                else flow_losses(drawn, found, time_)
            )
        total = losses["rgb"] + 0.5 * losses["depth"] + 0.5 * losses.get("edges", 0.0)
        if self.video.moving:
            losses["things"] = F.binary_cross_entropy_with_logits(clean[:, 4], truth[:, 4])
            total = total + 0.2 * losses["things"]
        judged = config.flow_steps == 1
        if judged and step >= config.critic_from:
            total = total + sharpened(self.critic, clean, total, glimpse, config.critic_weight)
        if not torch.isfinite(total):
            raise TrainingError(
                f"the loss is not a number at step {step}; the last save is good: lower --learning-rate."
            )
        self._descend("optimiser", self.generator, total)
        if judged and step >= config.critic_from - 200:
            with half_precision(self.device):
                real, fake = self.critic(truth[:, :3], glimpse), self.critic(clean[:, :3].detach(), glimpse)
                losses["critic"] = F.relu(1 - real).mean() + F.relu(1 + fake).mean()
            self._descend("critic_optimiser", self.critic, losses["critic"])
        keep = min(0.999, (step + 1) / (step + 20))
        with torch.no_grad():
            for smooth, raw in zip(self.smooth.parameters(), self.generator.parameters()):
                smooth.lerp_(raw, 1 - keep)
        return {name: float(value.detach()) for name, value in losses.items()}

    def _lesson(self, batch: int, rng: np.random.Generator, noise_rng: torch.Generator) -> Lesson:
        # A teacher sees recorded frames alone: its own, drawn in one step, would be those of another network.
        def dream(shown: Lesson) -> torch.Tensor:
            noise = torch.randn(batch, 4, *self.video.size, generator=noise_rng)
            shown = shown.to(self.device)
            with half_precision(self.device):
                clean = generate(self.generator, noise.to(self.device), shown.glimpse, shown.last, shown.told, 1)
            return clean.float().cpu()

        dreamer = dream if self.config.flow_steps == 1 else None
        if self.memory is not None and self.video.moving:
            return moving_lesson(self.recording, self.memory, self.video, batch, rng, dreamer)
        if self.memory is not None:
            return place_lesson(self.recording, self.memory, self.video, batch, rng, dreamer)
        return history_lesson(self.recording, self.video, batch, rng, dreamer)

    def _descend(self, name: str, module: nn.Module, loss: torch.Tensor) -> None:
        self.optimisers[name].zero_grad()
        loss.backward()
        norm = nn.utils.clip_grad_norm_(module.parameters(), 1.0)
        if not torch.isfinite(norm):
            raise TrainingError(
                f"a gradient of the {name} is not a number; the last save is good: lower --learning-rate."
            )
        self.optimisers[name].step()

    def _log(self, recent: list[dict], report) -> None:
        mean = {name: float(np.mean([one[name] for one in recent if name in one])) for name in recent[-1]}
        line = {"step": self.facts["step"], "seconds": round(self.facts["seconds"]), **mean}
        with open(self.out / "log.jsonl", "a") as file:
            file.write(json.dumps(line) + "\n")
        share = max(self.facts["step"] / self.config.steps, self.facts["seconds"] / (3600 * self.config.hours))
        report(share, 1.0, " ".join(f"{name} {value:.4f}" for name, value in mean.items()))

    def _save(self) -> None:
        save_run(self.out, self.modules, self.optimisers, self.facts)

    def world(self) -> VideoWorld | HistoryWorld:
        """The world as it now is."""
        about = self.cache.world
        modules = (self.generator, self.motion) if self.memory is not None else (self.generator,)
        card = {
            "what": f"Learned from {self.dataset.length:,} frames of {about.get('name', self.dataset.root.name)}",
            "data": f"{self.recording.usable.sum():,} frames, {len(self.cache.episodes) - len(self.held_out)} episodes",
            "steps": self.facts["step"],
            "hours": round(self.facts["seconds"] / 3600, 2),
            "keep_out": self.config.keep_out,
            "keyframes": 0 if self.memory is None else len(self.memory),
            "parameters": sum(p.numel() for module in modules for p in module.parameters()),
            **(self.facts["motion"] or {}),
            **(self.facts.get("outcome") or {}),
        }
        dt_s = about.get("dt_s", 1 / self.cache.fps)
        outcome = None if self.outcome is None else copy.deepcopy(self.outcome).cpu().float()
        vitals = () if outcome is None else outcome.config.vitals
        names = about.get("action_names") or self.cache.action_names  # of a choice, the recording names each
        named = (dt_s, names, about.get("keys", {}), card)
        spec = video_spec(self.config.name, self.video, *named, self.recording.controls, vitals)
        told = (self.cache.reward, self.cache.done)  # what a recording lacks is none of either
        reward, done = (np.zeros(self.cache.length) if part is None else np.array(part) for part in told)
        usual = float(np.median(reward))
        generator = copy.deepcopy(self.smooth).cpu().float()
        if self.memory is None:
            return HistoryWorld(spec, self.video, generator, self._starts(), usual, outcome, self.recording.controls)
        rewards = (usual, _ending_pays(reward - usual, done & np.array(self.cache.action_valid)))
        starts = open_views(self.memory, 32)
        if self.video.moving:  # monsters wait where episodes begin, and the player is well
            first = np.intersect1d(self.recording.start, np.flatnonzero(self.recording.usable))
            starts = self._keyframes_at(first[:: max(1, len(first) // 32)][:32]) if len(first) else starts
        body = {name: value for name, value in (self.facts["motion"] or {}).items() if name in ("body_m", "short")}
        return VideoWorld(
            spec, replace(self.video, **body), generator, self.motion, self.memory, starts, rewards, outcome=outcome
        )

    def _starts(self) -> Starts:
        """Where stories begin, in a world of history: some 32 moments of the recording, evenly."""
        slots, recording = self.video.slots, self.recording
        since = np.arange(self.cache.length) - recording.start
        rows = np.flatnonzero(self.happened.real & (since >= slots))  # from which it goes on
        if not len(rows):
            raise DatasetError(f"no episode is longer than the {slots} frames of history that a story begins with.")
        rows = rows[:: max(1, len(rows) // 32)]
        frames, led = rows[:, None] - np.arange(slots), rows[:, None] - 1 - np.arange(slots)
        return Starts(
            recording.rgb(frames.ravel()).view(*frames.shape, 3, *self.video.size),
            recording.action(led.ravel()).view(*led.shape, -1),
            torch.from_numpy(self.happened.vitals[rows]),
        )

    def draw_strip(self) -> None:
        """Truth above dream (64 steps of a held-out episode), with the memory and without; and the world as it now is,
        so that it can be played while it learns."""
        world = self.world()
        first, last = self.cache.episodes[(self.held_out or [0])[0]]
        begin = max(first, min(first + 40, last - 65))
        rows = np.arange(begin, min(begin + 65, last))
        lines = [self.recording.rgb(rows[::8])]
        if isinstance(world, VideoWorld):
            lines += [self._dream(one, rows, ("pose",)) for one in (world, world.without_memory())]
        else:
            lines.append(self._dream(world, rows, ()))
        picture = torch.cat([torch.cat(list(line), 2) for line in lines], 1).permute(1, 2, 0).numpy()
        Image.fromarray(picture).save(self.out / f"strip-{self.facts['step']:06d}.png")
        save_world(world, self.out / "world", dict(world.spec.card))

    def _dream(self, world: VideoWorld | HistoryWorld, rows: np.ndarray, evidence: tuple[str, ...]) -> torch.Tensor:
        """Every 8th frame of a dream from the first of `rows` on, along the recorded poses or the recorded actions."""
        rng, recording = make_rng(1), self.recording
        seen = {"rgb": recording.rgb(rows[:1]).permute(0, 2, 3, 1)}
        if evidence:
            seen |= {"depth": recording.depth(rows[:1]), "pose": recording.pose(rows[:1])}
        if self.video.moving:  # what moves depends on what is done
            seen, evidence = {**seen, "things": recording.things(rows[:1])}, ()
        state = world.observe(seen, None, rng)
        frames = [world.render(state, ("rgb",))["rgb"]]
        for row in rows[1:]:
            if evidence:
                state = world.observe({"pose": recording.pose([row])}, state, rng)
            else:
                action = self.cache.action[row - 1].astype(world.spec.action.dtype).reshape(world.spec.action.shape)
                state = world.imagine(state, torch.from_numpy(action)[None], rng)
            frames.append(world.render(state, ("rgb",))["rgb"])
        return torch.cat(frames)[::8].permute(0, 3, 1, 2)

    def finish(self, report) -> dict:
        config, done = self.config, (self.out / "world" / "world.json").exists()
        if not done or self.facts.get("sensed") != self.facts["step"]:
            self._finish(config, report)
        return {"world": str(self.out / "world"), **{k: v for k, v in self.facts.items() if k != "recipe"}}

    def _finish(self, config: TrainConfig, report) -> None:
        """The last strip, and the senses of the finished world."""
        self.draw_strip()
        world = self.world()
        settings = SensesConfig(config.eye_steps, config.doubt_frames, config.seed)
        keep = self.out / "eye.safetensors"
        sensing, facts = learn_senses(world, self.recording, self.held_out, config.keep_out, settings, report, keep)
        save_world(sensing, self.out / "world", {**world.spec.card, **facts})
        self.facts |= {**facts, "sensed": self.facts["step"]}
        self._save()


def _at_first(vitals: np.ndarray, recording: Recording) -> tuple[float, ...]:
    """The vitals [N, V] with which episodes begin."""
    first = np.unique(recording.start[recording.usable])
    return tuple(float(value) for value in np.median(vitals[first], 0))


def _ending_pays(extra: np.ndarray, ends: np.ndarray) -> float:
    """Reward above the usual in the last steps before an episode's end (games may pay a step or two before it)."""
    rows = np.flatnonzero(ends)
    return float(np.mean([extra[max(row - 3, 0) : row + 1].sum() for row in rows])) if len(rows) else 0.0


def _recipe(config: TrainConfig, dataset: Dataset) -> dict:
    """What must not change within a run; how long it goes on, and where, may."""
    fixed = asdict(replace(config, hours=0.0, device="", learning_rate=0.0, save_every_s=0, strip_every_s=0))
    return json.loads(json.dumps({**fixed, "frames": dataset.length}))


def _cosine(share: float) -> float:
    return 0.5 + 0.5 * float(np.cos(np.pi * min(share, 1.0)))


def sharpened(critic: Critic, clean: torch.Tensor, loss: torch.Tensor, glimpse: Glimpse, weight: float) -> torch.Tensor:
    """The critic's pull on dreamt frames, `weight` times as strong as the loss's own (Esser et al. 2021), and strongest
    where memory knows nothing: there the loss alone would draw a mean of all that could be."""
    dreamt = clean.detach()[:, :3].requires_grad_()
    with half_precision(clean.device):
        praise = critic(dreamt, glimpse).float()
    known = glimpse.known[:, None]
    if clean.shape[1] > 4:  # what moves is not known
        known = known * (1 - clean.detach()[:, 4:].sigmoid())
    invented = 1 - F.adaptive_avg_pool2d(known, praise.shape[-2:])
    (pull,) = torch.autograd.grad(-(praise * (0.2 + 0.8 * invented)).mean(), dreamt)
    (own,) = torch.autograd.grad(loss, clean, retain_graph=True)
    return (clean[:, :3] * (weight * own[:, :3].norm() / pull.norm().clamp_min(1e-12) * pull)).sum()


def frame_losses(
    clean: torch.Tensor, truth: torch.Tensor, weight: torch.Tensor | None = None
) -> dict[str, torch.Tensor]:
    """Mean absolute errors of frames [B, 4, H, W] in the generator's code: colour, depth, and colour's steps (edges).

    Where pixels count by `weight` [B, 1, H, W] (lessons.changing), colour's squared errors are added: absolute ones alone
    are least where nothing ever changes, for most pixels do not.
    """
    losses = {"rgb": _l1(clean[:, :3], truth[:, :3]), "depth": _l1(clean[:, 3:], truth[:, 3:])}
    if weight is not None:
        away = clean[:, :3] - truth[:, :3]
        losses["rgb"] = (weight * (0.2 * away.abs() + 2 * away.square())).mean()
    losses["edges"] = _l1(clean[:, :3].diff(dim=2), truth[:, :3].diff(dim=2))
    losses["edges"] = losses["edges"] + _l1(clean[:, :3].diff(dim=3), truth[:, :3].diff(dim=3))
    return losses


def flow_losses(clean: torch.Tensor, truth: torch.Tensor, time: torch.Tensor) -> dict[str, torch.Tensor]:
    """Squared errors, which alone make the flow end in the true distribution (Lipman et al. 2023), of frames predicted at
    flow time [B]; late ones count for more, for they are small and are the detail."""
    error = (clean - truth).square() / (1 - time).clamp_min(0.1)[:, None, None, None]
    return {"rgb": error[:, :3].mean(), "depth": error[:, 3:].mean()}


def _l1(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    return (a - b).abs().mean()


def _device(name: str) -> str:
    return name if name != "auto" else "cuda" if torch.cuda.is_available() else "cpu"


def half_precision(device: torch.device):
    """bfloat16 where the device computes it natively."""
    native = device.type == "cuda" or torch.backends.cpu.get_cpu_capability() == "AVX512" and _cpu_has_bf16()
    return torch.autocast(device.type, torch.bfloat16, enabled=native)


def _cpu_has_bf16() -> bool:
    """In hardware: where oneDNN only emulates it, it is 2.7 times slower than float32."""
    return torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported()
