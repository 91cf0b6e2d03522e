"""Shapes of parts: the six sides of a box, bent into rounded boxes, tubes, cones and cushions."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Shape:
    """How the sides of a box are bent. The box stays what stops walkers and light."""

    radius_m: float = 0.0  # of the edges
    tube: bool = False  # a circle or an ellipse from above
    foot: float = 1.0  # width at the foot of a tube, relative to the box
    top: float = 1.0  # and at its top
    drawn: bool = True  # as a surface; leaves and flames are not
    power: float = 0.0  # a superellipsoid of this exponent; 2: an ellipsoid


SHARP = Shape()
SHAPES = {
    "box": Shape(radius_m=0.01), "sharp": SHARP, "round": Shape(radius_m=0.03), "soft": Shape(radius_m=0.09),
    "tube": Shape(tube=True), "shade": Shape(tube=True, top=0.62), "pot": Shape(tube=True, foot=0.68),
    "leg": Shape(tube=True, foot=0.6), "bowl": Shape(tube=True, foot=0.45), "ball": Shape(power=2.0),
    "pillow": Shape(power=2.8), "leaves": Shape(drawn=False), "flame": Shape(drawn=False),
}  # fmt: skip


def numbers(shapes: list[Shape]) -> np.ndarray:
    """[K, 5]: radius, whether a tube, foot, top, power."""
    return np.array([[one.radius_m, one.tube, one.foot, one.top, one.power] for one in shapes], float).reshape(-1, 5)


def bend(points: np.ndarray, sides: np.ndarray, boxes: np.ndarray, shapes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points [N, 3] on sides [N] of boxes [N, 6] moved to their shapes [N, 5], and the normals there [N, 3]."""
    rows, out = np.arange(len(points)), points.copy()
    normals = np.zeros_like(points)
    normals[rows, sides // 2] = np.where(sides % 2, 1.0, -1.0)
    middle, half = (boxes[:, :3] + boxes[:, 3:]) / 2, np.maximum((boxes[:, 3:] - boxes[:, :3]) / 2, 1e-6)
    for kind, mask in (("tube", shapes[:, 1] > 0), ("ball", shapes[:, 4] > 0), ("round", shapes[:, 0] > 0)):
        if mask.any():
            given = points[mask], sides[mask], middle[mask], half[mask], shapes[mask]
            out[mask], normals[mask] = {"tube": _tube, "ball": _ball, "round": _rounded}[kind](*given)
    return out, normals


def _rounded(points, sides, middle, half, shapes):
    radius = np.minimum(shapes[:, :1], 0.45 * half.min(1, keepdims=True))
    inner = np.clip(points, middle - half + radius, middle + half - radius)
    way = points - inner
    normal = way / np.linalg.norm(way, axis=1, keepdims=True)
    return inner + radius * normal, normal


def _ball(points, sides, middle, half, shapes):
    at, power = (points - middle) / half, shapes[:, 4:5]
    at = at / (np.abs(at) ** power).sum(1, keepdims=True) ** (1 / power)
    normal = np.sign(at) * np.abs(at) ** (power - 1) / half
    return middle + half * at, normal / np.linalg.norm(normal, axis=1, keepdims=True)


def _tube(points, sides, middle, half, shapes):
    at = (points - middle) / half
    long_ = np.maximum(np.hypot(at[:, 0], at[:, 1]), 1e-9)
    turned = at[:, :2] * (np.abs(at[:, :2]).max(1) / long_)[:, None]
    foot, top = shapes[:, 2], shapes[:, 3]
    wide = foot + (top - foot) * (at[:, 2] + 1) / 2
    normal = np.concatenate([turned / half[:, :2], ((foot - top) / half[:, 2] / 2)[:, None]], 1)
    cap = sides // 2 == 2
    normal[cap] = np.array([0, 0, 1.0]) * np.where(sides[cap] % 2, 1.0, -1.0)[:, None]
    place = np.concatenate([turned * wide[:, None], at[:, 2:]], 1)
    return middle + half * place, normal / np.linalg.norm(normal, axis=1, keepdims=True)
