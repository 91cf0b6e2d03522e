"""A SplatWorld on disk: a folder of world.json, scene.safetensors, world.edits.jsonl, world.undone.jsonl and README.md, and
what stops bodies, once it was computed (collider_file.py)."""

import functools
import hashlib
import io
import json
import os
import shlex
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, get_args

import torch
from safetensors import SafetensorError

from ..core.errors import CheckpointError, ContractError
from ..core.files import not_written
from ..space.camera import planar_pose
from ..space.edits import Edit, Edited, apply_edits, merged_boxes, merges_of
from ..space.enclosure import ColliderChoice, ColliderKind, in_free_space, kind_of_place
from ..space.files import replace_whole
from ..space.occupancy import Occupancy, Walker
from ..space.raster import Gaussians, rasterise
from .additions import INVENTED, OBSERVED
from .checkpoint import WORLD_FILE, data_file, read_data, write_checkpoint
from .collider_file import COLLIDER_FILE, EDITED_FILE
from .splat import SolidBoxes, SplatConfig, SplatWorld

KIND, VERSION = "splat", 1
FAR_M, NEARLY = 8.0, 0.8  # of the first views: how far they see, and the share of the best one's reach
MOST_ADDITIONS = 10_000_000
EDITS_FILE, UNDONE_FILE = "world.edits.jsonl", "world.undone.jsonl"  # edits in force; edits taken back, the newest last


def save_splat(world: SplatWorld, path: str | Path, keep_edits: bool = False) -> None:
    """Makes or replaces the folder as a whole. CheckpointError where something else lies there, or a world with edits, unless
    keep_edits: then they stay, as edits of the new world."""
    path = Path(path)
    if not keep_edits:
        check_free(path)
    about = {
        "kind": KIND, "version": VERSION, "name": world.name, "config": asdict(world.config), "card": dict(world.card),
    }  # fmt: skip
    tensors = {
        **vars(world.gaussians),
        "provenance": world.provenance,
        "starts": world.starts,
        "objects": world.objects,
        "solids": world.solids,
        "bodies": world.bodies,
    }
    about_it = f"A place of {len(world.gaussians):,} Gaussians"
    readme = f"# {world.name}\n\n{about_it}: `terrella play {shlex.quote(path.name)}` walks in it.\n"
    try:
        write_checkpoint(path, about, {"scene": tensors}, readme)
    except OSError as error:
        raise not_written(path, error) from error


def check_free(path: str | Path) -> None:
    """CheckpointError where a world of Gaussians would overwrite something else, or a world with edits."""
    path = Path(path)
    if not path.exists() or (path.is_dir() and not any(path.iterdir())):
        return
    try:
        known = json.loads((path / WORLD_FILE).read_text()).get("kind") == KIND
    except (OSError, ValueError, AttributeError):
        known = False
    if not known:
        raise CheckpointError(f"{path} holds something else already; give another --out.")
    if any((path / name).exists() and (path / name).stat().st_size for name in (EDITS_FILE, UNDONE_FILE)):
        raise CheckpointError(f"{path} has edits, which would be lost; give another --out, or remove its {EDITS_FILE}.")


