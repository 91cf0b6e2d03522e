"""Merges recordings into a LeRobot v3 folder, by a mapping file or a proposed mapping."""

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

from ...core import files
from ...core.errors import DatasetError
from ...data.format import WORLD
from ...data.source import Source
from ..formats import lerobot
from .mapping import ACTION, EMBODIMENT, MergeMapping, SourceMapping, check_mapping
from .mapping_file import read_mapping, write_mapping
from .merge import merge
from .propose import propose
from .report import MergeReport


def merge_into(
    sources: Mapping[str, Source],
    out: str | Path,
    mapping: str | Path | None = None,
    fps: float | None = None,
    dry: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[dict, str]:
    """Merges the sources (path -> Source) into a new LeRobot v3 folder; returns (facts, the same as text).

    mapping: the mapping file; None proposes a mapping and writes it to OUT.toml, which must not exist yet.
    fps:     rows per second; overrides the mapping's.
    dry:     stop once the mapping is written.

    The folder also has meta/merge.toml (the mapping), meta/merge.json (the report) and, in meta/terrella.json under
    "embodiments", each robot's statistics. A merge that fails or is stopped leaves neither the folder nor a proposed mapping.
    """
    out = Path(out)
    path = out.parent / f"{out.name}.toml" if mapping is None else Path(mapping)
    if mapping is None:
        if path.exists():
            raise DatasetError(f"{path} exists already: merge by it (--mapping {path}), or move it away.")
        plan = propose(sources, fps)
        write_mapping(plan, path)
    else:
        plan = read_mapping(path)
        plan = replace(plan, rows=replace(plan.rows, fps=float(fps))) if fps is not None else plan
    check_mapping(plan, sources)
    if dry:
        notes = {source.path: list(source.notes) for source in plan.sources}
        lines = [f"{source}: {note}" for source, some in notes.items() for note in some]
        return {"mapping": str(path), "notes": notes}, "\n".join(
            [*lines, f"the mapping is {path}: edit it, then merge by it"]
        )
    report = MergeReport()
    terminal = all(_ends_without_action(sources[it.path], it, plan) for it in plan.sources)
    merged = merge(sources, plan, report, out.name, terminal)

    def finish(folder: Path, notes: list[str]) -> None:
        about = json.loads((folder / WORLD).read_text(encoding="utf-8"))
        files.write_json(folder / WORLD, {**about, "embodiments": report.embodiments()})
        files.write_json(folder / "meta" / "merge.json", {**report.to_json(), "notes": notes})
        write_mapping(plan, folder / "meta" / "merge.toml")

    try:
        notes = lerobot.write(merged, out, progress=progress, finish=finish)
    except BaseException:
        if mapping is None:
            path.unlink(missing_ok=True)
        raise
    new, notes = [f"note: {note}" for note in notes], [*merged.notes, *notes]
    text = "\n".join([report.text().rstrip(), *new, f"{len(sources)} recordings are now {out}, merged by {path}"])
    return {"out": str(out), "mapping": str(path), "notes": notes, **report.to_json()}, text


def _ends_without_action(origin: Source, source: SourceMapping, mapping: MergeMapping) -> bool:
    """Whether the last row of the source's first take, which stands for all, has no action."""
    take = next(iter(merge({source.path: origin}, replace(mapping, sources=(source,))).takes()), None)
    if take is None or ACTION not in take.readings:
        return True
    return len(take.readings[ACTION].time_s) < len(take.readings[EMBODIMENT].time_s)
