from ..workflows.real_environment import STEPS, check_alike, compared, misunderstood, open_copied, open_real
from ..workflows.results import jsonable as sound

__all__ = ["STEPS", "check_alike", "compared", "misunderstood", "open_copied", "open_real", "sound"]