def load_splat(path: str | Path, about: dict[str, Any], edits: Sequence[Edit] | None = None) -> SplatWorld:
    """Reads what `save_splat` wrote. about: its world.json; edits: in place of its own. CheckpointError where it or its own edits
    are foreign or damaged, ContractError where `edits` do not fit it."""
    path = Path(path)
    if about.get("version") != VERSION:
        raise CheckpointError(
            f"{path} has version {about.get('version')}, this release reads {VERSION}; update Terrella."
        )
    try:
        about, (tensors,) = read_data(path, about, "scene")
        settings: dict[str, Any] = {name: tuple(v) if isinstance(v, list) else v for name, v in about["config"].items()}
        config = SplatConfig(**{**settings, "body": Walker(**settings["body"])})
        if config.collider not in get_args(ColliderKind):
            raise ValueError(f"its collider {config.collider!r:.20} is unknown")
        provenance, starts = tensors.pop("provenance"), tensors.pop("starts")
        objects = tensors.pop("objects", torch.zeros(len(provenance), dtype=torch.int32))
        if about["card"].get("text") and not provenance.any():  # an older release marked all of what words built
            provenance = torch.full_like(provenance, OBSERVED)
        solids, bodies = tensors.pop("solids", None), tensors.pop("bodies", None)
        shapes = (
            provenance.shape == objects.shape == tensors["means"].shape[:1] and starts.shape[1:] == (7,) and len(starts)
        )
        if not shapes or not starts.isfinite().all() or not 0 <= config.additions <= MOST_ADDITIONS:
            raise ValueError("its parts do not fit one another")
        if solids is not None and (solids.shape[1:] != (6,) or not solids.isfinite().all()):
            raise ValueError("its solids are no boxes")
        if bodies is not None and (solids is None or bodies.shape != solids.shape[:1]):
            raise ValueError("its bodies are not those of its solids")
        world = SplatWorld(
            str(about["name"]), Gaussians(**tensors), provenance, starts, config, dict(about["card"]), objects,
            SolidBoxes.of(solids, bodies),
        )  # fmt: skip
    except (OSError, SafetensorError, LookupError, TypeError, ValueError, RuntimeError, ContractError) as error:
        raise CheckpointError(f"{path} is damaged or incomplete ({error}); make it again.") from error
    lines = read_edits(path) if edits is None else edits
    try:
        world = _after(world, lines, merged_loader(path)) if lines else world
    except (LookupError, TypeError, ValueError, AttributeError, RuntimeError, ContractError) as error:
        if edits is not None and isinstance(error, ContractError):
            raise
        kept = f"{path / EDITS_FILE} holds an edit that does not fit the place ({error}); mend or remove it."
        raise CheckpointError(kept) from error
    world.collider_file = path / (EDITED_FILE if lines else COLLIDER_FILE)
    return world


def _after(source: SplatWorld, edits: Sequence[Edit], other: Callable[[Edit], SplatWorld]) -> SplatWorld:
    """A world after edits."""
    after = apply_edits(source.gaussians, edits, source.objects, other)
    merged = [other(edit) for edit in merges_of(edits)]
    provenance = torch.cat([source.provenance, *(one.provenance for one in merged)])
    provenance = torch.where(after.origin < 0, INVENTED, provenance[after.origin]).to(torch.uint8)
    card, names, config = dict(source.card), source.object_names, source.config
    if len(source.solids):  # its boxes did not say how Gaussians close it; what was merged does
        kinds = (one.config.collider for one in merged if not len(one.solids) and one.config.collider != "object")
        config = replace(config, collider=next(kinds, config.collider))
    for lift, one in zip(after.raised, merged):
        names = [*names, *[""] * lift][:lift] + one.object_names
    return SplatWorld(
        source.name, after.gaussians, provenance, source.starts, config, {**card, "objects": names} if merged else card,
        after.objects, _solids(source, edits, merged, after),
    )  # fmt: skip


def _solids(
    source: SplatWorld, edits: Sequence[Edit], merged: Sequence[SplatWorld], after: Edited
) -> SolidBoxes | None:
    """Boxes and bodies after edits; None where edits moved what they describe, or a place has none: then Gaussians stop bodies."""
    solids, bodies = [source.solids], [source.bodies]
    for edit, one, lift in zip(merges_of(edits), merged, after.raised):
        boxes = merged_boxes(one.solids, edit)
        solids.append(torch.zeros(0, 6) if boxes is None else boxes)
        bodies.append(torch.where(one.bodies > 0, one.bodies + lift, 0).int())
    if len(merged) < len(edits) or not all(len(part) for part in solids):
        return None
    return SolidBoxes(torch.cat(solids), torch.cat(bodies))


def load_source(path: str | Path, edits: Sequence[Edit] | None = ()) -> SplatWorld:
    """The world as it was before all edits; None: after its own."""
    try:
        about = json.loads((Path(path) / WORLD_FILE).read_text())
        if about["kind"] != KIND:
            raise ValueError(f"it is of the kind {about['kind']}")
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise CheckpointError(f"{path} is no world of Gaussians ({error}); give the folder that holds one.") from error
    return load_splat(path, about, edits)


