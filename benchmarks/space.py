"""Times Gaussian splatting: pictures drawn a second, and steps of a fit (draw, gradients, Adam) a second.

python benchmarks/space.py [--threads 2] [--repeats 30] [--json]
python benchmarks/space.py --rooms [--steps 1000] [--gaussians 30000]   # fits a room of Doom and one in MuJoCo

The scene is a room of 8 x 6 x 3 m with four pillars, its surfaces covered evenly by N flat Gaussians of opacity 0.9 that touch one
another, seen from eight headings; about half of it is in sight. Of each
heading the best of all rounds counts, and the mean over headings: other work on the machine only slows down.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable

import torch

from terrella.space.camera import planar_pose
from terrella.space.fitting import Fit, FitConfig, decibels, nearest_views, psnr
from terrella.space.raster import Gaussians, rasterise
from terrella.space.raster.gaussians import plain_sh

LENS = (0.5, 0.5, 0.5, 0.5)
RENDERS = ((50_000, (256, 256), 100), (200_000, (256, 256), 45), (500_000, (512, 512), 12))
FIT, FIT_SIZE, FIT_BAR = 10_000, (192, 256), 40


def room(count: int, seed: int = 0) -> Gaussians:
    """`count` Gaussians on the surfaces of the room."""
    rng = torch.Generator().manual_seed(seed)
    boxes = [((0.0, 0.0, 0.0), (8.0, 6.0, 3.0))] + [
        ((x, y, 0.0), (x + 0.5, y + 0.5, 3.0)) for x in (2, 5.5) for y in (1.5, 4)
    ]
    sides = []
    for low, high in boxes:
        for axis in range(3):
            for end in (low, high):
                if axis < 2 or low == (0.0, 0.0, 0.0):
                    sides.append((axis, end[axis], low, high))
    areas = torch.tensor([_area(axis, low, high) for axis, _, low, high in sides])
    which = torch.multinomial(areas, count, replacement=True, generator=rng)
    low, high = (torch.tensor([side[2 + end] for side in sides])[which] for end in (0, 1))
    means = low + (high - low) * torch.rand(count, 3, generator=rng)
    axis, value = (torch.tensor([side[part] for side in sides])[which] for part in (0, 1))
    rows = torch.arange(count)
    means[rows, axis] = value
    scales = torch.full((count, 3), float((areas.sum() / count).sqrt()) * 0.6)
    scales[rows, axis] = 0.002
    colours = 0.5 + 0.5 * torch.sin(means * torch.tensor([3.0, 5.0, 7.0]))
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1)
    return Gaussians(means, quats, scales, torch.full((count,), 0.9), plain_sh(colours))


def _area(axis: int, low, high) -> float:
    edges = [high[one] - low[one] for one in range(3) if one != axis]
    return edges[0] * edges[1]


def poses() -> torch.Tensor:
    """Eight headings from a place in the room."""
    heading = torch.arange(8) * (torch.pi / 4)
    return planar_pose(torch.full((8,), 4.0), torch.full((8,), 3.0), torch.full((8,), 1.5), heading)


def frames_a_second(count: int, size: tuple[int, int], repeats: int) -> tuple[float, float]:
    """Pictures drawn without gradients."""
    scene = room(count)
    with torch.no_grad():
        return _best([lambda pose=pose: rasterise(scene, pose[None], LENS, size) for pose in poses()], repeats)


def _best(jobs: list[Callable[[], object]], repeats: int) -> tuple[float, float]:
    """How many such jobs a second can do, and a second of processor time of one core; each as fast as its best round."""
    best, cpu = [float("inf")] * len(jobs), [float("inf")] * len(jobs)
    for _ in range(repeats + 1):
        for at, job in enumerate(jobs):
            begun, used = time.perf_counter(), time.process_time()
            job()
            best[at] = min(best[at], time.perf_counter() - begun)
            cpu[at] = min(cpu[at], time.process_time() - used)
    return len(jobs) / sum(best), len(jobs) / sum(cpu)


def steps_a_second(repeats: int) -> tuple[float, float]:
    """Whole steps of a fit: a picture, its gradients, Adam."""
    truth = room(FIT)
    with torch.no_grad():
        goal = rasterise(truth, poses(), LENS, FIT_SIZE).rgb
    starts = truth.means, truth.quats, truth.scales.log(), truth.opacities.logit(), truth.sh
    leaves = [start.clone().requires_grad_() for start in starts]
    adam = torch.optim.Adam(leaves, 1e-3, fused=True)

    def step(pose: torch.Tensor, picture: torch.Tensor) -> None:
        means, quats, scales, opacities, sh = leaves
        scene = Gaussians(means, quats, scales.exp(), opacities.sigmoid(), sh)
        adam.zero_grad()
        (rasterise(scene, pose[None], LENS, FIT_SIZE).rgb[0] - picture).abs().mean().backward()
        adam.step()

    return _best([lambda pair=pair: step(*pair) for pair in zip(poses(), goal)], repeats)


def fit_rooms(gaussians: int, steps: int) -> None:
    """Fits two rooms, every eighth picture kept from the fit, and prints how those come out."""
    from rooms import doom_room, mujoco_room

    for name, made, bar_db, bar_s in (("Doom", doom_room, 27, 180), ("MuJoCo", mujoco_room, 28, 300)):
        views = made()
        held = torch.arange(len(views)) % 8 == 4
        kept, asked = views.at(~held), views.at(held)
        begun, used = time.perf_counter(), time.process_time()
        fit = Fit(kept, FitConfig(gaussians=gaussians, steps=steps))
        while fit.done < steps:
            fit.step()
        spent, busy = time.perf_counter() - begun, time.process_time() - used
        found = psnr(fit.gaussians, asked)
        near = nearest_views(kept, asked)
        copied = torch.stack([decibels(kept.rgb[a].float() - b.float()) for a, b in zip(near, asked.rgb)])
        db, by = float(found.mean()), float(1.96 * found.std() / len(found) ** 0.5)
        print(
            f"a room of {name}: {db:.1f} dB (+-{by:.1f}) on {len(asked)} kept from the fit of {len(kept)}, bar {bar_db}; "
            f"the nearest picture {float(copied.mean()):.1f}; {spent:.0f} s ({busy:.0f} s of a processor), bar {bar_s}"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=30)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--rooms", action="store_true")
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--gaussians", type=int, default=30_000)
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    if given.rooms:
        fit_rooms(given.gaussians, given.steps)
        return
    rows = {f"{n // 1000}k Gaussians at {size[0]}x{size[1]}, frames/s": (frames_a_second(n, size, given.repeats), bar)
            for n, size, bar in RENDERS}  # fmt: skip
    rows[f"{FIT // 1000}k Gaussians at {FIT_SIZE[0]}x{FIT_SIZE[1]}, steps/s"] = steps_a_second(given.repeats), FIT_BAR
    if given.json:
        print(
            json.dumps(
                {
                    name: {"value": value, "per_core_second": cpu, "bar": bar}
                    for name, ((value, cpu), bar) in rows.items()
                }
            )
        )
        return
    for name, ((value, cpu), bar) in rows.items():
        print(f"{name:45} {value:7.1f}   bar {bar} ({value / bar:.2f} x)   {cpu:.1f} a second of one core")


if __name__ == "__main__":
    main()
