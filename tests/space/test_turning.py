"""Pictures of a camera that only turned are told from those of one that moved."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from terrella.cli import main
from terrella.space.pictures.turning import rotation_error

WIDE, HIGH, FOCAL = 640, 480, 400.0


def yaw(angle: float) -> np.ndarray:
    return np.array([[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]])


def pairs(arm_m: float, walk_m: float = 0.0):
    """Matches of pictures that a camera takes `arm_m` before the axis about which it turns, and walking sideways."""
    rng = np.random.default_rng(0)
    points = np.stack([rng.uniform(-4, 4, 600), rng.uniform(-1.5, 1.5, 600), rng.uniform(2, 5, 600)], 1)
    seen = []
    for k, angle in enumerate(np.linspace(-0.5, 0.5, 6)):
        rot = yaw(angle)
        at = (points - arm_m * rot.T @ [0, 0, 1] - [walk_m * k, 0, 0]) @ rot.T
        ahead = at[:, 2] > 0.5
        pixels = FOCAL * at[:, :2] / at[:, 2:].clip(0.5) + rng.normal(0, 0.3, (600, 2))
        seen.append((pixels, ahead & (np.abs(pixels) < [WIDE / 2, HIGH / 2]).all(1)))
    both = [(a, b, one & two) for k, (a, one) in enumerate(seen) for b, two in seen[:k]]
    return [(a[shared], b[shared], WIDE) for a, b, shared in both if shared.sum() >= 30]


def test_a_camera_that_only_turned_is_told_from_one_that_moved():
    turned = rotation_error(pairs(0.0))
    assert turned is not None and turned < 1 / 640
    for moved in (pairs(0.25), pairs(0.0, 0.2)):
        error = rotation_error(moved)
        assert error is not None and error > 2 / 640
    still = [(a, a + 0.1, size) for a, _, size in pairs(0.0)]
    assert rotation_error(still) is None and rotation_error([]) is None  # nothing can be said


def test_pictures_that_show_no_depth_are_refused_in_one_sentence(tmp_path, capsys):
    pytest.importorskip("pycolmap")
    rng = np.random.default_rng(0)
    ring = np.asarray(
        Image.fromarray(rng.integers(0, 255, (60, 240, 3), np.uint8)).resize((1920, 480), Image.Resampling.BICUBIC)
    )
    x, y = np.meshgrid(np.arange(320) - 159.5, np.arange(240) - 119.5)
    (tmp_path / "set").mkdir()
    for k in range(10):
        heading = np.arctan2(x, 200) + 0.15 * k
        rows, columns = 240 + 200 * y / np.hypot(x, 200), (heading * 1920 / (2 * np.pi)) % 1920
        Image.fromarray(ring[rows.astype(int), columns.astype(int)]).save(tmp_path / "set" / f"{k}.png")
    assert main(["space", "fit", str(tmp_path / "set"), "--out", str(tmp_path / "run")]) == 2
    assert "the camera only turned" in capsys.readouterr().err and not (tmp_path / "run").exists()
