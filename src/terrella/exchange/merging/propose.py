"""propose: the mapping of several robots into one set, as far as names, units and frames allow; a person does the rest."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ...core.errors import DatasetError
from ...data.resample import quaternions
from ...data.source import Sensor, Source
from ..formats.rows import unique
from .mapping import (
    ACTION,
    FOLLOWS,
    MADE,
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

_WIDE = 64  # an unnamed vector of more numbers (an embedding, a tactile skin) is kept whole, not taken apart
_ENDINGS = {
    "m": "m",
    "cm": "cm",
    "mm": "mm",
    "rad": "rad",
    "deg": "deg",
    "mps": "m/s",
    "radps": "rad/s",
    "degps": "deg/s",
}
_POSITION = re.compile(r"(?:p|pos|position|translation)_?([xyz])")
_ROTATION = re.compile(r"(?:q|quat|quaternion|orientation|rotation)_?([wxyz])")


_Notes = dict[str, dict[str, list[str]]]  # source -> what a person should look at -> the numbers or sensors concerned


@dataclass(frozen=True)
class _Place:
    """One number of one sensor of one source. `stem` is what it may share with others, None where it has no name."""

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
        """The dimension that it has for itself alone."""
        return f"{self.embodiment}.{self.stem or f'{_short(self.sensor)}_{self.index}'}"


def propose(sources: Mapping[str, Source], fps: float | None = None) -> MergeMapping:
    """A first mapping of the sources (path -> Source), to be written, looked at and edited.

    Numbers of the same name fill one dimension: names compared without case and punctuation, a unit at the end (x_mm) taken
    for its unit, position_x and quat_w for x and qw, those of sensors other than "action" and "observation.state" with
    the sensor's name before them ("imu.ax"). Units are converted where both are stated, to the one unit or their quantity's basic
    one. Different stated frames or quantities are different dimensions. What has no name gets a dimension of its own, as
    "aloha.state_3", which sources of one embodiment share. Cameras of the same name are one, at the smallest of their sizes.
    Each guess worth a look is in its source's `notes`.

    fps: of the merged rows; None: the slowest of the sources'.
    DatasetError without a source, or where no fps is known.
    """
    if not sources:
        raise DatasetError("there is nothing to merge; name at least one recording.")
    names = _embodiments(sources)
    rates = {path: _rate(source) for path, source in sources.items()}
    known = [rate for rate in rates.values() if rate]
    if fps is None and not known:
        raise DatasetError("none of the recordings says how many rows a second it has; give the fps of the merged one.")
    notes: _Notes = {path: {} for path in sources}
    places = [place for path in sources for place in _places(path, sources[path], names[path])]
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
                number = Number(place.name, filled[place], place.unit)
                vectors.setdefault(place.sensor, []).append(number)
        seen = {name: name for name, it in source.sensors.items() if name in cameras and it.kind == cameras[name].kind}
        keep, out = _rest(source, names[path] if several else "", cameras, {*vectors, *seen})
        mapped.append(
            SourceMapping(
                path=path,
                embodiment=names[path],
                fps=rates[path],
                vectors={name: Vector(tuple(n), source.sensors[name].frame) for name, n in vectors.items()},
                cameras=seen,
                keep=keep,
                out=out,
                notes=tuple(f"{', '.join(subjects)}: {what}" for what, subjects in notes[path].items()),
            )
        )
    chosen = float(fps if fps is not None else min(known))
    gap = max([1.0, 3 / chosen, *(3 / rate for rate in [*known, *_clocks(sources)])])
    return MergeMapping(MergeRows(chosen, max_gap_s=round(gap, 3)), action, state, cameras, tuple(mapped))


def _embodiments(sources: Mapping[str, Source]) -> dict[str, str]:
    """path -> name: one name for one robot with one set of vectors, numbered where two robots have one name."""
    found: dict[str, str] = {}
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
        found[path] = name
    return found


def _rate(source: Source) -> float | None:
    """Its rows a second: as it says, else its slowest camera's or else action's rate, said or seen in its first take."""
    if source.fps:
        return float(source.fps)
    pictures = [name for name, sensor in source.sensors.items() if sensor.kind == "image"]
    names = pictures or [name for name in source.sensors if name == ACTION] or list(source.sensors)
    said = [rate for name in names if (rate := source.sensors[name].rate_hz)]
    if said:
        return float(min(said))
    take = next(iter(source.takes()), None)
    clocks = [np.asarray(take.readings[name].time_s) for name in names if name in take.readings] if take else []
    steps = [float(np.median(np.diff(clock))) for clock in clocks if len(clock) > 1]
    return round(1 / max(steps), 3) if steps and 0 < max(steps) < np.inf else None


def _clocks(sources: Mapping[str, Source]) -> list[float]:
    return [sensor.rate_hz for source in sources.values() for sensor in source.sensors.values() if sensor.rate_hz]


def _short(sensor: str) -> str:
    return sensor.removeprefix("observation.")


def _places(path: str, source: Source, embodiment: str) -> list[_Place]:
    found: list[_Place] = []
    for name, sensor in source.sensors.items():
        if sensor.kind != "vector" or len(sensor.shape) != 1 or sensor.dtype == "string" or not _belongs(name, source):
            continue
        if name not in (ACTION, STATE) and not sensor.names and sensor.shape[0] > _WIDE:
            continue
        for index in range(sensor.shape[0]):
            label = sensor.names[index] if sensor.names else ""
            stem, unit = _stem(name, sensor, label)
            found.append(_Place(path, embodiment, name, index, stem, label, unit, sensor.frame))
    shared: set[tuple[bool, str]] = set()
    for at, place in enumerate(found):  # what one source has twice is not shared twice
        for stem in (place.stem, f"{_short(place.sensor)}.{place.name}", None):
            if stem is None or (place.sensor == ACTION, stem) not in shared:
                break
        found[at] = replace(place, stem=stem if place.stem else None)
        shared.add((place.sensor == ACTION, stem or ""))
    return found


def _belongs(name: str, source: Source) -> bool:
    return name == ACTION or (name.startswith("observation.") and not _is_mask(name, source))


def _is_mask(name: str, source: Source) -> bool:
    whole = name.removesuffix("_mask")
    return name not in (ACTION, STATE) and (name in MADE or (whole != name and whole in source.sensors))


def _stem(sensor_name: str, sensor: Sensor, label: str) -> tuple[str | None, str]:
    """(what the number is called, None where it has no name of its own; its unit)."""
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
    """The dimensions that these numbers need, in the order in which they are met; which one each fills goes to `filled`."""
    groups: dict[str, list[_Place]] = {}
    for place in places:
        groups.setdefault(place.own if place.stem is None else place.stem, []).append(place)
    found: dict[str, Dimension] = {}
    for members in groups.values():
        if members[0].stem is None:
            dimension = Dimension(_common_unit(members), members[0].frame)
            _fill(members, members[0].own, dimension, found, filled)
            for place in members:
                said = f"without a name in {place.sensor}, so of this robot alone."
                notes[place.source].setdefault(said, []).append(filled[place])
            continue
        frames = {place.frame for place in members} - {""}
        kinds = {quantity(place.unit) or place.unit for place in members} - {""}
        parted: dict[str, list[_Place]] = {}
        for place in members:
            known = (place.frame or len(frames) < 2) and (place.unit or len(kinds) < 2)
            name = _title(members)
            if not known:
                name = place.own
                said = f"no frame or unit is stated in {place.sensor}, and others of that name differ in it: of this robot alone."
                notes[place.source].setdefault(said, []).append(name)
            else:
                name += f" ({basic(place.unit)})" if len(kinds) > 1 else ""
                name += f" @ {place.frame}" if len(frames) > 1 else ""
            parted.setdefault(name, []).append(place)
        if len(parted) > 1:
            for place in members:
                said = f"of {place.sensor}, differs in frame or quantity from others of that name: see {', '.join(parted)}."
                notes[place.source].setdefault(said, []).append(place.name)
        for name, part in parted.items():
            dimension = Dimension(_common_unit(part), next((place.frame for place in part if place.frame), ""))
            _fill(part, name, dimension, found, filled)
            _unstated(part, dimension, filled, notes)
    return found


def _fill(part: list[_Place], name: str, dimension: Dimension, found: dict, filled: dict[_Place, str]) -> None:
    free = unique(name, found)
    found[free] = dimension
    filled.update(dict.fromkeys(part, free))


def _unstated(part: list[_Place], dimension: Dimension, filled: Mapping[_Place, str], notes: _Notes) -> None:
    if len({place.source for place in part}) < 2:
        return
    for place in part:
        for what, here, shared in (("unit", place.unit, dimension.unit), ("frame", place.frame, dimension.frame)):
            if shared and not here:
                said = f"no {what} is stated in {place.sensor}; '{shared}' is taken, as another recording has it."
                notes[place.source].setdefault(said, []).append(filled[place])


def _title(members: list[_Place]) -> str:
    """The name as all have it, else without case, punctuation and unit."""
    stem, prefix = members[0].stem or "", f"{_short(members[0].sensor)}."
    labels = {place.name for place in members}
    if len(labels) > 1:
        return stem
    return (prefix if stem.lower().startswith(prefix.lower()) else "") + labels.pop()


def _common_unit(part: list[_Place]) -> str:
    units = {place.unit for place in part} - {""}
    return units.pop() if len(units) == 1 else (basic(min(units)) if units else "")


def _cameras(sources: Mapping[str, Source], notes: _Notes) -> dict[str, MergedCamera]:
    """Every image and depth sensor by its name, at the size of its smallest; an image wins where kinds differ."""
    found: dict[str, MergedCamera] = {}
    for path, source in sources.items():
        for name, sensor in source.sensors.items():
            if sensor.kind not in ("image", "depth") or not name.startswith("observation.") or name in MADE:
                continue
            if not NAME.fullmatch(name):
                continue
            camera, before = MergedCamera(sensor.kind, *map(int, sensor.shape[:2])), found.get(name)
            if before and before.kind != camera.kind:
                said = f"of kind {camera.kind} here and {before.kind} elsewhere."
                notes[path].setdefault(said, []).append(name)
                camera = min(before, camera, key=lambda it: it.kind != "image")
            elif before:
                camera = min(before, camera, key=lambda it: (it.height * it.width, it.height))
            found[name] = camera
    for path, source in sources.items():
        for name, camera in found.items():
            sensor = source.sensors.get(name)
            if sensor and sensor.kind == camera.kind and tuple(sensor.shape[:2]) != (camera.height, camera.width):
                said = f"fitted from {sensor.shape[0]} x {sensor.shape[1]} into {camera.height} x {camera.width}."
                notes[path].setdefault(said, []).append(name)
    return found


def _rest(
    source: Source, embodiment: str, cameras: Mapping[str, MergedCamera], mapped: set[str]
) -> tuple[dict[str, str], dict[str, str]]:
    """(kept whole: sensor -> its name in the merged set; left out: sensor -> why), for whatever is not in `mapped`."""
    keep: dict[str, str] = {}
    out: dict[str, str] = {}
    taken = {*MADE, *cameras}
    for name, sensor in source.sensors.items():
        if name in mapped:
            continue
        head, _, tail = _short(name).partition(".")
        embodiment = re.sub(r"[^\w.-]+", "_", embodiment)
        to = name
        if embodiment and sensor.kind == "points":
            to = ".".join(["observation", head, embodiment, *([tail] if tail else [])])
        elif embodiment and not name.startswith(FOLLOWS):
            to = f"observation.{embodiment}.{_short(name)}"
        if sensor.kind in ("image", "depth"):
            out[name] = "another recording has this name for another kind, or it is no name of what observes"
        elif name.startswith(FOLLOWS) and (sensor.kind != "vector" or sensor.shape != (1,)):
            out[name] = "what follows a row must be one number"
        elif sensor.dtype == "string":
            out[name] = "text is not merged (the instruction of a take is kept)"
        elif _is_mask(name, source):
            out[name] = "a mask or number made by an earlier merge: merge the recordings that it was made of instead"
        elif not name.startswith(("observation.", FOLLOWS)) or not NAME.fullmatch(to) or {to, mask_of(to)} & taken:
            out[name] = "neither an action, nor what was observed, nor what followed"
        else:
            keep[name] = to
            taken |= {to, mask_of(to)}
    return keep, out
