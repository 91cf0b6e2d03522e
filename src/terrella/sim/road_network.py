"""Roads of a made-up town: a grid of streets with two lanes, whose lanes meet at junctions. Traffic keeps to the right."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

LANE_M = 0.44  # width of a lane; roads are for cars at a tenth of their size
REACH_M = 0.75  # from the middle of a junction to where its lanes begin
SPACING_M = (3.6, 5.0)  # between junctions
REMOVED = 0.25  # probability that a street is left out, where every junction keeps two
POINTS = 9  # of a piece


@dataclass(frozen=True)
class RoadNetwork:
    """Lanes are pieces: straight ones along streets, and turns over junctions.

    nodes [J, 2] m; streets [S, 2], pairs of nodes; points [P, POINTS, 2] m, evenly spaced along each piece; next_pieces [P, 3],
    of which the first choices [P] are different; lanes: the first pieces are those along streets, two a street.
    """

    nodes: np.ndarray
    streets: np.ndarray
    points: np.ndarray
    next_pieces: np.ndarray
    choices: np.ndarray

    @property
    def lanes(self) -> int:
        return 2 * len(self.streets)

    @cached_property
    def lengths(self) -> np.ndarray:
        """[P] m."""
        return np.linalg.norm(np.diff(self.points, axis=1), axis=-1).sum(1)

    @cached_property
    def headings(self) -> np.ndarray:
        """[P, POINTS, 2]: the unit vector along the piece at each of its points."""
        along = np.gradient(self.points, axis=1)
        return along / np.linalg.norm(along, axis=-1, keepdims=True)

    @cached_property
    def surface(self) -> np.ndarray:
        """[R, 4] m: rectangles x0, y0, x1, y1 of streets and junctions, whose corners are cut wide."""
        ends = self.nodes[self.streets]
        streets = np.concatenate([ends.min(1) - LANE_M, ends.max(1) + LANE_M], 1)
        wide = LANE_M + 0.2
        return np.concatenate([streets, np.concatenate([self.nodes - wide, self.nodes + wide], 1)])


def road_network(seed: int, side: int = 5) -> RoadNetwork:
    """The roads of a town of `side` x `side` junctions around the origin. The same seed gives the same roads."""
    rng = np.random.default_rng(seed)
    places = np.cumsum(rng.uniform(*SPACING_M, (2, side)), 1)
    places -= places.mean(1, keepdims=True)
    nodes = np.stack(np.meshgrid(*places, indexing="ij"), -1).reshape(-1, 2)
    number = np.arange(side * side).reshape(side, side)
    streets = [(a, b) for one, other in ((number[:-1], number[1:]), (number[:, :-1], number[:, 1:]))
               for a, b in zip(one.ravel().tolist(), other.ravel().tolist())]  # fmt: skip
    degree = np.bincount(np.ravel(streets), minlength=len(nodes))
    for street in rng.permutation(np.array(streets)).tolist():
        if rng.random() < REMOVED and (degree[street] > 2).all():
            streets.remove(tuple(street))
            degree[street] -= 1
    return _with_turns(nodes, np.array(streets))


def _with_turns(nodes: np.ndarray, streets: np.ndarray) -> RoadNetwork:
    directed = np.stack([streets, streets[:, ::-1]], 1).reshape(-1, 2)  # lanes 2s and 2s + 1 of street s
    begin, end = nodes[directed[:, 0]], nodes[directed[:, 1]]
    along = (end - begin) / np.linalg.norm(end - begin, axis=1, keepdims=True)
    right = 0.5 * LANE_M * np.stack([along[:, 1], -along[:, 0]], 1)
    first, last = begin + REACH_M * along + right, end - REACH_M * along + right
    share = np.linspace(0, 1, POINTS)[:, None]
    pieces = list(first[:, None] + share * (last - first)[:, None])
    following: list[list[int]] = [[] for _ in directed]
    for one, (start, node) in enumerate(directed):
        for other in np.flatnonzero((directed[:, 0] == node) & (directed[:, 1] != start)):
            following[one].append(len(pieces))
            pieces.append(_turn(last[one], along[one], first[other], along[other]))
            following.append([int(other)])
    choices = np.array([len(some) for some in following])
    padded = np.array([(some * 3)[:3] for some in following])
    return RoadNetwork(nodes, streets, np.stack(pieces), padded, choices)


def _turn(start: np.ndarray, along: np.ndarray, end: np.ndarray, beyond: np.ndarray) -> np.ndarray:
    """[POINTS, 2]: straight on, or a quarter of a circle."""
    share = np.linspace(0, 1, POINTS)[:, None]
    radius = (end - start) @ along
    if along @ beyond > 0.5:
        return start + share * (end - start)
    angle = share * np.pi / 2
    return start + radius * (np.sin(angle) * along + (1 - np.cos(angle)) * beyond)
