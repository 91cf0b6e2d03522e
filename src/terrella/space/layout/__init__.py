"""Places from words and plans: rooms, doors, windows, stairs and furniture become boxes, light and Gaussians."""

from .bake import Built, build
from .plan import Plan, read_plan
from .words import Understood, understood

__all__ = ["Built", "Plan", "Understood", "build", "read_plan", "understood"]
