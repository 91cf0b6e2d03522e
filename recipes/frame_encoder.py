"""Makes the scorecard's fixed eye: record frames, train it on spoilt pictures of them, and print what it can tell apart.

python recipes/frame_encoder.py record OUT      # pictures.safetensors: games, drawings, classic control; 4 minutes
python recipes/frame_encoder.py train OUT       # OUT/frame_encoder.safetensors and its SHA-256; 5 minutes of one core
python recipes/frame_encoder.py table OUT       # the table of docs/lab/log.md, on maps that training never saw

Two lessons at once. Each picture is spoilt in one or two of a dozen ways, and two crops of it are spoilt alike: the eye
must say how, and how much (regression), and it must know the other crop again among those of other pictures and of the
same picture spoilt otherwise (contrast). Nothing is labelled by hand and nothing is downloaded.
"""

from __future__ import annotations

import argparse
import hashlib
import math
import multiprocessing
import time
from pathlib import Path

import gymnasium
import numpy as np
import torch
import torch.nn.functional as F
from frame_distortions import LEVELS, NEW_WAYS, WAYS, blur, spoil  # beside this file
from PIL import Image, ImageDraw
from safetensors.torch import load_file, save_file
from torch import nn

import terrella
from terrella.measure.encoder import FEATURES, FrameEncoder, encoder_of, frame_features
from terrella.measure.fidelity import psnr
from terrella.measure.frechet import frechet_interval
from terrella.sim.doom import Doom, DoomConfig

SIZE = (96, 128)
SEEN = ("my_way_home", "deadly_corridor", "health_gathering", "defend_the_center", "take_cover", "basic")
UNSEEN = ("deathmatch", "health_gathering_supreme", "defend_the_line")
CONTROL = ("CartPole-v1", "Acrobot-v1", "MountainCar-v0", "Pendulum-v1")


# --- pictures ---------------------------------------------------------------------------------------------------------


def play(scenario: str, count: int, seed: int, every: int = 5) -> np.ndarray:
    """Frames uint8 [count, H, W, 3] of a player who holds random keys, one of `every` tics."""
    rng, world, frames = terrella.make_rng(seed), Doom(DoomConfig(scenario=scenario, size=SIZE)), []
    state, held, left, tic = world.start(1, rng), None, 0, 0
    while len(frames) < count:
        if left == 0:
            held = torch.rand(1, 6, generator=rng) < torch.tensor([0.5, 0.1, 0.15, 0.15, 0.3, 0.3])
            left = int(torch.randint(4, 25, (1,), generator=rng))
        state, left, tic = world.imagine(state, held.to(torch.int8), rng), left - 1, tic + 1
        seen = world.render(state, ("rgb", "done"))
        if bool(seen["done"]) or tic % 700 == 0:
            state = world.start(1, rng)
        elif tic % every == 0:
            frames.append(seen["rgb"][0].numpy())
    world.close()
    return np.stack(frames)


def control(name: str, count: int, seed: int) -> np.ndarray:
    """Frames of a Gymnasium environment under random actions, shrunk."""
    env, frames = gymnasium.make(name, render_mode="rgb_array"), []
    env.action_space.seed(seed)
    env.reset(seed=seed)
    while len(frames) < count:
        for _ in range(3):
            _, _, ended, cut, _ = env.step(env.action_space.sample())
            if ended or cut:
                env.reset()
        frames.append(np.asarray(Image.fromarray(env.render()).resize(SIZE[::-1], Image.Resampling.BOX)))
    env.close()
    return np.stack(frames)


def drawings(count: int, seed: int) -> np.ndarray:
    """Drawn pictures: a textured ground with shapes, lines and coloured noise on it."""
    rng = np.random.default_rng(seed)
    return np.stack([_drawing(rng) for _ in range(count)])


