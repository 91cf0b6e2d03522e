"""The player and the walls of a Doom map, for the laws of physics."""

import math

import numpy as np

from ..physics.system import PhysicalSystem, RigidBody, Slot, Wall

RADIUS = 16.0  # of the player's square, map units
FASTEST_M_S = 13.0  # of a player who walks ahead and sideways, at 12.6: thrust over friction is 11.6 units a tic
LINES = 4000  # of a map at most


def doom_system(lines: np.ndarray, units_per_m: float) -> PhysicalSystem:
    """The system in the channel `pose`. lines: walls of one side only [N, 4], x1, y1, x2, y2 in map units."""
    walls = []
    for x1, y1, x2, y2 in (np.unique(lines, axis=0) / units_per_m).tolist()[:LINES]:
        half_turn = 0.5 * math.atan2(y2 - y1, x2 - x1)
        turn = (math.cos(half_turn), 0.0, 0.0, math.sin(half_turn))
        walls.append(
            Wall((0.5 * (x1 + x2), 0.5 * (y1 + y2), 0.0), (0.5 * math.hypot(x2 - x1, y2 - y1), 0.0, 10.0), turn)
        )
    half = RADIUS / units_per_m
    player = RigidBody("player", Slot("pose"), half_m=(half, half, 1.0), driven=True, max_speed_m_s=FASTEST_M_S)
    bounds = None
    if len(lines):
        low, high = lines.reshape(-1, 2).min(0) / units_per_m, lines.reshape(-1, 2).max(0) / units_per_m
        bounds = (float(low[0]), float(low[1]), -10.0), (float(high[0]), float(high[1]), 10.0)
    return PhysicalSystem((player,), tuple(walls), gravity_m_s2=(0.0, 0.0, 0.0), axes=(0, 1), bounds_m=bounds)
