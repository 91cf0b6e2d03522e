"""Finds the numbers of a vector that are a pose on the ground."""

import re

from ..data.source import Sensor

_PREFIX = "(?:|p|pos|position|translation|pose)"
_TURN = "(?:q|quat|quaternion|rotation|orientation)"


def pose_columns(sensor: Sensor) -> dict | None:
    """The columns of a pose on the ground, found by the numbers' names: {"x", "y", "quaternion": [w, x, y, z] or None,
    "yaw": column or None, "degrees": whether yaw is in degrees}. None where there is no position in metres.

    The world's z is up, and a body looks along its own x. Quaternions and yaw rotate body axes into world axes.
    """
    if not sensor.dtype.startswith("float"):
        return None
    plain = [re.sub(r"[^a-z]", "", re.sub(r"_(m|rad|deg)$", "", name.lower())) for name in sensor.names]

    def place(pattern: str) -> int | None:
        return next((at for at, name in enumerate(plain) if re.fullmatch(pattern, name)), None)

    x, y = place(f"{_PREFIX}x"), place(f"{_PREFIX}y")
    if x is None or y is None or any(sensor.units.get(sensor.names[at], "m") != "m" for at in (x, y)):
        return None
    turn, yaw = [place(f"{_TURN}{axis}") for axis in "wxyz"], place("yaw|theta|heading")
    quaternion = None if None in turn else turn
    named = re.search(r"pose|position|odom|gps|ground", sensor.name.lower())
    if quaternion is None and yaw is None and not named:
        return None
    degrees = yaw is not None and (
        sensor.names[yaw].endswith("_deg") or sensor.units.get(sensor.names[yaw]) in ("deg", "°")
    )
    return {"x": x, "y": y, "quaternion": quaternion, "yaw": yaw, "degrees": degrees}
