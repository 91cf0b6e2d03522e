"""How the weights of `terrella space lift` were made: python recipes/lifter.py draw OUT, games OUT, train OUT, then export OUT.

draw makes training pictures of random rooms (about 15 a second of one core), games adds pictures of Doom's maps and of MuJoCo's
tables, train learns from both (--minutes; the same command goes on after a stop), export writes the weights of the package.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from terrella.learn.feeds import RandomBatches
from terrella.learn.objectives.lifting import LayeredPictures, LiftingObjective
from terrella.learn.run_folder import load_run, resume_file
from terrella.learn.trainer import Run, Trainer
from terrella.space.lifting.network import WEIGHTS, LifterConfig, save_lifter
from terrella.space.lifting.pictures import random_pictures
from terrella.space.lifting.textures import atlas_of

SIDE, SHARD = 128, 400
TRAINING, HELD_OUT = 1, 2  # first parts of seeds


def draw(out: Path, minutes: float, kind: int = TRAINING) -> None:
    """Shards of SHARD pictures of random rooms; those that exist are kept."""
    out.mkdir(parents=True, exist_ok=True)
    began, shard = time.monotonic(), 0
    while time.monotonic() - began < 60 * minutes:
        file = out / f"rooms-{shard:04d}.npz"
        if not file.exists():
            pictures = random_pictures(
                np.random.default_rng([kind, shard]), atlas_of(1000 * kind + shard), (SIDE, SIDE)
            )
            rows = []
            for _, (shown, _, shot, _) in zip(range(SHARD), pictures):
                lens = [shot.focal, shot.pitch, shot.roll, shot.height_m]
                rows.append(
                    (shown.rgb, shown.depth.astype(np.float16), shown.behind.astype(np.float16), shown.behind_rgb, lens)
                )
            parts = [np.stack(part) for part in zip(*rows)]
            save(file, *parts)
            print(f"{file.name}: {SHARD * (shard + 1):,} pictures after {time.monotonic() - began:.0f} s", flush=True)
        shard += 1


def save(file: Path, rgb, depth, behind, behind_rgb, lens) -> None:
    """One shard: rgb uint8 [N, H, W, 3], depth float16 [N, H, W] (0: unknown), behind float16 [N, H/2, W/2] (0: none, -1: unknown),
    behind_rgb uint8 [N, H/2, W/2, 3], lens float32 [N, 4]: focal length in widths, pitch and roll in radians, height in metres."""
    part = file.with_suffix(".part.npz")
    np.savez(part, rgb=rgb, depth=depth, behind=behind, behind_rgb=behind_rgb, lens=np.asarray(lens, np.float32))
    part.rename(file)


def games(out: Path, count: int = 400) -> None:
    """`count` pictures each of the maps of Doom that may be seen, and of tables."""
    from lifter_games import MAPS, UNSEEN_MAPS, doom_pictures, random_tables, table_pictures

    rng = np.random.default_rng([TRAINING, 0])
    maps = [name for name in MAPS if name not in UNSEEN_MAPS]
    for name, pictures in (
        ("doom", doom_pictures(maps, count, 1)),
        ("tables", table_pictures(random_tables(rng), count, rng)),
    ):
        rgb, depth, lens = (np.stack(part) for part in zip(*pictures))
        half = (len(rgb), rgb.shape[1] // 2, rgb.shape[2] // 2)
        unknown = np.full(half, -1, np.float16), np.zeros((*half, 3), np.uint8)
        save(out / f"{name}.npz", rgb, depth.astype(np.float16), *unknown, lens)
        print(f"{len(rgb)} pictures of {name}", flush=True)


@dataclass(frozen=True)
class LiftTraining:
    """Settings of the training."""

    hours: float  # of all runs together
    batch: int = 16  # pictures a step
    learning_rate: float = 2e-3
    seed: int = 0
    save_every_s: float = 60.0


def train(out: Path, minutes: float) -> None:
    """A run in OUT/run on the pictures in OUT."""
    torch.set_num_threads(1)
    config = LiftTraining(minutes / 60)
    torch.manual_seed(config.seed)
    run = Run.of(
        out / "run",
        config,
        lambda done, whole, words: print(f"{done / whole:.1%} {words}", flush=True),
        free=("hours",),
    )
    pictures, objective = LayeredPictures(out), LiftingObjective(LifterConfig(), config.learning_rate)
    Trainer(run, "lifter", RandomBatches(lambda now: pictures.batch(config.batch, now)), objective, 10**9).train()


def export(out: Path) -> None:
    """The averaged weights of the run, as the package has them."""
    average = LiftingObjective(LifterConfig(), 0.0).modules["average"]
    facts = load_run(resume_file(out / "run", "lifter"), {"average": average}, {})
    if facts is None:
        raise SystemExit(f"{out}/run holds no run; python recipes/lifter.py train {out}")
    save_lifter(average.module, WEIGHTS)
    print(
        f"{WEIGHTS}: {WEIGHTS.stat().st_size / 1e6:.1f} MB after {facts['step']:,} steps; now python benchmarks/lift.py --store"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("draw", "games", "train", "export"))
    parser.add_argument("out", type=Path)
    parser.add_argument("--minutes", type=float, default=50)
    given = parser.parse_args()
    if given.what == "draw":
        draw(given.out, given.minutes)
    elif given.what == "games":
        games(given.out)
    elif given.what == "train":
        train(given.out, given.minutes)
    elif given.what == "export":
        export(given.out)


if __name__ == "__main__":
    main()