def merge_edit(path: Path, other: Path, by: Sequence[float] = (0, 0, 0), degrees: float = 0) -> Edit:
    """The edit that merges the world in the folder `other`, with its present edits, into that in `path`: turned by `degrees` to
    the left about the vertical through its origin, then moved `by` metres. ContractError for a place in itself."""
    path, other = path.resolve(), other.resolve()
    if path in _within(other):
        raise ContractError(f"{other.name} is {path.name} itself, or has it merged; --duplicate makes a second one.")
    try:
        place = Path(os.path.relpath(other, path))
    except ValueError:  # on another drive
        place = other
    return {"do": "merge", "place": place.as_posix(), "sha256": _digest(other), "by": list(by), "degrees": degrees}


def _within(path: Path) -> list[Path]:
    """The folders of a world and of all worlds merged into it."""
    return [path, *(one for edit in merges_of(read_edits(path)) for one in _within((path / edit["place"]).resolve()))]


def _digest(path: Path) -> str:
    """SHA-256 of a world's files; its edits hold those of merged worlds."""
    whole = hashlib.sha256()
    for file in (path / WORLD_FILE, data_file(path, "scene"), path / EDITS_FILE):
        with file.open("rb") if file.exists() or file.name != EDITS_FILE else io.BytesIO() as stream:
            whole.update(hashlib.file_digest(stream, "sha256").digest())
    return whole.hexdigest()


def merged_loader(path: str | Path) -> Callable[[Edit], SplatWorld]:
    """A function that opens the world that a merge of the one in `path` names, each once. CheckpointError where it is gone or was
    changed."""

    @functools.cache
    def opened(place: str, sha256: str) -> SplatWorld:
        folder = Path(os.path.normpath(Path(path).resolve() / place))
        try:
            fault = "" if _digest(folder) == sha256 else "was changed"
        except (OSError, CheckpointError):
            fault = "is not there"
        if fault:
            raise CheckpointError(
                f"{folder}, which {path} has merged, {fault}; put it back as it was, or take the merge back "
                f"(terrella space edit {shlex.quote(str(path))} --undo) and merge anew."
            )
        return load_source(folder, None)

    def other(edit: Edit) -> SplatWorld:
        place, sha256 = edit.get("place"), edit.get("sha256")
        if not isinstance(place, str) or not isinstance(sha256, str):
            raise ContractError(f"a merge names a `place` and its `sha256`; got {place!r:.40} and {sha256!r:.40}.")
        return opened(place, sha256)

    return other


def read_edits(path: Path, file: str = EDITS_FILE) -> list[Edit]:
    """The edits of a world, or with `file=UNDONE_FILE` those taken back, the oldest first. CheckpointError for damaged lines."""
    try:
        return parse_edits((path / file).read_text()) if (path / file).exists() else []
    except (OSError, ValueError, RecursionError) as error:
        raise CheckpointError(f"{path / file} is damaged ({error}); mend or remove it.") from error


def parse_edits(text: str) -> list[Edit]:
    """The edits in lines of JSON; ValueError for other lines."""
    edits = [json.loads(line) for line in text.splitlines() if line.strip()]
    if not all(isinstance(edit, dict) for edit in edits):
        raise ValueError("a line is no edit")
    return edits


def checked_edits(path: Path, text: str) -> list[Edit]:
    """The edits in lines of JSON, tried on the world in `path` without its edits; ContractError where they do not fit it."""
    source = load_source(path)
    try:
        edits = parse_edits(text)
        apply_edits(source.gaussians, edits, source.objects, merged_loader(path))
    except (ValueError, AttributeError, TypeError, RecursionError) as error:
        raise ContractError(f"these are no edits ({error}); give the lines of a world.edits.jsonl.") from error
    return edits


