"""What a recording holds, for people: the settings before it is made, and its figures and pictures afterwards."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.losses import by_reason
from ..core.spec import BUTTONS, CHOICE, Spec, can_idle, neutral_action
from .progress import Progress

if TYPE_CHECKING:
    from ..data import Dataset


def describe(spec: Spec) -> list[str]:
    """What will be recorded, and who chose each setting that the person did not set."""
    from ..data.recording import LONGEST

    how = spec.card.get("how")
    chosen = lambda what: f" ({how[what]})" if isinstance(how, Mapping) and what in how else ""  # noqa: E731
    drawn, names = spec.channels.get("rgb"), spec.action_names
    height, width = (drawn.shape or (0, 0))[:2] if drawn is not None else (0, 0)
    limit = f"{LONGEST:,} steps, as none is declared"
    if spec.max_episode_steps:
        limit = f"{spec.max_episode_steps:,} steps, its time limit"
    keys = ", ".join(f"{key} {_action_text(spec, action)}" for key, action in spec.keys.items() if "+" not in key)
    rest = _action_text(spec, neutral_action(spec).reshape(-1).tolist())
    return [
        f"{spec.name}: pictures of {height}x{width}{chosen('pictures')} (--size)" if drawn is not None else
        f"{spec.name} shows no pictures: the recording holds numbers only, and no world that draws can be trained on it.",
        f"{1 / spec.dt_s:g} steps a second{chosen('frame rate')}; episodes of up to {limit}.",
        f"Actions: {', '.join(names) or spec.action}{chosen('action names')}; at rest: "
        + (rest if can_idle(spec) else f"{rest}, as none is declared to do nothing (--idle)"),
        f"Keys: {keys or 'none (--keys)'}{chosen('keys')}",
        *_observed(spec),
    ]  # fmt: skip


def _observed(spec: Spec) -> list[str]:
    """Lines on the channels of an environment, on the names that were changed, and on what is in no channel."""
    from ..data.channels import feature_of, features_of

    how, renamed, left_out, notes = (spec.card.get(name) for name in ("how", "renamed", "left_out", "notes"))
    task = how.get("task") if isinstance(how, Mapping) else None
    names = dict(renamed) if isinstance(renamed, Mapping) else {}
    features = features_of(spec.recorded).items()
    names |= {channel: feature for channel, feature in features if "observation.pose" != feature != feature_of(channel)}
    channels = [name for name in spec.channels if name not in ("text", "instruction")]
    return [
        *([f"Channels: {', '.join(channels)}."] if isinstance(how, Mapping) else []),
        *([f"The task of each episode: {task}."] if task else []),
        *([f"Names: {', '.join(f'{name} is {now}' for name, now in names.items())}."] if names else []),
        *([f"Left out: {', '.join(lost)}."] if (lost := by_reason(left_out)) else []),
        *(f"Note: {note}." for note in (notes if isinstance(notes, Sequence) else ())),
    ]


def _action_text(spec: Spec, action: list[float]) -> str:
    """The name of a flat action, or its numbers."""
    low, _ = spec.action_limits
    if spec.action_mode == CHOICE and len(action) == 1:
        at = int(action[0] - low)
        return spec.action_names[at] if at < len(spec.action_names) else str(int(action[0]))
    pressed = [name for name, value in zip(spec.action_names, action) if value]
    if spec.action_mode == BUTTONS and spec.action_names:
        return "+".join(pressed) or "none"
    return ",".join(f"{value:g}" for value in action)


def recording_facts(dataset: Dataset, world: str, progress: Progress) -> dict[str, object]:
    """The figures of a recording of `world`, with a picture of it to look at; warns of a recording that teaches little."""
    from ..data import measure_coverage

    facts: dict[str, object] = {"frames": dataset.length, "episodes": len(dataset.episodes), "world": world}
    if dataset.has("rgb"):
        root = Path(dataset.root)
        facts["look"] = str(_contact_sheet(dataset, root / "look.jpg"))
        films = sorted(root.glob("videos/*/chunk-*/*.mp4"))
        facts |= {"film": str(films[0])} if films else {}
        covered = measure_coverage(dataset)
        facts |= covered.facts()
        for warning in covered.warnings():
            progress(f"Warning: {warning}")
    return facts


def _contact_sheet(dataset: Dataset, path: Path) -> Path:
    """Twelve pictures from the whole recording, to see at a glance what it holds."""
    from ..measure import strip

    rows = [dataset.length * (2 * place + 1) // 24 for place in range(12)]
    pictures = dataset.rgb_at(rows).reshape(3, 4, *dataset.rgb_at(rows[:1]).shape[1:])
    lines = {f"from {rows[4 * line]:,}": pictures[line] for line in range(3)}
    strip(lines, [""] * 4).convert("RGB").save(path, quality=88)
    return path
