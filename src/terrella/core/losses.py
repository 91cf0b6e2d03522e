"""What was left out of an environment or a recording, as text."""

from collections.abc import Mapping


def by_reason(left_out: object) -> list[str]:
    """["a, b (why)", ...] of a mapping {a: why, b: why}; [] for anything else."""
    reasons: dict[str, list[str]] = {}
    for name, why in left_out.items() if isinstance(left_out, Mapping) else ():
        reasons.setdefault(f"{why!s:.200}", []).append(f"{name!s:.100}")
    return [f"{', '.join(names)} ({why})" for why, names in reasons.items()]
