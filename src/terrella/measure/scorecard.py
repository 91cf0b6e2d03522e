"""The scorecard as data: figures with 95% intervals and baselines, curves, pictures, and probes that do not apply."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from .statistics import Band, Figure

PREDICTED, TRUE = "predicted", "true"  # motion: the world is given actions alone, or the true pose at each step
OTHERS, IDLE = "other actions", "no action"  # those of another clip; the neutral action, held
COPY_LAST = "copy last"
POOLED = "pooled PSNR"  # of the errors of all clips together
EARLY = "ends too early"  # share of the clips, none of which ends, that the world ends
CHANGE = "change per step"  # how many pixels change from step to step, predicted over recorded
GAIN = ": gain over copy-last"  # suffix of a measure: the curve of the comparison at every step


@dataclass(frozen=True)
class Row:
    """One figure of one probe."""

    probe: str
    channel: str  # "rgb.wrist"; "" for none
    what: str  # the measure
    unit: str
    place: str  # the set of clips
    arm: str  # the world
    motion: str  # PREDICTED or TRUE
    horizon: int  # steps; 0 for none
    figure: Figure
    better: int = 0  # +1: higher is better, -1: lower is better, 0: neither (1 is best, if anything)
    baselines: Mapping[str, Figure] = field(default_factory=dict)  # the same figure of baselines
    gain: Figure | None = None  # over copying the last frame, clip by clip; positive is better
    void: bool = False  # measured, but proves nothing; `note` says why
    note: str = ""


@dataclass(frozen=True)
class Curve:
    """A figure along x."""

    probe: str
    channel: str
    what: str
    unit: str
    place: str
    arm: str
    motion: str
    x: Sequence[float]  # steps from 1, or shares
    band: Band
    mark: float | None = None  # an x to mark with a dot
    guides: tuple[float, ...] = ()  # y of dotted lines


@dataclass(frozen=True)
class Picture:
    """Rows of frames to look at: label -> uint8 [K, H, W, 3], with a column label for each frame."""

    probe: str
    title: str
    columns: list[str]
    rows: dict[str, np.ndarray]


@dataclass(frozen=True)
class DreamFilm:
    """The same moments as they were recorded and as they were predicted, at the pace of the world."""

    title: str
    truth: np.ndarray  # uint8 [T, H, W, 3]
    dream: np.ndarray  # uint8 [T, H, W, 3]
    dt_s: float


@dataclass(frozen=True)
class Missing:
    """A probe that does not apply to an arm, and what it needs: "needs pose"."""

    probe: str
    arm: str
    why: str


@dataclass(frozen=True)
class PlaceSummary:
    """A set of clips."""

    name: str
    clips: int
    moving_share: float  # of the clips
    context: int  # steps
    horizon: int  # steps


@dataclass
class ProbeReport:
    """The results of one probe."""

    rows: list[Row] = field(default_factory=list)
    curves: list[Curve] = field(default_factory=list)
    pictures: list[Picture] = field(default_factory=list)
    films: list[DreamFilm] = field(default_factory=list)


@dataclass(frozen=True)
class Scorecard:
    """All results, as data; `pictures` and `films` are for the page and not in the JSON."""

    worlds: dict[str, str]  # arm -> name of its world
    dt_s: float
    places: list[PlaceSummary]
    rows: list[Row] = field(default_factory=list)
    curves: list[Curve] = field(default_factory=list)
    missing: list[Missing] = field(default_factory=list)
    pictures: list[Picture] = field(default_factory=list)
    films: list[DreamFilm] = field(default_factory=list)

    def find(self, probe: str, what: str, **wanted) -> list[Row]:
        """The rows of a probe by measure, and by any other fields."""
        rows = [row for row in self.rows if (row.probe, row.what) == (probe, what)]
        return [row for row in rows if all(getattr(row, key) == wanted[key] for key in wanted)]


def place_label(place: str) -> str:
    """The label of a set of clips: "recorded clips", "new places"."""
    return f"{place} {'places' if place == 'new' else 'clips'}"