def write_edits(path: Path, edits: Sequence[Edit], undone: Sequence[Edit] = ()) -> None:
    """Replaces the edits of a world and those taken back. The file that gains an edit is written first: a crash loses none."""
    files = [(EDITS_FILE, edits), (UNDONE_FILE, undone)]
    if len(undone) > len(read_edits(path, UNDONE_FILE)):
        files.reverse()
    for name, lines in files:
        text = "".join(json.dumps(edit) + "\n" for edit in lines)
        replace_whole(path / name, lambda file, text=text: file.write_text(text))


def world_of(
    gaussians: Gaussians,
    name: str,
    card: dict[str, Any],
    config: SplatConfig,
    objects: torch.Tensor | None = None,
    solids: SolidBoxes | None = None,
    choice: ColliderChoice = "open",
) -> SplatWorld:
    """A world of Gaussians that starts at the free place with a floor that is nearest to `config.inside`, or else to their middle,
    in those of eight directions in which most is seen, the best first. choice: how the grid that stops bodies is closed; auto: as
    the place looks from the start."""
    observed = torch.full((len(gaussians),), OBSERVED, dtype=torch.uint8)
    world = SplatWorld(name, gaussians, observed, torch.zeros(1, 7), config, card, objects, solids)
    some = gaussians.means[:: max(len(gaussians) // 100_000, 1)]
    low, middle, high = torch.quantile(some, torch.tensor([0.05, 0.5, 0.95]), dim=0)
    rng = torch.Generator().manual_seed(0)
    high[2] += config.body.eye_m  # the eye may be above all Gaussians
    middle = middle if config.inside is None else torch.tensor(config.inside)
    places = torch.cat([middle[None], low + (high - low) * torch.rand(400, 3, generator=rng)])
    level = world.occupancy.surface(places, config.body)
    grounded = torch.cat([places[:, :2], (level + config.body.eye_m)[:, None]], 1)
    stands = level.isfinite() & ~world.collider.blocked(grounded.nan_to_num(), config.body)
    places = torch.where(stands[:, None], grounded, places)
    order = (places - middle).norm(dim=1) + 1e3 * ~stands
    x, y, z = places[order.argmin()].expand(8, 3).unbind(1)
    starts = planar_pose(x, y, z, torch.arange(8) * (torch.pi / 4))
    starts = starts[_open_ways(gaussians, starts)]
    config = replace(config, collider=chosen_collider(world.occupancy, starts, config, choice))
    return SplatWorld(name, gaussians, observed, starts, config, card, objects, solids)


def _open_ways(gaussians: Gaussians, poses: torch.Tensor) -> torch.Tensor:
    """The numbers of poses [P, 7] that see nearly as much as the best, which comes first: into the distance, up to FAR_M, and not
    into nothing."""
    with torch.no_grad():
        drawn = [rasterise(gaussians, pose[None], (0.5, 0.67, 0.5, 0.5), (48, 64)) for pose in poses]
    reach = torch.stack(
        [(one.depth / one.alpha.clamp_min(0.5)).clamp_max(FAR_M).mul(one.alpha >= 0.5).mean() for one in drawn]
    )
    order = reach.argsort(descending=True, stable=True)
    return order[reach[order] >= NEARLY * reach.max()]


def chosen_collider(
    occupancy: Occupancy, starts: torch.Tensor, config: SplatConfig, choice: ColliderChoice
) -> ColliderKind:
    """How the grid `occupancy` is closed. ContractError if `config.inside` is no point in free space within it."""
    if config.inside is not None and not in_free_space(occupancy, torch.tensor(config.inside)):
        point, (low, high) = " ".join(f"{one:g}" for one in config.inside), occupancy.bounds
        raise ContractError(
            f"--inside {point} is not in free space; give x y z in metres within {_corner(low)} and {_corner(high)}, z up, "
            "where nothing solid is."
        )
    if choice != "auto":
        return choice
    return kind_of_place(occupancy, starts[0, :3] if config.inside is None else torch.tensor(config.inside))


def _corner(point: torch.Tensor) -> str:
    return f"({', '.join(f'{one:.1f}' for one in point.tolist())})"
