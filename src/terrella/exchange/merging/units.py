"""Conversion between units of one quantity: "deg" -> "rad", "mm" -> "m", "0..255" -> "0..1"."""

import math

from ...core.errors import DatasetError

_PREFIXES = {"": 1.0, "k": 1000.0, "h": 100.0, "c": 0.01, "m": 0.001, "u": 1e-6, "n": 1e-9}
_PREFIXED = {
    "m": "length",
    "rad": "angle",
    "s": "time",
    "N": "force",
    "V": "voltage",
    "A": "current",
    "T": "field",
    "Pa": "pressure",
}
# unit -> (quantity, factor to that quantity's basic unit, offset)
_PLAIN: dict[str, tuple[str, float, float]] = {
    **{sign + unit: (what, by, 0) for unit, what in _PREFIXED.items() for sign, by in _PREFIXES.items()},
    "in": ("length", 0.0254, 0),
    "ft": ("length", 0.3048, 0),
    "deg": ("angle", math.pi / 180, 0),
    "turn": ("angle", 2 * math.pi, 0),
    "min": ("time", 60, 0),
    "h": ("time", 3600, 0),
    "0..1": ("share", 1, 0),
    "0..100": ("share", 0.01, 0),
    "0..255": ("share", 1 / 255, 0),
    "-1..1": ("share", 0.5, 0.5),
    "%": ("share", 0.01, 0),
    "kg": ("mass", 1, 0),
    "N m": ("torque", 1, 0),
    "K": ("temperature", 1, 0),
    "degC": ("temperature", 1, 273.15),
    "rpm": ("angle/s", 2 * math.pi / 60, 0),
    "g": ("length/s2", 9.80665, 0),  # as accelerometers report
}
_SYNONYMS = {
    "metre": "m", "meter": "m", "metres": "m", "meters": "m", "radian": "rad", "radians": "rad", "degree": "deg",
    "degrees": "deg", "°": "deg", "µm": "um", "µs": "us", "second": "s", "seconds": "s", "rev": "turn", "Nm": "N m",
    "N*m": "N m", "N·m": "N m", "°C": "degC", "percent": "%", "µT": "uT", "mps": "m/s", "radps": "rad/s",
    "degps": "deg/s", "dps": "deg/s",
}  # fmt: skip
_FIRST = {quantity: unit for unit, (quantity, factor, shift) in reversed(_PLAIN.items()) if (factor, shift) == (1, 0)}


def quantity(unit: str) -> str | None:
    """The quantity of a unit ("length", "angle/s", …); None for "" and unknown units."""
    known = _lookup(unit)
    return known[0] if known else None


def basic(unit: str) -> str:
    """The basic unit of its quantity: "m" for "mm", "rad/s" for "rpm"; an unknown unit itself."""
    known = _lookup(unit)
    if not known:
        return unit
    plain, slash, per = known[0].partition("/")
    return _FIRST[plain] + slash + per


def convert(unit: str, to: str) -> tuple[float, float]:
    """(scale, offset): x in `unit` is scale * x + offset in `to`; (1, 0) where they are equal or one is "". DatasetError where the
    quantities differ, or the units differ and one is unknown."""
    if unit == to or not unit or not to:
        return 1.0, 0.0
    a, b = _lookup(unit), _lookup(to)
    if not a or not b:
        raise DatasetError(f"no conversion from '{unit or to}' to '{to}' is known; give its scale (and offset).")
    if a[0] != b[0]:
        raise DatasetError(f"'{unit}' measures {a[0]} and '{to}' measures {b[0]}; give its scale if that is intended.")
    if a[1:] == b[1:]:
        return 1.0, 0.0
    return a[1] / b[1], (a[2] - b[2]) / b[1]


def _lookup(unit: str) -> tuple[str, float, float] | None:
    unit = _SYNONYMS.get(unit.strip(), unit.strip())
    if unit in _PLAIN:
        return _PLAIN[unit]
    plain, slash, per = unit.partition("/")
    plain, per = _SYNONYMS.get(plain.strip(), plain.strip()), per.strip().replace("^", "").replace("²", "2")
    seconds = {"s": 1.0, "s2": 1.0, "h": 3600.0, "min": 60.0}.get(per)
    if not slash or seconds is None or plain not in _PLAIN or _PLAIN[plain][2] or "/" in _PLAIN[plain][0]:
        return None
    measured, factor, _ = _PLAIN[plain]
    return f"{measured}/{'s2' if per == 's2' else 's'}", factor / seconds, 0.0
