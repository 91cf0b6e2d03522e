"""Overlap: whether cameras whose fields of view overlap show the same there, in a rollout as in the recording."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations

import torch
import torch.nn.functional as F

from ..core.spec import Camera, Spec
from ..core.world import Observation, World
from ..space.overlap import MountedCamera, seen_by
from .clips import Clip
from .exam import CLIPS, Exam, ExamResults, Probe
from .rollouts import Results, StepMetric, rows_at
from .scorecard import PREDICTED, ProbeReport, Row
from .statistics import ratio_interval

LEAD = (
    "Where two cameras see the same directions, their pictures are compared pixel by pixel: the mean difference in the rollout "
    "over that in the recording, which is not 0, for cameras stand apart and pixels are coarse. 1 is as consistent as the truth. "
    "Blurred pictures agree easily: look at sharpness beside it. The baseline compares each picture with that of another clip."
)
FEWEST = 32  # pixels of an overlap


@dataclass(frozen=True)
class Overlap:
    """The part of the pictures of camera `one` that camera `other` sees, too."""

    one: str
    other: str
    grid: torch.Tensor  # [1, H, W, 2], where the pixels of `one` are in the pictures of `other`, -1 to 1
    seen: torch.Tensor  # bool [H, W]


def overlaps_of(spec: Spec, names: Sequence[str]) -> list[Overlap]:
    """The overlaps of each two of these picture channels whose cameras are mounted on one body."""
    cameras = {name: spec.cameras[name] for name in names if name in spec.cameras}
    pairs = ((one, other) for one, other in combinations(cameras, 2) if cameras[one].pose == cameras[other].pose)
    made = [_overlap(one, other, cameras[one], cameras[other]) for one, other in pairs]
    return [overlap for overlap in made if overlap.seen.sum() >= FEWEST]


def _overlap(one: str, other: str, camera: Camera, beside: Camera) -> Overlap:
    first, second = (MountedCamera(each.intrinsics, each.mount) for each in (camera, beside))
    at, seen = seen_by(second, first, camera.size)
    return Overlap(one, other, 2 * at[None] - 1, seen)


def disagreement(one: torch.Tensor, other: torch.Tensor, overlap: Overlap) -> torch.Tensor:
    """The mean difference [B], of 255, of pictures uint8 [B, H, W, 3] of two cameras in their overlap."""
    first, second = (pictures.cpu().float().permute(0, 3, 1, 2) for pictures in (one, other))
    looked = F.grid_sample(
        second, overlap.grid.expand(len(second), -1, -1, -1), padding_mode="border", align_corners=False
    )
    return (first - looked).abs().mean(1)[:, overlap.seen].mean(1)


def _metric(overlaps: Sequence[Overlap], seen: Observation, clips: Sequence[Clip], row: int, step: int) -> Results:
    kept: dict[str, list[torch.Tensor]] = {"overlap": [], "overlap, truth": [], "overlap, another": []}
    for overlap in overlaps:
        one, other = (rows_at(clips, name, row) for name in (overlap.one, overlap.other))
        kept["overlap"].append(disagreement(seen[overlap.one], seen[overlap.other], overlap))
        kept["overlap, truth"].append(disagreement(one, other, overlap))
        kept["overlap, another"].append(disagreement(one, other.roll(1, 0), overlap))
    return {name: torch.stack(values).mean(0) for name, values in kept.items()}


def _of(exam: Exam, world: World) -> list[Overlap]:
    return exam.once(f"overlaps {id(world)}", lambda: overlaps_of(world.spec, exam.shared(world, "rgb")))


def _watch(exam: Exam, world: World, of: str, first: int) -> list[StepMetric]:
    overlaps = _of(exam, world) if of == CLIPS else []
    names = {name: None for overlap in overlaps for name in (overlap.one, overlap.other)}
    return [StepMetric(tuple(names), partial(_metric, overlaps))] if overlaps else []


def _report(exam: Exam, results: ExamResults) -> ProbeReport:
    whole = ProbeReport()
    for place, _, arm, _, dreamt in results.dreams(exam, CLIPS, (PREDICTED,)):
        for step in exam.config.horizons if "overlap" in dreamt else ():
            mine, truth, other = (dreamt[f"overlap{end}"][:, step - 1] for end in ("", ", truth", ", another"))
            figure = ratio_interval(mine, truth, exam.rng())
            beside = {"another clip's picture": ratio_interval(other, truth, exam.rng())}
            where = "overlap", "", "disagreement of overlapping views", "\u00d7", place, arm, PREDICTED
            whole.rows.append(Row(*where, step, figure, -1, beside))
    return whole


def _missing(exam: Exam, world: World) -> str:
    return (
        ""
        if _of(exam, world)
        else "needs cameras whose fields of view overlap, in the world's spec and in the recording"
    )


OVERLAP = Probe("overlap", "Do its cameras agree?", LEAD, _missing, _report, _watch)
