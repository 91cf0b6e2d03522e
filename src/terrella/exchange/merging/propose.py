"""Proposes the mapping of a merge, as far as names, units and frames allow; a person completes it."""

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...core.errors import DatasetError
from ...data.resample import quaternions
from ...data.source import Sensor, Source
from ..formats.rows import unique
from .mapping import (
    ACTION,
    FOLLOWS,
    MERGED,
    NAME,
    STATE,
    Dimension,
    MergedCamera,
    MergeMapping,
    MergeRows,
    Number,
    SourceMapping,
    Vector,
    mask_of,
)
from .units import basic, quantity

_MAX_SPLIT = 64  # an unnamed vector with more numbers (an embedding, a tactile skin) is kept whole
_ENDINGS = {unit: unit for unit in ("m", "cm", "mm", "rad", "deg")}
_ENDINGS |= {"mps": "m/s", "radps": "rad/s", "degps": "deg/s"}
_POSITION = re.compile(r"(?:p|pos|position|translation)_?([xyz])")
_ROTATION = re.compile(r"(?:q|quat|quaternion|orientation|rotation)_?([wxyz])")


_Notes = dict[str, dict[str, list[str]]]  # source -> note for a person -> the numbers or sensors concerned


@dataclass(frozen=True)
class _Place:
    """One number of one sensor of one source. `stem` is the name that others may share; None if it has no name."""

    source: str
    embodiment: str
    sensor: str
    index: int
    stem: str | None
    name: str
    unit: str
    frame: str

    @property
    def own(self) -> str:
        """The name of a dimension of this number alone."""
        return f"{self.embodiment}.{self.stem or f'{_short(self.sensor)}_{self.index}'}"


def propose(sources: Mapping[str, Source], fps: float | None = None) -> MergeMapping:
    """A first mapping of the sources (path -> Source), to be checked and edited by a person.

    Numbers of the same name fill one dimension. Names are compared without case and punctuation; a unit at the end (x_mm) is
    read as the unit; position_x and quat_w are x and qw; names in sensors other than "action" and "observation.state" get the
    sensor's name as prefix ("imu.ax"). Units are converted if both are stated, to the common unit or the quantity's basic one.
    Different stated frames or quantities give different dimensions. A number without a name gets its own dimension, such as
    "aloha.state_3", shared by sources of one embodiment; a channel of such numbers that recordings of Terrella's worlds all have
    alike ("observation.hand") is kept whole. Cameras of the same name become one, at their smallest size. Every guess that should
    be checked is in its source's `notes`.

    fps: of the merged rows; None for the slowest source's.
    DatasetError without a source, or where no fps is known.
    """
    if not sources:
        raise DatasetError("no recordings are given; name at least one.")
    names = _embodiments(sources)
    rates = {path: _rate(source) for path, source in sources.items()}
    known = [rate for rate in rates.values() if rate]
    if fps is None and not known:
        raise DatasetError("none of the recordings states its fps; give the fps of the merged one.")
    notes: _Notes = {path: {} for path in sources}
    alike = _alike(list(sources.values()))
    places = [place for path in sources for place in _places(path, sources[path], names[path], alike)]
    filled: dict[_Place, str] = {}
    action = _share([place for place in places if place.sensor == ACTION], filled, notes)
    state = _share([place for place in places if place.sensor != ACTION], filled, notes)
    cameras = _cameras(sources, notes)
    several = len(set(names.values())) > 1
    mapped = []
    for path, source in sources.items():
        vectors: dict[str, list[Number]] = {}
        for place in places:
            if place.source == path:
                vectors.setdefault(place.sensor, []).append(Number(place.name, filled[place], place.unit))
        views = {name: name for name, it in source.sensors.items() if name in cameras and it.kind == cameras[name].kind}
        keep, out = _rest(source, names[path] if several else "", cameras, {*vectors, *views}, alike)
        mapped.append(
            SourceMapping(
                path=path,
                embodiment=names[path],
                fps=rates[path],
                vectors={name: Vector(tuple(n), source.sensors[name].frame) for name, n in vectors.items()},
                cameras=views,
                keep=keep,
                out=out,
                notes=tuple(f"{', '.join(subjects)}: {what}" for what, subjects in notes[path].items()),
            )
        )
    chosen = float(fps if fps is not None else min(known))
    gap = max([1.0, 3 / chosen, *(3 / rate for rate in [*known, *_clocks(sources)])])
    return MergeMapping(MergeRows(chosen, max_gap_s=round(gap, 3)), action, state, cameras, tuple(mapped))


