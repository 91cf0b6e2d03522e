from ..workflows.real_environment import (
    STEPS,
    check_alike,
    comparable_channels,
    meaning_difference,
    open_copied,
    open_real,
)
from ..workflows.results import jsonable

compared, misunderstood, sound = comparable_channels, meaning_difference, jsonable
__all__ = ["STEPS", "check_alike", "compared", "misunderstood", "open_copied", "open_real", "sound"]
