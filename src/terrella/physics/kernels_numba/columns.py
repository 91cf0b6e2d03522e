"""Columns of the matrices that hold a system and a rollout; see bodies.py."""

# of a body at an instant; after them come its distances to walls and to bodies
P, V, Q, S, HERE, RADIUS, SIZE, MASS, INERTIA, TURN = 0, 3, 6, 10, 13, 14, 15, 16, 17, 20
WAY, WALLS, BODIES = (
    29,
    30,
    31,
)  # of the step before it: how far the body may go, how many walls and bodies it may touch
INSTANT = 32
# of a body: where its numbers are in the channels (-1: nowhere), then its constants
AT_P, AT_V, AT_Q, AT_S, AT_HERE, AT_RADIUS, GIVEN_RADIUS, HALF, REACH_M, THIN, DENSITY, GIVEN_MASS, GIVEN_INERTIA = (
    0, 1, 2, 3, 4, 5, 6, 7, 10, 11, 12, 13, 14,
)  # fmt: skip
DRIVEN, TIED, FRICTION, RESTITUTION, FASTEST = 17, 18, 19, 20, 21  # NaN: unknown
# of a wall
PLANE, NORMAL, HEIGHT, CENTRE, EXTENT, FIXED = 0, 1, 4, 5, 8, 11
# of a rod: the body, the fixed point, the length, whether it alone holds a body whose velocity is in a channel
HELD, PIVOT, LENGTH, ALONE = 0, 1, 4, 5
# of a limit: the number among the channels, and its range
NUMBER, LEAST, MOST = 0, 1, 2
# facts
DT, GRAVITY, WEIGHT, DISSIPATES, TRACKED, BOUNDED, LOW, HIGH, SKIN, REACH = 0, 1, 4, 5, 6, 7, 8, 11, 14, 15
AXES, SPIN_AXES, BODY_COUNT, WALL_COUNT, ROD_COUNT, LIMIT_COUNT = (
    16,
    19,
    22,
    23,
    24,
    25,
)  # an axis past the last one is -1
SYSTEM = 26