def _embodiments(sources: Mapping[str, Source]) -> dict[str, str]:
    """path -> robot name; robots with one name but different vectors are numbered."""
    names: dict[str, str] = {}
    forms: dict[str, object] = {}
    for path, source in sources.items():
        base = source.robot or source.name or "robot"
        form = {
            name: (sensor.shape, sensor.dtype, sensor.names, dict(sensor.units), sensor.frame)
            for name, sensor in source.sensors.items()
            if sensor.kind in ("vector", "points") and not name.startswith(FOLLOWS)
        }
        number = 1
        while forms.setdefault(name := base if number == 1 else f"{base}_{number}", form) != form:
            number += 1
        names[path] = name
    return names


def _rate(source: Source) -> float | None:
    """Rows per second: the source's fps, else the rate of its slowest camera or else of its action, stated or measured."""
    if source.fps:
        return float(source.fps)
    pictures = [name for name, sensor in source.sensors.items() if sensor.kind == "image"]
    chosen = pictures or [name for name in source.sensors if name == ACTION] or list(source.sensors)
    stated = [rate for name in chosen if (rate := source.sensors[name].rate_hz)]
    if stated:
        return float(min(stated))
    take = next(iter(source.takes()), None)
    clocks = [np.asarray(take.readings[name].time_s) for name in chosen if name in take.readings] if take else []
    steps = [float(np.median(np.diff(clock))) for clock in clocks if len(clock) > 1]
    return round(1 / max(steps), 3) if steps and 0 < max(steps) < np.inf else None


def _clocks(sources: Mapping[str, Source]) -> list[float]:
    return [sensor.rate_hz for source in sources.values() for sensor in source.sensors.values() if sensor.rate_hz]


def _short(sensor: str) -> str:
    return sensor.removeprefix("observation.")


def _alike(sources: Sequence[Source]) -> set[str]:
    """Channels of numbers without names that recordings of worlds all have alike: the channel's name says what they are."""
    if not all("world" in source.facts for source in sources):
        return set()
    forms = [
        {
            (name, sensor.shape, sensor.dtype, tuple(sensor.units.items()))
            for name, sensor in source.sensors.items()
            if sensor.kind == "vector" and name not in (ACTION, STATE) and _is_mapped(name, source)
            if all(_stem(name, sensor, label)[0] is None for label in sensor.names or ("",))
        }
        for source in sources
    ]
    return {form[0] for form in set.intersection(*forms)}


def _places(path: str, source: Source, embodiment: str, whole: Collection[str]) -> list[_Place]:
    places: list[_Place] = []
    for name, sensor in source.sensors.items():
        numbers = sensor.kind == "vector" and len(sensor.shape) == 1 and sensor.dtype != "string"
        if not numbers or not _is_mapped(name, source) or name in whole:
            continue
        if name not in (ACTION, STATE) and not sensor.names and sensor.shape[0] > _MAX_SPLIT:
            continue
        for index in range(sensor.shape[0]):
            label = sensor.names[index] if sensor.names else ""
            stem, unit = _stem(name, sensor, label)
            places.append(_Place(path, embodiment, name, index, stem, label, unit, sensor.frame))
    shared: set[tuple[bool, str]] = set()
    for at, place in enumerate(places):  # a name that occurs twice in one source is shared once
        for stem in (place.stem, f"{_short(place.sensor)}.{place.name}", None):
            if stem is None or (place.sensor == ACTION, stem) not in shared:
                break
        places[at] = replace(place, stem=stem if place.stem else None)
        shared.add((place.sensor == ACTION, stem or ""))
    return places


