"""Merges recordings into a LeRobot v3 folder, by a mapping file or one that is guessed."""

from __future__ import annotations

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
    """Merges the sources (path -> Source) into a new LeRobot v3 folder; returns (facts, the same for a person).

    mapping: the file to merge by; None to guess one and write it to OUT.toml, which must not be there yet.
    fps:     rows a second, before what the mapping says.
    dry:     stop when the mapping is written.

    The folder also has meta/merge.toml (the mapping), meta/merge.json (the report) and, in meta/terrella.json under
    "embodiments", each robot's statistics. Where merging fails or is stopped, neither it nor a guessed mapping is left.
    """
    out = Path(out)
    path = out.parent / f"{out.name}.toml" if mapping is None else Path(mapping)
    if mapping is None:
        if path.exists():
            raise DatasetError(f"{path} is there already: merge by it (--mapping {path}), or move it away.")
        found = propose(sources, fps)
        write_mapping(found, path)
    else:
        found = read_mapping(path)
        found = replace(found, rows=replace(found.rows, fps=float(fps))) if fps is not None else found
    check_mapping(found, sources)
    if dry:
        notes = {source.path: list(source.notes) for source in found.sources}
        said = [f"{source}: {note}" for source, some in notes.items() for note in some]
        return {"mapping": str(path), "notes": notes}, "\n".join(
            [*said, f"the mapping is {path}: edit it, then merge by it"]
        )
    report = MergeReport()
    terminal = all(_ends_without_action(sources[it.path], it, found) for it in found.sources)
    merged = merge(sources, found, report, out.name, terminal)

    def finish(folder: Path, notes: list[str]) -> None:
        about = json.loads((folder / WORLD).read_text(encoding="utf-8"))
        files.write_json(folder / WORLD, {**about, "embodiments": report.embodiments()})
        files.write_json(folder / "meta" / "merge.json", {**report.to_json(), "notes": notes})
        write_mapping(found, folder / "meta" / "merge.toml")

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
    """Whether nothing was done in the last row of its first take (which stands for all)."""
    take = next(iter(merge({source.path: origin}, replace(mapping, sources=(source,))).takes()), None)
    if take is None or ACTION not in take.readings:
        return True
    return len(take.readings[ACTION].time_s) < len(take.readings[EMBODIMENT].time_s)