def _drawing(rng: np.random.Generator, shapes: int | None = None) -> np.ndarray:
    picture = Image.fromarray(_ground(rng))
    draw = ImageDraw.Draw(picture)
    for _ in range(int(rng.integers(0, 12)) if shapes is None else shapes):
        x, y = rng.integers(0, SIZE[1]), rng.integers(0, SIZE[0])
        w, h = rng.integers(3, 45, 2)
        colour = tuple(int(c) for c in rng.integers(0, 256, 3))
        kind = rng.integers(0, 5)
        box = (int(x), int(y), int(x + w), int(y + h))
        if kind == 0:
            draw.rectangle(box, fill=colour)
        elif kind == 1:
            draw.ellipse(box, fill=colour)
        elif kind == 2:
            draw.polygon([(int(a), int(b)) for a, b in rng.uniform((x, y), (x + w, y + h), (3, 2))], fill=colour)
        elif kind == 3:
            draw.line(box, fill=colour, width=int(rng.integers(1, 5)))
        else:
            tile = Image.fromarray(_ground(rng)).crop((0, 0, int(w), int(h)))
            picture.paste(tile, (int(x), int(y)))
    return np.asarray(picture)


def _ground(rng: np.random.Generator) -> np.ndarray:
    h, w = SIZE
    rows, columns = np.mgrid[0:h, 0:w].astype(np.float64)
    first, second = rng.uniform(0, 255, (2, 3))
    kind = rng.integers(0, 5)
    if kind == 0:  # gradient
        angle = rng.uniform(0, 2 * math.pi)
        share = (np.cos(angle) * rows + np.sin(angle) * columns) / 100
    elif kind == 1:  # bricks or checks
        high, wide = rng.integers(3, 24, 2)
        shift = (rows // high % 2) * wide / 2 * rng.integers(0, 2)
        share = (
            np.minimum(rows % high < 1, 1) + ((columns + shift) % wide < 1)
            if rng.random() < 0.5
            else ((rows // high + (columns + shift) // wide) % 2)
        )
    elif kind == 2:  # stripes
        angle, pitch = rng.uniform(0, math.pi), rng.uniform(3, 30)
        share = 0.5 + 0.5 * np.sin((np.cos(angle) * rows + np.sin(angle) * columns) * 2 * math.pi / pitch)
    elif kind == 3:  # noise with a falling spectrum
        share = _coloured_noise(rng, rng.uniform(0.5, 2.2))
    else:  # floor, wall and ceiling
        top, bottom = np.sort(rng.integers(0, h, 2))
        share = np.where(rows < top, 0.0, np.where(rows < bottom, 0.5, 1.0)) + 0.15 * _coloured_noise(rng, 1.0)
    ground = first + (second - first) * np.clip(share, 0, 1)[..., None]
    grain = rng.choice([0, 6, 20]) * _coloured_noise(rng, rng.uniform(0.2, 1.2))[..., None]
    return np.clip(ground + grain, 0, 255).astype(np.uint8)


def _coloured_noise(rng: np.random.Generator, power: float) -> np.ndarray:
    """Noise [H, W] whose amplitude falls as frequency to `power`, mean 0.5."""
    rate = np.hypot(np.fft.fftfreq(SIZE[0])[:, None], np.fft.rfftfreq(SIZE[1])[None])
    rate[0, 0] = 1
    noise = np.fft.irfft2(np.fft.rfft2(rng.standard_normal(SIZE)) / rate**power, SIZE)
    return 0.5 + 0.25 * (noise - noise.mean()) / noise.std()


def record(out: Path, count: int) -> None:
    """Every part by a process of its own: a ViZDoom that was closed is not always opened again."""
    out.mkdir(parents=True, exist_ok=True)
    jobs = {f"train/{name}": (play, name, count, 0) for name in SEEN}
    jobs |= {f"train/{name}": (control, name, count // 4, 0) for name in CONTROL}
    jobs |= {"train/drawings": (_drawn, "", 3 * count, 0)}
    jobs |= {f"test/{name}": (play, name, count, 1) for name in (*UNSEEN, "my_way_home")}
    jobs |= {"test/drawings": (_drawn, "", count, 1)}
    with multiprocessing.get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
        waiting = {name: pool.apply_async(job, rest) for name, (job, *rest) in jobs.items()}
        pictures = {}
        for name, result in waiting.items():
            pictures[name] = torch.from_numpy(result.get())
            print(name, tuple(pictures[name].shape), flush=True)
    save_file(pictures, out / "pictures.safetensors")


def _drawn(_: str, count: int, seed: int) -> np.ndarray:
    return drawings(count, seed)


# --- training -----------------------------------------------------------------------------------------------------------


class Pupil(nn.Module):
    """The encoder's convolutions while they learn, each with a batch norm, and what the two lessons need beyond them."""

    def __init__(self):
        super().__init__()
        self.eye = FrameEncoder()
        self.eye.convs = nn.ModuleList(nn.Sequential(c, nn.BatchNorm2d(c.out_channels)) for c in self.eye.convs)
        width = self.eye.last.in_features
        self.narrow = nn.Sequential(nn.BatchNorm1d(width, affine=False), nn.Linear(width, 64))
        self.tell = nn.Linear(64, len(WAYS))
        self.know = nn.Sequential(nn.Linear(64, 128), nn.ReLU(), nn.Linear(128, 64))

    def forward(self, x: torch.Tensor):
        seen = self.narrow(self.eye.pooled(x))
        return self.tell(seen), F.normalize(self.know(seen), dim=1)

    def finished(self) -> FrameEncoder:
        """The plain encoder, batch norms folded into its convolutions; its read-out is still to be made."""
        done = FrameEncoder()
        with torch.no_grad():
            for mine, (conv, norm) in zip(done.convs, self.eye.convs):
                factor = norm.weight / (norm.running_var + norm.eps).sqrt()
                mine.weight.copy_(conv.weight * factor.view(-1, 1, 1, 1))
                mine.bias.copy_((conv.bias - norm.running_mean) * factor + norm.bias)
        return done.eval().requires_grad_(False)


def read_out(eye: FrameEncoder, pictures: torch.Tensor, rng) -> None:
    """Sets the eye's last map (Fisher 1936): directions in which spoiling moves a picture [N, H, W, 3] much beside how
    sound pictures differ, each sized by that ratio and together so that sound pictures vary by 1 in the mean."""
    plain = pictures.permute(0, 3, 1, 2).float()
    way = torch.randint(len(WAYS), (len(plain),), generator=rng)
    strength = torch.rand(len(plain), generator=rng)
    sound, moved = [], []
    for part, ways, much in zip(plain.split(50), way.split(50), strength.split(50)):
        sound.append(eye.pooled(part).double())
        moved.append(eye.pooled(spoil(part, ways, much, rng)).double() - sound[-1])
    clean, change = torch.cat(sound), torch.cat(moved)
    scale = 1 / clean.std(0).clamp_min(1e-3)
    between, within = change * scale, torch.cov((clean * scale).T)
    within += 0.03 * within.diagonal().mean() * torch.eye(len(within))
    spread, axes = torch.linalg.eigh(within)
    white = axes / spread.sqrt()
    ratio, turn = torch.linalg.eigh(white.T @ (between.T @ between / len(between)) @ white)
    best = scale[:, None] * (white @ turn.flip(1)[:, :FEATURES])
    size = ratio.flip(0)[:FEATURES].sqrt()
    seen = clean @ best
    best, mean, size = best / seen.std(0), seen.mean(0) / seen.std(0), size * seen.std(0)
    eye.last.weight.copy_(best.T)
    eye.last.bias.copy_(-mean)
    eye.gain.copy_(size / size.square().mean().sqrt())


def batch_of(pictures: torch.Tensor, bases: int, rng) -> tuple[torch.Tensor, torch.Tensor]:
    """Crops [4 * bases, 3, h, w] and the strength of each way [4 * bases, ways].

    Each of `bases` pictures is spoilt in two ways, and two crops of each are taken: rows k and k + 2 * bases are alike.
    """
    count = 2 * bases
    rows = torch.randint(len(pictures), (bases,), generator=rng).repeat(2)
    first = torch.randint(-2, len(WAYS), (count,), generator=rng)  # two in fourteen are left as they are
    second = torch.where(torch.rand(count, generator=rng) < 0.25, torch.randint(len(WAYS), (count,), generator=rng), -1)
    much, more = torch.rand(count, generator=rng), torch.rand(count, generator=rng)
    target = torch.zeros(count, len(WAYS))
    for way, strength in ((first, much), (second, more)):
        some = way >= 0
        target[some, way[some]] = torch.maximum(target[some, way[some]], strength[some])
    high, wide = (int(torch.randint(6, top, (), generator=rng)) * 8 for top in (10, 11))
    crops = []
    for _ in range(2):
        cut = []
        for row in rows.tolist():
            top = int(torch.randint(SIZE[0] - high + 1, (), generator=rng))
            left = int(torch.randint(SIZE[1] - wide + 1, (), generator=rng))
            piece = pictures[row, top : top + high, left : left + wide].permute(2, 0, 1).float()
            cut.append(piece.flip(2) if torch.rand((), generator=rng) < 0.5 else piece)
        plain = torch.stack(cut)
        crops.append(spoil(spoil(plain, first, much, rng), second, more, rng))
    return torch.cat(crops), target.repeat(2, 1)


def train(
    out: Path, steps: int, bases: int = 20, seed: int = 0, regression: float = 8.0, contrast: float = 0.5
) -> None:
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    rng = terrella.make_rng(seed)
    parts = {name: part for name, part in load_file(out / "pictures.safetensors").items() if name.startswith("train/")}
    pictures = torch.cat(list(parts.values()))
    pupil = Pupil().to(memory_format=torch.channels_last)
    optimiser = torch.optim.AdamW(pupil.parameters(), lr=2e-3, weight_decay=1e-3)
    began = time.process_time()
    losses: list[list[float]] = []
    for step in range(1, steps + 1):
        for group in optimiser.param_groups:
            group["lr"] = 2e-3 * min(1, step / 50) * (0.5 + 0.5 * math.cos(math.pi * step / steps))
        crops, target = batch_of(pictures, bases, rng)
        guess, name = pupil(crops.contiguous(memory_format=torch.channels_last))
        regress = F.smooth_l1_loss(guess, target, beta=0.1)
        alike = (name @ name.T / 0.15).fill_diagonal_(-1e9)
        partner = torch.arange(len(name)).roll(len(name) // 2)
        contrast_loss = F.cross_entropy(alike, partner)
        optimiser.zero_grad()
        (regression * regress + contrast * contrast_loss).backward()
        optimiser.step()
        right = (alike.argmax(1) == partner).float().mean()
        losses.append([float(regress.detach()), float(contrast_loss.detach()), float(right)])
        if step % 50 == 0:
            means, took = np.mean(losses[-50:], 0), time.process_time() - began
            print(
                f"{step} {took:.0f}s regression {means[0]:.4f} contrast {means[1]:.3f} right {means[2]:.2f}", flush=True
            )
    done = pupil.finished()
    read_out(done, pictures[torch.randperm(len(pictures), generator=rng)[:2400]], rng)
    path = out / "frame_encoder.safetensors"
    save_file({name: tensor.contiguous() for name, tensor in done.state_dict().items()}, path)
    print(f"{steps} steps, {path.stat().st_size} bytes, SHA-256 {hashlib.sha256(path.read_bytes()).hexdigest()}")


# --- the table ------------------------------------------------------------------------------------------------------------


def pixel_statistics(frames: torch.Tensor) -> torch.Tensor:
    """A thumbnail, the deviation of each channel and the gradient: what one can know without an encoder [N, 53]."""
    x = frames.permute(0, 3, 1, 2).double()
    steps = [x.diff(dim=dim).square().mean((1, 2, 3)).sqrt()[:, None] for dim in (2, 3)]
    return torch.cat([F.adaptive_avg_pool2d(x, 4).flatten(1), x.std((2, 3)), *steps], 1)


def eyes_of(out: Path, seen: torch.Tensor, plain: torch.Tensor) -> dict:
    """The eyes to compare, each scaled so that the unspoilt pictures `plain` [N, H, W, 3] vary by 1 in the mean.

    Random weights get the same read-out as the trained ones, from the pictures of the training.
    """
    path = out / "frame_encoder.safetensors"
    trained = encoder_of(path.read_bytes(), hashlib.sha256(path.read_bytes()).hexdigest())
    torch.manual_seed(1)
    blank = FrameEncoder().eval().requires_grad_(False)
    rng = terrella.make_rng(2)
    read_out(blank, seen[torch.randperm(len(seen), generator=rng)[:1200]], rng)
    looks = {
        "trained": lambda frames: frame_features(frames, trained),
        "random weights": lambda frames: frame_features(frames, blank),
        "pixel statistics": pixel_statistics,
    }

    def scaled(eye):
        size = eye(plain).var(0).mean().sqrt()
        return lambda frames: eye(frames) / size

    return {name: scaled(eye) for name, eye in looks.items()}


def spoilt(frames: torch.Tensor, way, level: float, rng) -> torch.Tensor:
    x = frames.permute(0, 3, 1, 2).float()
    return way(x, torch.full((len(x),), level), rng).clamp(0, 255).round().byte().permute(0, 2, 3, 1)


def table(out: Path, count: int = 100) -> None:
    """Frames of maps that training never saw, against as many others of the same map, spoilt: distance [interval]."""
    torch.set_num_threads(1)
    stored = load_file(out / "pictures.safetensors")
    tests = {name: stored[f"test/{name}"] for name in (*UNSEEN[:2], "drawings")}
    seen = torch.cat([part for name, part in stored.items() if name.startswith("train/")])
    eyes = eyes_of(out, seen, torch.cat([part[::5] for part in tests.values()]))
    rng, ladders = terrella.make_rng(7), {}
    for name, frames in tests.items():
        rows = torch.randperm(len(frames), generator=rng)[: 2 * count]
        real, other = frames[rows[:count]], frames[rows[count:]]
        truth = {eye: look(real) for eye, look in eyes.items()}
        for way in (None, *WAYS, *NEW_WAYS):
            for level in LEVELS if way else (0.0,):
                shown = spoilt(other, way, level, rng) if way else other
                for eye, look in eyes.items():
                    found = frechet_interval(truth[eye], look(shown))
                    ladders[eye, name, way.__name__ if way else "", level] = found
    names = [way.__name__ for way in (*WAYS, *NEW_WAYS)]
    for eye in eyes:
        floors = {name: ladders[eye, name, "", 0.0] for name in tests}
        print(f"\n{eye}; two halves of real frames: {', '.join(map(str, floors.values()))}")
        rises = seen = cells = 0
        for way in names:
            steps = [[ladders[eye, name, way, level] for level in LEVELS] for name in tests]
            rise = [all(a.value < b.value for a, b in zip(row, row[1:])) for row in steps]
            differs = [[f.low > floors[name].high for f in row] for name, row in zip(tests, steps)]
            rises, seen, cells = rises + sum(rise), seen + sum(map(sum, differs)), cells + sum(map(len, differs))
            means = " | ".join(f"{np.mean([row[k].value for row in steps]):.3g}" for k in range(len(LEVELS)))
            first = " ".join(f"{f.value:.3g} [{f.low:.3g}, {f.high:.3g}]" for f in steps[0])
            print(
                f"| {way} | {means} | {sum(rise)}/{len(rise)} | {sum(map(sum, differs))}/{sum(map(len, differs))} | {first}"
            )
        print(f"{eye}: rises in {rises} of {len(names) * len(tests)}, differs from real in {seen} of {cells}")
    versus(tests, eyes, rng, count)


def versus(tests, eyes, rng, count: int) -> None:
    """Blurred dreams against sharp ones that are slightly out of place: the first win in PSNR and should lose here."""
    for name, frames in tests.items():
        real = frames[torch.randperm(len(frames), generator=rng)[:count]]
        dreams = {f"blur sigma {3 * level:.2g}": spoilt(real, blur, level, rng) for level in (0.25, 0.4)}
        for shift in (2, 4):
            dreams[f"moved {shift} pixels"] = real.roll((shift, shift), (1, 2))
        dreams["two futures averaged"] = ((real.float() + real.roll((4, 4), (1, 2)).float()) / 2).byte()
        for label, dream in dreams.items():
            likeness = float(psnr(dream, real).mean())
            figures = "; ".join(f"{eye} {frechet_interval(look(real), look(dream))}" for eye, look in eyes.items())
            print(f"{name}, {label}: {likeness:.1f} dB; {figures}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("record", "train", "table"))
    parser.add_argument("out", type=Path)
    parser.add_argument("--count", type=int, default=900, help="frames of each game to record")
    parser.add_argument("--steps", type=int, default=1200)
    given = parser.parse_args()
    if given.what == "record":
        record(given.out, given.count)
    elif given.what == "train":
        train(given.out, given.steps)
    else:
        table(given.out)


if __name__ == "__main__":
    main()
