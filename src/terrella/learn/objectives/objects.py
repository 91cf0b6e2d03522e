"""Objects: a vocabulary of looks and moves of a recording's objects, and a model of which follows which."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F

from ...core.errors import DatasetError
from ...core.world import make_rng
from ...data import ClipCache
from ...space.billboards import cut_out
from ...space.camera import Intrinsics, project
from ...worlds.objects import (
    LOOK,
    NONE,
    NUMBER,
    PLACE,
    Billboards,
    look_features,
    nearest_look,
    new_billboards,
    update_billboards,
)
from ..feeds import RandomBatches
from ..learners import adamw, warmup_cosine
from ..recording import INSTANCES, OBJECTS, Recording
from ..train_step import TrainStep
from ..trainer import CPU, Loss, Report, Run, Trainer

CLEAR, LARGE = (
    0.0008,
    0.016,
)  # shares of a frame from which an object's look is classified, and from which it may exemplify one
FORGETS = 8  # steps without a clear view after which an object's last look no longer counts
TWICE = 2  # observed transitions from one look to another below which they count as mistakes
SELDOM = 4  # sightings below which a cluster is no look
UPRIGHT_M = 1.0  # height of an object that may be an obstacle
BODY_M, FEWEST = 0.4, 1000  # metres of distance and number of sightings below which no object is an obstacle
NEVER_M = 1e3  # height of the boxes of unused looks
WAITS = 300  # steps from an episode's beginning in which objects are searched that were there from the start
SAME_M, OFTEN = 1.5, 0.08  # metres within which, and share of episodes in which, such an object is the same one
LASTS = 15  # steps in which such an object must have been seen
CHUNK = 1.5e6  # pixels of frames that are cut out at once
WITHOUT = ", or train without (train video --objects-steps 0)"


class Sightings(NamedTuple):
    """n objects in frames: frame and row of its object table [n]; marks [n, D] (worlds/objects.py) and box [n, 4]; share [n] of the
    frame's pixels; whole [n], whether all of it is visible. clear [m]: indices of those that may exemplify a look, and their
    pictures uint8 [m, 4, *PICTURE]."""

    frame: np.ndarray
    row: np.ndarray
    marks: torch.Tensor
    box: torch.Tensor
    share: np.ndarray
    whole: np.ndarray
    clear: np.ndarray
    picture: torch.Tensor


class Tokens(NamedTuple):
    """n observed transitions: billboards [n, COLUMNS], and the camera pose [n, 7] a step later; the next look [n] (NONE: unknown)
    and move [n], and whether the object was gone [n]; acts [n, history], rows of the last actions (-1: none)."""

    billboards: torch.Tensor
    pose: torch.Tensor
    look: torch.Tensor
    move: torch.Tensor
    gone: torch.Tensor
    acts: np.ndarray


def learn_objects(
    run: Run,
    objects: Billboards,
    recording: Recording,
    rgb: Callable[[np.ndarray], np.ndarray],
    starts: torch.Tensor,
    camera: Intrinsics,
    steps: int,
) -> dict:
    """Trains `objects` in place; `rgb(rows)` gives pictures uint8 [n, h, w, 3] at the size of the recording. Each of the poses
    `starts` [S, 7] gets the billboards that were there at the start of the recorded episodes nearest to it. Returns facts."""
    seed, report = run.seed, run.report
    cache, rows = recording.cache, np.flatnonzero(recording.usable)
    seen = _cut(cache, rgb, rows, camera, report)
    if not len(seen.clear):
        raise DatasetError(f"the recording shows no thing whole and near: record more of them{WITHOUT}.")
    heads, off = _looks(seen, objects.config.looks, seed)
    objects.pictures[: len(heads)] = seen.picture[heads]
    objects.boxes[:] = NEVER_M
    objects.boxes[: len(heads)] = seen.box[seen.clear[heads]]
    moves = _moves(cache, rows, objects.config.moves, seed)
    objects.moves[: len(moves)] = moves
    known = _classified(off, seen, cache)
    tokens, waiting = _transitions(objects, recording, seen, known, camera)
    objects.solid[:] = _reach(objects, tokens)
    objects.follows[:] = _follows(objects, tokens)
    begun = [first for first, _ in cache.episodes if recording.usable[first]]
    for episode, start in enumerate(starts if begun else []):
        off = (recording.pose(begun) - start).norm(dim=1)
        billboards = _shared_starts([waiting[begun[at]] for at in (off <= off.min() + 0.05).nonzero()[:, 0]])
        for row, billboard in enumerate(billboards[: objects.config.rows]):
            objects.begun[episode, row] = billboard
    objective = ObjectsObjective(objects, tokens, recording)
    trainer = Trainer(run, "objects", RandomBatches(objective.sample), objective, steps, device=CPU)
    trainer.train()
    objects.eval()
    facts = {"objects_frames": len(rows), "objects_looks": len(heads), "objects_moves": len(moves) - 1}
    return {**facts, "objects_steps": trainer.facts["step"]}


def object_table(cache: ClipCache) -> np.ndarray:
    """float32 [N, K, 4]: number and place of each thing of each row."""
    return np.asarray(cache.arrays[OBJECTS], np.float32).reshape(cache.length, -1, 4)


def _cut(cache: ClipCache, rgb, rows: np.ndarray, camera: Intrinsics, report: Report) -> Sightings:
    parts, chunk = [], max(1, int(CHUNK / np.prod(cache.arrays[INSTANCES].shape[1:])))
    for first in range(0, len(rows), chunk):
        some = rows[first : first + chunk]
        frames = torch.from_numpy(np.ascontiguousarray(rgb(some))).permute(0, 3, 1, 2)
        instances = torch.from_numpy(np.asarray(cache.arrays[INSTANCES][some]))
        depth, pose = (torch.from_numpy(np.asarray(array[some], np.float32)) for array in (cache.depth, cache.pose))
        cut = cut_out(frames, instances, depth, torch.from_numpy(object_table(cache)[some, :, 1:]), pose, camera)
        share = cut.pixels / (frames.shape[2] * frames.shape[3])
        clear = cut.whole & (share >= LARGE)
        picture = (cut.picture[clear] * 255).round().clamp(0, 255).byte()
        frame = torch.from_numpy(some)[cut.view]
        parts.append((frame, cut.row, look_features(cut.picture, cut.box), cut.box, share, cut.whole, clear, picture))
        if first // chunk % 16 == 0:
            report(first / len(rows), 1.0, "cutting out objects")
    frame, row, marked, box, share, whole, clear, picture = map(torch.cat, zip(*parts))
    shares = share.numpy(), whole.numpy(), clear.numpy().nonzero()[0]
    return Sightings(frame.numpy(), row.numpy(), marked, box, *shares, picture)


def _looks(seen: Sightings, count: int, seed: int) -> tuple[np.ndarray, torch.Tensor]:
    """For each look the clear sighting that exemplifies it [looks], and the distance of every sighting to each [n, looks].
    Looks are k-means clusters, each exemplified by the largest of the half nearest to its centre."""
    rng, some = np.random.default_rng(seed), np.arange(len(seen.clear))
    some = some if len(some) <= 12000 else np.sort(rng.choice(some, 12000, replace=False))
    known = seen.marks[seen.clear[some]]
    centres = _means(known, count, seed)
    off, nearest = torch.cdist(known, centres).min(1)
    heads = []
    for look in range(len(centres)):
        mine = (nearest == look).nonzero()[:, 0]
        if len(mine) >= SELDOM:
            typical = some[mine[off[mine].argsort()[: max(SELDOM, len(mine) // 2)]].numpy()]
            heads.append(typical[seen.share[seen.clear[typical]].argmax()])
    heads = np.array(heads if heads else some[:1])
    shown = seen.marks[seen.clear[heads]]
    return heads, torch.cat([torch.cdist(part, shown) for part in seen.marks.split(4096)])


def _classified(off: torch.Tensor, seen: Sightings, cache: ClipCache) -> np.ndarray:
    """The look of each sighting [n], from its distances `off` [n, looks]; NONE if it is like none or not clearly visible."""
    episode = np.searchsorted([first for first, _ in cache.episodes], seen.frame, side="right")
    numbers, clear = object_table(cache)[seen.frame, seen.row, 0], seen.whole & (seen.share >= CLEAR)
    look, last = np.full(len(off), NONE), {}
    for one in np.argsort(seen.frame, kind="stable"):
        if not clear[one]:
            continue
        thing = episode[one], numbers[one]
        before, was = last.get(thing, (NONE, NONE))
        look[one] = nearest_look(off[one], was if seen.frame[one] - before <= FORGETS else NONE)
        if look[one] != NONE:
            last[thing] = seen.frame[one], look[one]
    return look


def _follows(objects: Billboards, tokens: Tokens) -> torch.Tensor:
    """bool [looks + 1, looks]: whether a look may follow another; each follows itself, and those that it was seen to follow."""
    looks, known = objects.config.looks, tokens.look != NONE
    pair = (tokens.billboards[known, LOOK].long() + 1) * looks + tokens.look[known]
    seen = torch.bincount(pair, minlength=(looks + 1) * looks).view(looks + 1, looks) >= TWICE
    seen[0] = objects.boxes[:, 3] < NEVER_M
    return seen | torch.cat([torch.zeros(1, looks), torch.eye(looks)]).bool()


def _reach(objects: Billboards, tokens: Tokens) -> torch.Tensor:
    """The distance [looks], along x or y in metres, to which a camera can approach upright objects: the smallest one recorded
    (its 0.2% quantile); 0 for low objects, and for all if the camera passed through them."""
    look = tokens.billboards[:, LOOK].long()
    upright = (objects.boxes[:, 3] >= UPRIGHT_M) & (objects.boxes[:, 3] < NEVER_M)
    off = (tokens.billboards[:, PLACE] - tokens.pose[:, :3])[:, :2].abs().amax(1)
    near = off[(look != NONE) & upright[look.clamp_min(0)]]
    reach = float(near.quantile(0.002)) if len(near) >= FEWEST else 0.0
    return torch.where(upright, reach if reach > BODY_M else 0.0, 0.0)


def _moves(cache: ClipCache, rows: np.ndarray, count: int, seed: int) -> torch.Tensor:
    """The moves [m, 3] of objects in a step, in metres, by k-means; the first is no move."""
    things = object_table(cache)
    follows = rows[:-1][np.diff(rows) == 1]
    follows = follows[~np.isin(follows + 1, [first for first, _ in cache.episodes])]
    number, later = things[follows, :, 0], things[follows + 1, :, 0]
    same = (number[:, :, None] == later[:, None]) & (number > 0)[:, :, None]
    index, slot, after = same.nonzero()
    steps = things[follows[index] + 1, after, 1:] - things[follows[index], slot, 1:]
    length = np.linalg.norm(steps, axis=1)
    steps = torch.from_numpy(steps[(length > 1e-3) & (length < 2)])
    steps = steps[torch.randperm(len(steps), generator=make_rng(seed))[:20000]]
    return torch.cat([torch.zeros(1, 3), _means(steps, count - 1, seed) if len(steps) else steps])


def _means(points: torch.Tensor, count: int, seed: int) -> torch.Tensor:
    """k-means of points [n, D], initialised by k-means++: at most [count, D]."""
    rng = make_rng(seed)
    picks = [int(torch.randint(len(points), (1,), generator=rng))]
    gap = (points - points[picks[0]]).square().sum(1)
    while len(picks) < min(count, len(points)) and float(gap.max()) > 1e-9:
        picks.append(int(torch.multinomial(gap, 1, generator=rng)))
        gap = torch.minimum(gap, (points - points[picks[-1]]).square().sum(1))
    centres = points[picks]
    for _ in range(12):
        nearest = torch.cdist(points, centres).argmin(1)
        sums = torch.zeros_like(centres).index_add_(0, nearest, points)
        counts = torch.bincount(nearest, minlength=len(centres))[:, None]
        centres = torch.where(counts > 0, sums / counts.clamp_min(1), centres)
    return centres


def _transitions(
    objects: Billboards, recording: Recording, seen: Sightings, known: np.ndarray, camera: Intrinsics
) -> tuple[Tokens, dict[int, list[torch.Tensor]]]:
    """The transitions, from the looks `known` [n] of the sightings; and, by the first row of each episode, the billboards that were
    there from the start. Billboards are updated row by row as in a rollout."""
    cache, back = recording.cache, np.arange(objects.config.history)[::-1]
    things, poses = torch.from_numpy(object_table(cache).copy()), torch.from_numpy(np.array(cache.pose, np.float32))
    looks, share = torch.full(things.shape[:2], float(NONE)), np.zeros(things.shape[:2])
    looks[seen.frame, seen.row] = torch.from_numpy(known).float()
    share[seen.frame, seen.row] = seen.share
    steps: list[tuple] = []  # a billboard, the row after, its look, place and end there, and rows of the last actions
    waiting: dict[int, list[torch.Tensor]] = {}
    for first, stop in cache.episodes:
        were: dict[float, torch.Tensor] = {}  # billboards by number, and the row of the list in which each was
        slots: dict[float, int] = {}
        met: dict[float, _Met] = {}
        for row in range(first, stop):
            here = {}
            if recording.usable[row]:
                here = {float(number): slot for slot, number in enumerate(things[row, :, 0]) if number > 0}
                lost = [n for n in were if n not in here and share[row - 1, slots[n]] >= 2 * CLEAR]
                led = np.where(row - 1 - back >= first, row - 1 - back, -1)
                for number in (n for n in here if n in were):
                    slot = here[number]
                    steps.append((were[number], row, looks[row, slot], things[row, slot, 1:], False, led))
                for number in _in_sight(lost, were, poses[row], camera):
                    steps.append((were[number], row, torch.tensor(float(NONE)), were[number][PLACE], True, led))
            now = {}
            for number, slot in here.items():
                old, look, place = were.get(number), looks[row, slot], things[row, slot, 1:]
                if old is None:
                    now[number] = new_billboards(number, place, look)
                else:
                    now[number] = update_billboards(
                        old[None], place[None], torch.where(look == NONE, old[LOOK], look)[None]
                    )[0]
                if number not in met and row < first + WAITS:
                    born = row > first and _open(now[number], row - 1, cache, camera)
                    met[number] = _Met(now[number].clone(), born)
                if number in met:
                    met[number].again(look)
            were, slots = now, here
        waiting[first] = [one.billboard for one in met.values() if one.waited]
    if not steps:
        raise DatasetError(f"the recording shows no thing in two frames that follow each other{WITHOUT}.")
    before, at, look, place, gone, acts = zip(*steps)
    way = torch.stack(place) - torch.stack(before)[:, PLACE]
    move = torch.cdist(way, objects.moves).argmin(1)
    move[way.norm(dim=1) <= 1e-3] = 0
    follows = torch.stack(look).long(), move, torch.tensor(gone), np.stack(acts)
    return Tokens(torch.stack(before), poses[list(at)], *follows), waiting


@dataclass
class _Met:
    """An object of an episode: its billboard when it was first seen, and whether it appeared in view."""

    billboard: torch.Tensor
    born: bool
    often: int = 0

    def again(self, look: torch.Tensor) -> None:
        self.often += 1
        if self.billboard[LOOK] == NONE:
            self.billboard[LOOK] = look

    @property
    def waited(self) -> bool:
        """Whether it was there from the start of the episode."""
        return self.often >= LASTS and not self.born and bool(self.billboard[LOOK] != NONE)


def _shared_starts(episodes: list[list[torch.Tensor]]) -> list[torch.Tensor]:
    """The billboards [COLUMNS] that were there at the start of `episodes` which began alike: those of one place count as one, and
    the most frequent come first. No episode sees all of them."""
    groups: list[list[torch.Tensor]] = []
    for billboard in (one for billboards in episodes for one in billboards):
        same = [group for group in groups if (group[0] - billboard)[PLACE].norm() < SAME_M]
        if same:
            same[0].append(billboard)
        else:
            groups.append([billboard])
    often = sorted((group for group in groups if len(group) >= OFTEN * len(episodes)), key=len, reverse=True)
    first = [group[0].clone() for group in often]
    for number, billboard in enumerate(first):
        billboard[NUMBER] = number + 1
    return first


def _in_sight(numbers: list[float], billboards: dict[float, torch.Tensor], pose: torch.Tensor, camera: Intrinsics):
    """Those of `numbers` whose billboards project well into the frame from `pose` [7]."""
    if not numbers:
        return []
    where, ahead = project(torch.stack([billboards[number][PLACE] for number in numbers]), pose, camera)
    seen = ((where[:, 0] - 0.5).abs() < 0.35) & (ahead > 0.5)
    return [number for number, is_seen in zip(numbers, seen.tolist()) if is_seen]


def _open(billboard: torch.Tensor, row: int, cache: ClipCache, camera: Intrinsics) -> bool:
    """Whether the place of `billboard`, a little above the ground, was not occluded at `row`."""
    pose = torch.from_numpy(np.array(cache.pose[row], np.float32))
    where, ahead = project(billboard[None, PLACE] + torch.tensor([0, 0, 0.3]), pose, camera)
    (u, v), far = where[0].tolist(), float(ahead[0])
    if far < 0.3 or not (0 < u < 1 and 0 < v < 1):
        return False
    height, width = cache.depth.shape[1:]
    return float(cache.depth[row, int(v * height), int(u * width)]) > far - 0.5


class ObjectsObjective:
    """The likelihood of an object's next look, its move and its end. Half of each batch are transitions in which something happens;
    importance weights keep the probabilities of rare events unbiased."""

    def __init__(self, objects: Billboards, tokens: Tokens, recording: Recording, batch: int = 512):
        self.objects, self.tokens, self.size = objects, tokens, batch
        look = tokens.look
        happens = ((look != NONE) & (look != tokens.billboards[:, LOOK])) | (tokens.move > 0) | tokens.gone
        often = torch.where(happens, 0.5 / happens.float().mean().clamp_min(1e-3), 0.5)
        self.often = often / often.sum()
        self.actions = recording.action(np.maximum(tokens.acts, 0).ravel()).view(*tokens.acts.shape, -1)
        self.actions[torch.from_numpy(tokens.acts < 0)] = 0
        self.modules = {"objects": objects}
        self.learners = {"objects": adamw((objects,), warmup_cosine(2e-3, 100, 0.02), decay=1e-2, betas=(0.9, 0.999))}

    def sample(self, now: TrainStep) -> torch.Tensor:
        return torch.multinomial(self.often, self.size, replacement=True, generator=now.noise)

    def losses(self, batch: torch.Tensor, now: TrainStep) -> Iterator[Loss]:
        weight = 1 / len(self.often) / self.often[batch]
        billboards, pose, look, move, gone = (part[batch] for part in self.tokens[:5])
        logits = self.objects.next_logits(billboards, pose, self.actions[batch])
        possible = (look != NONE) & self.objects.follows[billboards[:, LOOK].long() + 1, look.clamp_min(0)]
        error = F.cross_entropy(logits.look, look.clamp_min(0), reduction="none").where(possible, 0.0)
        error = error + F.cross_entropy(logits.move, move, reduction="none") * ~gone
        error = error + F.binary_cross_entropy_with_logits(logits.gone, gone.float(), reduction="none")
        loss = (weight * error).mean()
        yield Loss("objects", loss, {"objects": loss})
