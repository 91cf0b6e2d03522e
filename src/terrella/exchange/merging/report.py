"""Report: what a merge did with every source: rows and gaps, what was left out, each robot's statistics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field

import numpy as np

_SAMPLE = 1 << 18  # quantiles are exact up to this many values of a number, then from every 2nd, 4th, …


class Running:
    """Statistics of named numbers, each over its own valid rows, gathered bit by bit."""

    def __init__(self, names: Sequence[str]):
        self.names = tuple(names)
        size = len(self.names)
        self._count = np.zeros(size, np.int64)
        self._mean, self._squares = np.zeros(size), np.zeros(size)
        self._min, self._max = np.full(size, np.inf), np.full(size, -np.inf)
        self._samples: list[list[np.ndarray]] = [[] for _ in self.names]
        self._kept, self._stride = np.zeros(size, np.int64), np.ones(size, np.int64)

    def add(self, values: np.ndarray, mask: np.ndarray) -> None:
        """values float [T, D], mask bool [T, D]."""
        rows = values.astype(np.float64)
        count = mask.sum(0)
        mean = np.where(mask, rows, 0).sum(0) / np.maximum(count, 1)
        squares = (np.where(mask, rows - mean, 0) ** 2).sum(0)
        total = np.maximum(self._count + count, 1)
        self._squares += squares + (mean - self._mean) ** 2 * self._count * count / total
        self._mean += (mean - self._mean) * count / total
        self._min = np.minimum(self._min, np.where(mask, rows, np.inf).min(0, initial=np.inf))
        self._max = np.maximum(self._max, np.where(mask, rows, -np.inf).max(0, initial=-np.inf))
        for number in np.flatnonzero(count).tolist():
            self._sample(number, values[mask[:, number], number])
        self._count += count

    def _sample(self, number: int, values: np.ndarray) -> None:
        """Keeps value j of all that this number ever had where j is a multiple of the stride."""
        stride, samples = self._stride[number], self._samples[number]
        new = values[-self._count[number] % stride :: stride].astype(np.float32)
        samples.append(new)
        self._kept[number] += len(new)
        while self._kept[number] > _SAMPLE:
            samples[:] = [np.concatenate(samples)[::2]]
            self._kept[number], self._stride[number] = len(samples[0]), self._stride[number] * 2

    def to_json(self) -> dict[str, dict]:
        """name -> min, max, mean, std, q01, q99, count; of a number without a valid row its count 0 alone."""
        found: dict[str, dict] = {}
        for number, name in enumerate(self.names):
            count = int(self._count[number])
            found[name] = {"count": count}
            if count:
                low, high = np.quantile(np.concatenate(self._samples[number]).astype(np.float64), (0.01, 0.99))
                found[name] = {
                    "min": float(self._min[number]),
                    "max": float(self._max[number]),
                    "mean": float(self._mean[number]),
                    "std": float(np.sqrt(self._squares[number] / count)),
                    "q01": float(low),
                    "q99": float(high),
                    "count": count,
                }
        return found


@dataclass
class SensorCount:
    """What became of one sensor's readings."""

    readings: int = 0
    rows: int = 0
    rows_without: int = 0  # before its first reading, in a gap, after its end
    longest_gap_s: float = 0.0
    not_finite: int = 0  # numbers that were NaN or infinite, and so are masked


@dataclass
class SourceCount:
    """What became of one source."""

    path: str
    embodiment: str
    takes: int = 0
    rows: int = 0
    late_s: float = 0.0  # time before the first rows, while a sensor had not begun
    skipped: list[str] = field(default_factory=list)
    sensors: dict[str, SensorCount] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


class Report:
    """Filled while the takes of a merged source are read, begun anew when they are read anew.

    complete: whether the last reading reached the end.
    sources:  a SourceCount for each.
    """

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
        """For meta/terrella.json: each robot's number, name, sources, cameras, takes, rows, and the statistics of its
        action and state: name -> min, max, mean, std, q01, q99, count over its own valid rows (what it never has is not
        there).
        """
        found = []
        for number, (name, facts) in enumerate(self._robots.items()):
            mine = [source for source in self.sources.values() if source.embodiment == name]
            statistics = {
                key: {number: it for number, it in running.to_json().items() if it["count"]}
                for (robot, key), running in self._statistics.items()
                if robot == name
            }
            counts = {"takes": sum(source.takes for source in mine), "rows": sum(source.rows for source in mine)}
            found.append({"id": number, "name": name, **facts, **counts, "stats": statistics})
        return found

    def to_json(self) -> dict:
        return {
            "complete": self.complete,
            "sources": [asdict(source) for source in self.sources.values()],
            "embodiments": self.embodiments(),
        }

    def text(self) -> str:
        """For a person: what was made of each source and what could not be mapped."""
        lines = [] if self.complete else ["The merge is not complete: these are its sources up to where it stopped."]
        for source in self.sources.values():
            lines.append(f"{source.embodiment}: {source.takes} takes, {source.rows} rows from {source.path}")
            if source.late_s > 0:
                lines.append(
                    f"  {source.late_s:.2f} s skipped at the beginning of takes, before every sensor had begun"
                )
            lines += [f"  skipped {why}" for why in source.skipped]
            for name, it in source.sensors.items():
                line = f"  {name}: {it.rows} rows from {it.readings} readings, longest gap {it.longest_gap_s:.3g} s"
                line += f"; {it.rows_without} rows without it" if it.rows_without else ""
                line += f"; {it.not_finite} numbers not finite" if it.not_finite else ""
                lines.append(line)
            lines += [f"  left out {name}: {why}" for name, why in source.left_out.items()]
            lines += [f"  look at: {note}" for note in source.notes]
        return "\n".join(lines) + "\n"