def _is_mapped(name: str, source: Source) -> bool:
    return name == ACTION or (name.startswith("observation.") and not _is_mask(name, source))


def _is_mask(name: str, source: Source) -> bool:
    whole = name.removesuffix("_mask")
    return name not in (ACTION, STATE) and (name in MERGED or (whole != name and whole in source.sensors))


def _stem(sensor_name: str, sensor: Sensor, label: str) -> tuple[str | None, str]:
    """(the number's name, None if it has none of its own; its unit)."""
    unit = sensor.units.get(label, "")
    short = _short(sensor_name).lower()
    stem = re.sub(r"[\W_]+", "_", label.lower()).strip("_")
    counted = {"", "action", "state", "observation", "obs", "dim", "value", "feature", re.sub(r"[\W_]+", "_", short)}
    if re.sub(r"_?\d+$", "", stem) in counted and (not stem or stem[-1].isdigit()):
        return None, unit
    head, _, tail = stem.rpartition("_")
    if head and tail in _ENDINGS and quantity(unit or _ENDINGS[tail]) == quantity(_ENDINGS[tail]):
        stem, unit = head, unit or _ENDINGS[tail]
    position, rotation = _POSITION.fullmatch(stem), _ROTATION.fullmatch(stem)
    if position:
        stem = position[1]
    if rotation and quaternions(tuple(re.sub(r"orientation|rotation", "quat", name.lower()) for name in sensor.names)):
        stem = f"q{rotation[1]}"
    return (stem if short in ("action", "state", "pose") else f"{short}.{stem}"), unit


def _share(places: list[_Place], filled: dict[_Place, str], notes: _Notes) -> dict[str, Dimension]:
    """The dimensions of these numbers, in order of appearance; `filled` gets the dimension of each number."""
    groups: dict[str, list[_Place]] = {}
    for place in places:
        groups.setdefault(place.own if place.stem is None else place.stem, []).append(place)
    dimensions: dict[str, Dimension] = {}
    for members in groups.values():
        if members[0].stem is None:
            dimension = Dimension(_common_unit(members), members[0].frame)
            _fill(members, members[0].own, dimension, dimensions, filled)
            for place in members:
                note = f"no name in {place.sensor}, so used for this robot only."
                notes[place.source].setdefault(note, []).append(filled[place])
            continue
        frames = {place.frame for place in members} - {""}
        kinds = {quantity(place.unit) or place.unit for place in members} - {""}
        parted: dict[str, list[_Place]] = {}
        for place in members:
            known = (place.frame or len(frames) < 2) and (place.unit or len(kinds) < 2)
            name = _title(members)
            if not known:
                name = place.own
                note = f"no frame or unit in {place.sensor}, but others of that name differ in it: used for this robot only."
                notes[place.source].setdefault(note, []).append(name)
            else:
                name += f" ({basic(place.unit)})" if len(kinds) > 1 else ""
                name += f" @ {place.frame}" if len(frames) > 1 else ""
            parted.setdefault(name, []).append(place)
        if len(parted) > 1:
            for place in members:
                note = f"in {place.sensor}, differs in frame or quantity from others of that name: see {', '.join(parted)}."
                notes[place.source].setdefault(note, []).append(place.name)
        for name, part in parted.items():
            dimension = Dimension(_common_unit(part), next((place.frame for place in part if place.frame), ""))
            _fill(part, name, dimension, dimensions, filled)
            _note_unstated(part, dimension, filled, notes)
    return dimensions


def _fill(part: list[_Place], name: str, dimension: Dimension, dimensions: dict, filled: dict[_Place, str]) -> None:
    free = unique(name, dimensions)
    dimensions[free] = dimension
    filled.update(dict.fromkeys(part, free))


