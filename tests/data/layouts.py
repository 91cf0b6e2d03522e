"""A layout from a few sizes, for the tests."""

from __future__ import annotations

from collections.abc import Mapping

from terrella.data import Layout, Sensor
from terrella.data.channels import ACTION, DEPTH, DONE, POSE_NAMES, REWARD, RGB, STATE


def layout_of(
    fps: float,
    action: tuple[str, ...],
    rgb: tuple[int, int] | None = None,
    depth: tuple[int, int] | None = None,
    pose: bool = False,
    vectors: Mapping[str, int] | None = None,
    world: Mapping[str, object] | None = None,
    arrays: Mapping[str, tuple[tuple[int, ...], str]] | None = None,
) -> Layout:
    """Of a World's channels: rgb (H, W), depth (h, w), the camera's pose, vectors by length, a name per number of an
    action, arrays (masks, lists) by shape and type."""
    made = [Sensor(RGB, "image", (*rgb, 3), "uint8")] if rgb else []
    made += [Sensor(DEPTH, "depth", depth)] if depth else []
    made += [Sensor(STATE, "vector", (7,), names=POSE_NAMES)] if pose else []
    for name, length in (vectors or {}).items():
        names = tuple(f"{name}_{i}" for i in range(length))
        made.append(Sensor(f"observation.{name}", "vector", (length,), names=names))
    made += [Sensor(f"observation.{name}", "vector", *kind) for name, kind in (arrays or {}).items()]
    made.append(Sensor(ACTION, "vector", (len(action),), names=tuple(action)))
    made += [Sensor(REWARD, "vector", (1,)), Sensor(DONE, "vector", (1,), "bool")]
    return Layout(fps, {sensor.name: sensor for sensor in made}, world=dict(world or {}))
