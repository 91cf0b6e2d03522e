"""Laws that a rollout must obey, with tolerances that are calibrated on the truth."""

from .certificates import Certificates, certify
from .guarded import GuardConfig, Guarded, GuardReport, replay_case
from .laws import LAWS, Law
from .redrawn import RedrawnWorld
from .system import PhysicalSystem, RigidBody, Rod, Slot, Wall
from .tolerance import Tolerance, calibrate
from .tracks import Tracked, fit_tracked
from .trajectory import Trajectory, trajectory_of

__all__ = [
    "LAWS",
    "Certificates",
    "Law",
    "RedrawnWorld",
    "Tracked",
    "Trajectory",
    "PhysicalSystem",
    "RigidBody",
    "Rod",
    "Slot",
    "Tolerance",
    "Wall",
]
__all__ += [
    "GuardConfig",
    "GuardReport",
    "Guarded",
    "replay_case",
    "calibrate",
    "certify",
    "fit_tracked",
    "trajectory_of",
]