def _note_unstated(part: list[_Place], dimension: Dimension, filled: Mapping[_Place, str], notes: _Notes) -> None:
    if len({place.source for place in part}) < 2:
        return
    for place in part:
        for what, here, shared in (("unit", place.unit, dimension.unit), ("frame", place.frame, dimension.frame)):
            if shared and not here:
                note = f"no {what} is stated in {place.sensor}; '{shared}' is assumed, as in another recording."
                notes[place.source].setdefault(note, []).append(filled[place])


def _title(members: list[_Place]) -> str:
    """The name if all spell it alike, else without case, punctuation and unit."""
    stem, prefix = members[0].stem or "", f"{_short(members[0].sensor)}."
    labels = {place.name for place in members}
    if len(labels) > 1:
        return stem
    return (prefix if stem.lower().startswith(prefix.lower()) else "") + labels.pop()


def _common_unit(part: list[_Place]) -> str:
    units = {place.unit for place in part} - {""}
    return units.pop() if len(units) == 1 else (basic(min(units)) if units else "")


def _cameras(sources: Mapping[str, Source], notes: _Notes) -> dict[str, MergedCamera]:
    """Every image and depth sensor by name, at its smallest size; images take precedence over depth."""
    cameras: dict[str, MergedCamera] = {}
    for path, source in sources.items():
        for name, sensor in source.sensors.items():
            if sensor.kind not in ("image", "depth") or not name.startswith("observation.") or name in MERGED:
                continue
            if not NAME.fullmatch(name):
                continue
            camera, before = MergedCamera(sensor.kind, *map(int, sensor.shape[:2])), cameras.get(name)
            if before and before.kind != camera.kind:
                note = f"of kind {camera.kind} here and {before.kind} elsewhere."
                notes[path].setdefault(note, []).append(name)
                camera = min(before, camera, key=lambda it: it.kind != "image")
            elif before:
                camera = min(before, camera, key=lambda it: (it.height * it.width, it.height))
            cameras[name] = camera
    for path, source in sources.items():
        for name, camera in cameras.items():
            sensor = source.sensors.get(name)
            if sensor and sensor.kind == camera.kind and tuple(sensor.shape[:2]) != (camera.height, camera.width):
                note = f"scaled from {sensor.shape[0]} x {sensor.shape[1]} to {camera.height} x {camera.width}."
                notes[path].setdefault(note, []).append(name)
    return cameras


def _rest(
    source: Source, embodiment: str, cameras: Mapping[str, MergedCamera], mapped: set[str], alike: Collection[str]
) -> tuple[dict[str, str], dict[str, str]]:
    """(kept whole: sensor -> its merged name; left out: sensor -> why), for every sensor that is not in `mapped`."""
    keep: dict[str, str] = {}
    out: dict[str, str] = {}
    taken = {*MERGED, *cameras}
    for name, sensor in source.sensors.items():
        if name in mapped:
            continue
        head, _, tail = _short(name).partition(".")
        embodiment = re.sub(r"[^\w.-]+", "_", embodiment)
        to = name
        if name in alike:
            pass
        elif embodiment and sensor.kind == "points":
            to = ".".join(["observation", head, embodiment, *([tail] if tail else [])])
        elif embodiment and not name.startswith(FOLLOWS):
            to = f"observation.{embodiment}.{_short(name)}"
        if sensor.kind in ("image", "depth"):
            out[name] = "another recording uses this name for another kind, or it is not an observation"
        elif name.startswith(FOLLOWS) and (sensor.kind != "vector" or sensor.shape != (1,)):
            out[name] = "an outcome of a row must be one number"
        elif sensor.dtype == "string":
            out[name] = "text is not merged (only the instruction of a take)"
        elif _is_mask(name, source):
            out[name] = "made by an earlier merge: merge the original recordings instead"
        elif not name.startswith(("observation.", FOLLOWS)) or not NAME.fullmatch(to) or {to, mask_of(to)} & taken:
            out[name] = "neither an action, an observation nor an outcome"
        else:
            keep[name] = to
            taken |= {to, mask_of(to)}
    return keep, out
