"""The report of a merge: rows and gaps of every source, what was left out, each robot's statistics."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field

import numpy as np

from ...data import stats

_SAMPLE = 1 << 18  # quantiles use all values up to this many, then every 2nd, 4th, …


class Running:
    """Incremental statistics of named numbers, each over its own valid rows."""

    def __init__(self, names: Sequence[str]):
        self._names = tuple(names)
        self._summaries: dict[str, stats.Summary] = {}
        self._samples = {name: np.zeros(0, np.float32) for name in names}
        self._strides = dict.fromkeys(names, 1)

    def add(self, values: np.ndarray, mask: np.ndarray) -> None:
        """values float [T, D], mask bool [T, D]."""
        for place, name in enumerate(self._names):
            new = values[mask[:, place], place]
            if len(new):
                self._sample(name, new)
                self._summaries = stats.merge([self._summaries, {name: stats.summarise(new)}])

    def _sample(self, name: str, values: np.ndarray) -> None:
        """Keeps every value of this number whose index, over all takes, is a multiple of the stride."""
        before = int(self._summaries[name]["count"][0]) if name in self._summaries else 0
        new = values[-before % self._strides[name] :: self._strides[name]].astype(np.float32)
        self._samples[name] = np.concatenate([self._samples[name], new])
        while len(self._samples[name]) > _SAMPLE:
            self._samples[name], self._strides[name] = self._samples[name][::2], self._strides[name] * 2

    def to_json(self) -> dict[str, dict]:
        """name -> min, max, mean, std, q01, q99, count, for each number with a valid row."""
        statistics: dict[str, dict] = {}
        for name, summary in self._summaries.items():
            low, high = np.quantile(self._samples[name].astype(np.float64), (0.01, 0.99))
            numbers = {key: float(value[0]) for key, value in summary.items() if key != "count"}
            statistics[name] = {**numbers, "q01": float(low), "q99": float(high), "count": int(summary["count"][0])}
        return statistics


@dataclass
class SensorCount:
    """How one sensor's readings were used."""

    readings: int = 0
    rows: int = 0
    rows_without: int = 0  # before the first reading, in gaps, after the last
    longest_gap_s: float = 0.0
    not_finite: int = 0  # numbers that were NaN or infinite, now masked


@dataclass
class SourceCount:
    """How one source was used."""

    path: str
    embodiment: str
    takes: int = 0
    rows: int = 0
    late_s: float = 0.0  # skipped at the start of takes, until every sensor had a reading
    skipped: list[str] = field(default_factory=list)
    sensors: dict[str, SensorCount] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


class MergeReport:
    """Filled while the takes of a merged source are read, anew at each iteration. complete: whether the last one reached the end;
    sources: path -> SourceCount."""

    def __init__(self) -> None:
        self.complete = False
        self.sources: dict[str, SourceCount] = {}
        self._robots: dict[str, dict] = {}
        self._statistics: dict[tuple[str, str], Running] = {}

    def begin(self, sources: Sequence[SourceCount], robots: Mapping[str, dict], numbers: Mapping[str, Sequence[str]]):
        """robots: embodiment -> its facts; numbers: "action" and "observation.state" -> the names of their numbers."""
        self.complete = False
        self.sources = {source.path: source for source in sources}
        self._robots = dict(robots)
        self._statistics = {(robot, key): Running(names) for robot in robots for key, names in numbers.items()}

    def add(self, robot: str, key: str, values: np.ndarray, mask: np.ndarray) -> None:
        """Counts the rows of one take into the statistics of that robot's "action" or "observation.state"."""
        self._statistics[robot, key].add(values, mask)

    def embodiments(self) -> list[dict]:
        """For meta/terrella.json: each robot's number, name, sources, cameras, takes, rows, and statistics of action and state:
        name -> min, max, mean, std, q01, q99, count over its valid rows, for the numbers that it has."""
        robots = []
        for number, (name, facts) in enumerate(self._robots.items()):
            own = [source for source in self.sources.values() if source.embodiment == name]
            statistics = {key: it.to_json() for (robot, key), it in self._statistics.items() if robot == name}
            counts = {"takes": sum(source.takes for source in own), "rows": sum(source.rows for source in own)}
            robots.append({"id": number, "name": name, **facts, **counts, "stats": statistics})
        return robots

    def to_json(self) -> dict:
        return {
            "complete": self.complete,
            "sources": [asdict(source) for source in self.sources.values()],
            "embodiments": self.embodiments(),
        }

    def text(self) -> str:
        """The report as text: what was read of each source and what was left out."""
        lines = [] if self.complete else ["The merge is incomplete: these are its sources up to where it stopped."]
        for source in self.sources.values():
            lines.append(f"{source.embodiment}: {source.takes} takes, {source.rows} rows from {source.path}")
            if source.late_s > 0:
                lines.append(f"  {source.late_s:.2f} s skipped at the start of takes, until every sensor had a reading")
            lines += [f"  skipped {why}" for why in source.skipped]
            for name, it in source.sensors.items():
                line = f"  {name}: {it.rows} rows from {it.readings} readings, longest gap {it.longest_gap_s:.3g} s"
                line += f"; {it.rows_without} rows without it" if it.rows_without else ""
                line += f"; {it.not_finite} numbers that are not finite" if it.not_finite else ""
                lines.append(line)
            lines += [f"  left out {name}: {why}" for name, why in source.left_out.items()]
            lines += [f"  look at: {note}" for note in source.notes]
        return "\n".join(lines) + "\n"
