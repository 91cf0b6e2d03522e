"""The scorecard as data: figures with 95% intervals and baselines, curves, pictures, and what was not asked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from .statistics import Band, Figure

PREDICTED, TRUE = "predicted", "true"  # motion: the world is given actions alone; or at each step the true pose
OTHERS, IDLE = "other actions", "no action"  # actions of another clip; the action at rest, held
COPY_LAST = "copy last"
POOLED = "pooled PSNR"  # that of all errors of all clips together
CHANGE = "change per step"  # how many pixels change from step to step, predicted over recorded
GAIN = ": gain over copy-last"  # of a measure: the curve by which it is compared at every step


@dataclass(frozen=True)
class Row:
    """One figure of one probe.

    channel: of which channel ("rgb.wrist"), "" for none; what: its name, unit: that of the figure; better: +1 where more
    is better, -1 where less is, 0 where 1 or nothing in particular is best; horizon: after how many steps, 0 for none;
    baselines: the same figure of those who know nothing; gain: over copying the last frame, clip by clip, positive is
    better; void: it was measured and proves nothing, `note` says why.
    """

    probe: str
    channel: str
    what: str
    unit: str
    place: str
    arm: str
    motion: str
    horizon: int
    figure: Figure
    better: int = 0
    baselines: Mapping[str, Figure] = field(default_factory=dict)
    gain: Figure | None = None
    void: bool = False
    note: str = ""


@dataclass(frozen=True)
class Curve:
    """A figure along x (steps from 1, or shares); arm COPY_LAST for the last frame copied. mark: an x worth a dot."""

    probe: str
    channel: str
    what: str
    unit: str
    place: str
    arm: str
    motion: str
    x: Sequence[float]
    band: Band
    mark: float | None = None
    guides: tuple[float, ...] = ()


@dataclass(frozen=True)
class Picture:
    """Rows of frames uint8 [K, H, W, 3] to look at: label -> frames, one column label for each frame."""

    probe: str
    title: str
    columns: list[str]
    rows: dict[str, np.ndarray]


@dataclass(frozen=True)
class Missing:
    """A probe that was not applicable to an arm, and what it needs: "needs pose"."""

    probe: str
    arm: str
    why: str


@dataclass(frozen=True)
class PlaceSummary:
    """What was shown: how many clips, the share of them in which anything moves, their lengths in steps."""

    name: str
    clips: int
    moving_share: float
    context: int
    horizon: int


@dataclass
class ProbeReport:
    """What one probe found."""

    rows: list[Row] = field(default_factory=list)
    curves: list[Curve] = field(default_factory=list)
    pictures: list[Picture] = field(default_factory=list)


@dataclass(frozen=True)
class Scorecard:
    """Everything measured, as data; `pictures` are for the page and stay out of the JSON. worlds: arm -> its world."""

    worlds: dict[str, str]
    dt_s: float
    places: list[PlaceSummary]
    rows: list[Row] = field(default_factory=list)
    curves: list[Curve] = field(default_factory=list)
    missing: list[Missing] = field(default_factory=list)
    pictures: list[Picture] = field(default_factory=list)

    def find(self, probe: str, what: str, **wanted) -> list[Row]:
        """The rows of a probe by name, and by whichever other fields are given."""
        return [
            row
            for row in self.rows
            if (row.probe, row.what) == (probe, what) and all(getattr(row, key) == wanted[key] for key in wanted)
        ]


def place_label(place: str) -> str:
    """As people are told of it: "recorded clips", "new places"."""
    return f"{place} {'places' if place == 'new' else 'clips'}"
