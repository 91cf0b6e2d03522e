"""The laws, one a file."""

from .continuity import Continuity
from .energy import Energy
from .free_fall import FreeFall
from .law import Law
from .limits import Limits
from .momentum import Momentum
from .non_penetration import NonPenetration
from .permanence import Permanence
from .support import Support

LAWS: tuple[Law, ...] = (
    NonPenetration(), Energy(), Momentum(), FreeFall(), Permanence(), Support(), Limits(), Continuity(),
)  # fmt: skip

__all__ = ["LAWS", "Law"]
