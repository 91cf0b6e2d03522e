"""The doctor, who names the faults of a recording, and repair, which mends a copy."""

from .doctor import Fault, doctor
from .repair import repair

__all__ = ["Fault", "doctor", "repair"]
