"""Work in units whose results are stored as they are done, so that it can resume, with a forecast of the time left."""

import hashlib
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from ..core.errors import TerrellaError
from ..core.files import replacing
from ..core.state import State
from ..core.world import World, make_rng
from .clips import Clip, evidence
from .rollouts import Results, Tick, actions_at, fold_context, poses_at

Clock = Callable[[], float]
Progress = Callable[[float, str, float], None]  # share done in 0..1, current work, seconds left
Calls = Mapping[tuple[str, str], float]  # (arm, verb) -> calls, counted per clip


@dataclass(frozen=True)
class Unit:
    """A piece of work, independent of the work before it."""

    key: str  # "kind|number", names its result; units of one kind cost alike
    words: str  # for progress lines
    calls: Calls  # its cost
    run: Callable[[Tick], Results]

    @property
    def kind(self) -> str:
        return self.key.rpartition("|")[0]

    @property
    def arm(self) -> str:
        return next(iter(self.calls))[0]


class Forecast:
    """Forecast seconds of units: their calls at measured prices, corrected by the time that units of their kind took."""

    def __init__(self, prices: Calls):
        self.prices = prices
        self.took: dict[str, tuple[float, float]] = {}  # kind or arm -> seconds, priced seconds; decayed

    def priced(self, unit: Unit) -> float:
        return sum(count * self.prices.get(call, 1e-3) for call, count in unit.calls.items()) + 1e-3

    def done(self, unit: Unit, seconds: float) -> None:
        for name, kept in ((unit.kind, 0.7), (unit.arm, 0.9)):
            took, priced = self.took.get(name, (0.0, 0.0))
            self.took[name] = kept * took + seconds, kept * priced + self.priced(unit)

    def seconds(self, unit: Unit) -> float:
        took, priced = self.took.get(unit.kind) or self.took.get(unit.arm) or (1.0, 1.0)
        return self.priced(unit) * took / priced


class Store:
    """Results of units in a folder, or nowhere. Results of another `fingerprint` are deleted."""

    def __init__(self, folder: Path | None, fingerprint: str):
        self.folder = folder and folder / _digest(fingerprint)
        if folder is None or self.folder is None:
            return
        with writing(folder):
            for other in folder.glob("*"):
                if other != self.folder:
                    shutil.rmtree(other, ignore_errors=True)
            self.folder.mkdir(parents=True, exist_ok=True)

    def get(self, key: str) -> Results | None:
        """A stored result; None if it is missing or damaged."""
        try:
            return load_file(self.folder / f"{_digest(key)}.safetensors") if self.folder else None
        except (OSError, SafetensorError):
            return None

    def put(self, key: str, result: Results) -> None:
        if self.folder is None:
            return
        file = self.folder / f"{_digest(key)}.safetensors"
        with writing(self.folder), replacing(file, durable=False) as staged:
            save_file({name: tensor.contiguous().clone() for name, tensor in result.items()}, staged)


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:24]


@contextmanager
def writing(folder: Path) -> Iterator[None]:
    """TerrellaError for errors of writing."""
    try:
        yield
    except (OSError, SafetensorError) as error:
        raise TerrellaError(f"cannot write to {folder} ({error}); choose another folder.") from error


def run_all(units: Sequence[Unit], store: Store, prices: Calls, clock: Clock, progress: Progress) -> dict[str, Results]:
    """The results of all units by kind, with batches joined; stored results are reused."""
    forecast = Forecast(prices)
    results = {unit.key: kept for unit in units if (kept := store.get(unit.key)) is not None}
    whole = sum(map(forecast.priced, units)) or 1.0
    behind = sum(forecast.priced(unit) for unit in units if unit.key in results)
    todo = [unit for unit in units if unit.key not in results]
    for number, unit in enumerate(todo):
        began, later = clock(), sum(map(forecast.seconds, todo[number + 1 :]))

        def report(share: float, unit=unit, began=began, later=later, behind=behind) -> None:
            pace = (
                (1 - share) * forecast.seconds(unit) + clock() - began
            )  # trusts the forecast less and its own pace more
            progress((behind + share * forecast.priced(unit)) / whole, unit.words, (1 - share) * pace + later)

        result = unit.run(_ticks(sum(unit.calls.values()), report))
        results[unit.key] = {name: tensor.cpu() for name, tensor in result.items()}
        store.put(unit.key, results[unit.key])
        forecast.done(unit, clock() - began)
        behind += forecast.priced(unit)
    progress(1.0, "measured", 0.0)
    parts: dict[str, list[Results]] = {}
    for unit in units:
        parts.setdefault(unit.kind, []).append(results[unit.key])
    return {kind: {name: torch.cat([one[name] for one in some]) for name in some[0]} for kind, some in parts.items()}


def _ticks(whole: float, report: Callable[[float], None]) -> Tick:
    """Counts the work done of a unit and reports the share."""
    done = 0.0

    def tick(count: float) -> None:
        nonlocal done
        done += count
        report(min(done / (whole or 1.0), 1.0))

    tick(0.0)
    return tick


UNSEEN = ", unseen"  # steps of which few are rendered


def prices_of(arm: str, world: World, clips: Sequence[Clip], clock: Clock) -> dict[tuple[str, str], float]:
    """Seconds per clip of each verb, from a few steps of each: "observe" after imagining, "imagine" and render, follow a "pose" and
    render, either UNSEEN (only the last is rendered), and imagine a single clip "alone"."""
    rng, state = make_rng(0), fold_context(world, clips, make_rng(0))
    shown = tuple(name for name in ("rgb", "pose") if name in world.spec.channels) or tuple(world.spec.channels)[:1]

    def imagine(state: State, row: int) -> State:
        return world.imagine(state, actions_at(world, clips[: state.batch], row), rng)

    def observe(state: State, row: int) -> State:
        return world.observe(evidence(clips, world.spec, row), imagine(state, row), rng)

    def follow(state: State, row: int) -> State:
        return world.observe({"pose": poses_at(clips, row)}, state, rng)

    def seconds(state: State, step: Callable[[State, int], State], look: bool, count: int = 4) -> tuple[State, float]:
        began = clock()
        for row in range(count + 1):
            if row == 1:
                began = clock()  # the first step may compile
            state = step(state, row)
            if look or row in (0, count):
                world.render(state, shown)
        return state, (clock() - began) / (count * state.batch)

    prices: dict[tuple[str, str], float] = {}
    if world.spec.observes:
        state, prices[arm, "observe"] = seconds(state, observe, False)
    if "pose" in world.spec.observes:
        try:
            state, prices[arm, "pose"] = seconds(state, follow, True)
            state, prices[arm, "pose" + UNSEEN] = seconds(state, follow, False)
        except TerrellaError:
            pass  # it does not take poses alone
    state, prices[arm, "imagine"] = seconds(state, imagine, True)
    state, prices[arm, "imagine" + UNSEEN] = seconds(state, imagine, False)
    state, prices[arm, "alone"] = seconds(state.at(0) if state.batch > 1 else state, imagine, True)
    return prices
