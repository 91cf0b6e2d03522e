"""What latent actions are good for: labelling a recording with codes, mapping keys to codes, and how far to trust them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from ..core.errors import DatasetError
from ..data import ClipCache, Dataset, Readings, Sensor, Source, Take, split
from ..data.source import is_action
from ..exchange import write_source
from ..space.camera import yaw
from .latent_actions import LatentModel, frames_at, load_latent, pair_rows, pictures
from .updates import Report

ROLLED = 4  # predictions in a row, for the figure over several steps
CLIP = 16  # rows of the clips over which intervals are drawn


def infer_codes(model: LatentModel, cache: ClipCache, rows: np.ndarray) -> np.ndarray:
    """Codes int64 [n] of the motion from each of `rows` to `stride` rows later."""
    found = [
        model.infer(frames_at(cache, some), frames_at(cache, some + model.config.stride))
        for some in np.array_split(rows, max(1, -(-len(rows) // 256)))
    ]
    return torch.cat(found).numpy()


# -- label ----------------------------------------------------------------------------------------------------------


def label(
    run: str | Path, data: str | Path, out: str | Path, report: Report, keys: KeyMap | None = None, device: str = "auto"
) -> dict:
    """Writes a copy of a recording to the new folder `out`, whose action is the inferred code, so that any training that reads
    recordings makes a world of it that is played with codes. An action has a number, 0 or 1, for each code but the
    stillest, which is what happens while no key is held. Actions that were recorded are left out; the digits 1, 2, ...
    stand for codes (and so do the keys of the recorded world, where `keys` says which code an action is).

    The code of a row is that of the motion over the next `stride` rows; near an episode's end, that of its last ones.
    """
    model = load_latent(run, device)
    cache, dataset = pictures(data, model.config.size, report), Dataset(data)
    stride, codes = model.config.stride, model.config.codes
    source = dataset.source()
    still = stillest(model, cache)
    buttons = np.delete(np.eye(codes, dtype=np.float32), still, 1)
    short = [number for number, (first, stop) in enumerate(cache.episodes) if stop - first <= stride]
    if short:
        raise DatasetError(f"episode {short[0]} of {data} has no more than {stride} rows: too few to tell a motion.")

    def take(number: int, told: Take) -> Take:
        first, stop = cache.episodes[number]
        rows = np.minimum(np.arange(first, stop - 1), stop - 1 - stride)
        onehot = buttons[infer_codes(model, cache, rows)]
        kept = {name: readings for name, readings in told.readings.items() if not is_action(name)}
        report(number + 1, len(cache.episodes), "labelling")
        return replace(told, readings={**kept, "action": Readings(dataset.time_s(number)[:-1], onehot)})

    names = tuple(f"code_{code + 1}" for code in range(codes) if code != still)
    sensors = {name: sensor for name, sensor in source.sensors.items() if not is_action(name)}
    sensors["action"] = Sensor("action", "vector", (codes - 1,), names=names)
    world = {key: value for key, value in dataset.world.items() if key != "action_space"}
    world |= {"name": f"{dataset.world.get('name', dataset.name)}, latent actions", "dt_s": 1 / dataset.fps}
    world |= {"action_names": list(names), "discrete": False, "keys": _keys_of_codes(buttons, dataset, keys)}
    labelled = Source(
        source.name,
        sensors,
        lambda: (take(number, told) for number, told in enumerate(source.takes())),
        source.fps,
        source.robot,
        source.notes,
        {**source.facts, "world": world, "latent_actions": {"codes": codes, "stride": stride, "still": still + 1}},
    )
    notes = write_source(labelled, out, "lerobot", _rows(dataset))
    return {"dataset": str(out), "codes": codes, "still": still + 1, "frames": cache.length, "notes": notes}


def _rows(dataset: Dataset):
    """Pictures as they were kept: exact ones stay exact."""
    from ..exchange.formats.lerobot import Rows

    exact = dataset.features[dataset.rgb_key or ""]["dtype"] == "image"
    return Rows(pictures="png" if exact else "video")


def stillest(model: LatentModel, cache: ClipCache) -> int:
    """The code that moves least what is seen, over 32 frames of a recording."""
    before = frames_at(cache, np.linspace(0, cache.length - 1, 32).astype(int))
    codes = range(model.config.codes)
    flows = [model.predict(before, torch.full((32,), code))[1].norm(dim=1).mean() for code in codes]
    return int(torch.stack(flows).argmin())


def _keys_of_codes(buttons: np.ndarray, dataset: Dataset, keys: KeyMap | None) -> dict[str, list[float]]:
    """Browser keys -> actions, rows of `buttons` [K, K - 1]."""
    found = {f"Digit{code + 1}": buttons[code].tolist() for code in range(min(len(buttons), 9)) if buttons[code].any()}
    if keys is not None and set(keys.names) <= set(dataset.action_names):
        columns = [dataset.action_names.index(name) for name in keys.names]
        for key, action in dataset.world.get("keys", {}).items():
            code = keys.code_of(np.asarray(action, np.float32).reshape(-1)[columns])
            if code is not None:
                found[key] = buttons[code].tolist()
    return found


# -- keys -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class KeyMap:
    """Which recorded action each code stands for, as a few labelled frames say, and how often that is right elsewhere.

    names:      the numbers of an action that were mapped.
    actions:    float32 [K, A]: what was most often recorded where code k was inferred.
    pairs:      recorded action -> the code that was most often inferred where it was recorded.
    used:       labelled frames.
    tested:     held-out frames.
    accuracy:   share of held-out frames whose whole action (all of `names`) is that of their code.
    steady:     the same over the frames in which the action does not change while the code's motion lasts.
    commonest:  share that the commonest action alone would get right.
    each:       per name, the share of held-out frames in which that number alone is right.
    """

    names: tuple[str, ...]
    actions: np.ndarray
    pairs: dict[tuple[float, ...], int]
    used: int
    tested: int
    accuracy: float
    steady: float
    commonest: float
    each: dict[str, float]

    def code_of(self, action: np.ndarray) -> int | None:
        """The code for the numbers `names` of an action; None where they were never seen together."""
        return self.pairs.get(tuple(float(number) for number in np.asarray(action).reshape(-1)))


def map_keys(
    run: str | Path,
    data: str | Path,
    report: Report,
    frames: int = 200,
    names: Sequence[str] = (),
    test: str | Path | None = None,
    seed: int = 0,
    device: str = "auto",
) -> KeyMap:
    """Maps recorded actions to codes by `frames` labelled frames in clips of 10 from the training episodes of `data`, and tests
    the map on its held-out episodes, or on the whole of the recording `test`.

    names: of the action's numbers, those that are mapped together (("TURN_LEFT", "TURN_RIGHT") for turning alone); all
    without. DatasetError where the recording has no actions, or too few.
    """
    model = load_latent(run, device)
    cache = pictures(data, model.config.size, report)
    train, held_out = split(len(cache.episodes))
    exam = cache if test is None else pictures(test, model.config.size, report)
    chosen = _columns(cache, names, data)
    clips = _clips(pair_rows(cache, train, model.config.stride), 10)
    if len(clips) * 10 < frames or frames < 1:
        raise DatasetError(f"{data} has {len(clips) * 10} rows with actions to label, not {frames}; ask for fewer.")
    order = np.random.default_rng(seed).permutation(len(clips))[: -(-frames // 10)]
    rows = np.concatenate([clips[i] for i in order])[:frames]
    told, code = _told(cache, rows, chosen), infer_codes(model, cache, rows)
    common = _commonest(told)
    actions = np.stack(
        [_commonest(told[code == k]) if (code == k).any() else common for k in range(model.config.codes)]
    )
    kinds, which = np.unique(told, axis=0, return_inverse=True)
    which = which.reshape(-1)
    pairs = {tuple(kind.tolist()): int(np.bincount(code[which == i]).argmax()) for i, kind in enumerate(kinds)}
    tested = pair_rows(exam, held_out if test is None else list(range(len(exam.episodes))), model.config.stride)
    if not len(tested):
        raise DatasetError(f"{test or data} has no held-out frames to test keys on; record two episodes or more.")
    chosen = _columns(exam, names, test or data)
    truth, guess = _told(exam, tested, chosen), actions[infer_codes(model, exam, tested)]
    steady = np.ones(len(tested), bool)
    for later in range(1, model.config.stride):
        steady &= (_told(exam, tested + later, chosen) == truth).all(1)
    right = truth == guess
    return KeyMap(
        tuple(cache.action_names[i] for i in chosen),
        actions,
        pairs,
        len(rows),
        len(tested),
        float(right.all(1).mean()),
        float(right.all(1)[steady].mean()),
        float((truth == common).all(1).mean()),
        {cache.action_names[i]: float(right[:, at].mean()) for at, i in enumerate(chosen)},
    )


def _columns(cache: ClipCache, names: Sequence[str], data: str | Path) -> list[int]:
    if cache.action is None or not cache.action_names:
        raise DatasetError(f"{data} has no recorded actions; keys are mapped by a few labelled clips.")
    unknown = sorted(set(names) - set(cache.action_names))
    if unknown:
        raise DatasetError(f"{data} has no action '{unknown[0]}'; it has {', '.join(cache.action_names)}.")
    return [cache.action_names.index(name) for name in names] if names else list(range(len(cache.action_names)))


def _clips(rows: np.ndarray, length: int) -> list[np.ndarray]:
    """Runs of `length` rows that follow each other."""
    breaks = np.flatnonzero(np.diff(rows) != 1) + 1
    return [run[at : at + length] for run in np.split(rows, breaks) for at in range(0, len(run) - length + 1, length)]


def _told(cache: ClipCache, rows: np.ndarray, columns: list[int]) -> np.ndarray:
    return np.asarray(cache.action[rows], np.float32)[:, columns]


def _commonest(actions: np.ndarray) -> np.ndarray:
    kinds, counts = np.unique(actions, axis=0, return_counts=True)
    return kinds[counts.argmax()]


# -- how far to trust them ---------------------------------------------------------------------------------------------


def examine_latent(
    run: str | Path, data: str | Path, report: Report, whole: bool = False, seed: int = 0, device: str = "auto"
) -> dict:
    """What the codes are worth on the held-out episodes of a recording (`whole`: on all of another one).

    psnr_db:  of the frame `stride` rows on, predicted with the inferred code, with a random one, and by copying; and the
              difference of the first two with its 95 % interval (bootstrap over clips of 16 rows). `rolled`: the same
              after four predictions in a row, each from the one before.
    codes:    per code, the share of frames; `drawn_px`, the mean motion that the model gives it, in pixels, x to the right and
              y down; `seen_px`, the median motion that the pictures themselves show where it was inferred (their phase
              correlation, which knows nothing of the model), and `agreement`, the share of frames within 2 pixels of it.
              With poses, `turn_deg` and `ahead_m`: mean and standard deviation of the recorded motion.
    explained: with poses, the share of the variance of turn and advance that the code explains.
    actions:  with actions, `purity` (share of frames that have the commonest action of their code), `commonest` (of all)
              and `information`, mutual over the entropy of the actions. Neither is used in training.
    """
    model = load_latent(run, device)
    cache, stride, codes = pictures(data, model.config.size, report), model.config.stride, model.config.codes
    episodes = list(range(len(cache.episodes))) if whole else split(len(cache.episodes))[1]
    rows = pair_rows(cache, episodes, stride)
    long = pair_rows(cache, episodes, stride * ROLLED)
    if not len(long):
        raise DatasetError(f"{data} has no held-out episode of {stride * ROLLED + 1} rows; record two or more.")
    code = infer_codes(model, cache, rows)
    of_row = dict(zip(rows.tolist(), code))
    rng = np.random.default_rng(seed)
    clips = _clips(long, min(CLIP, len(long)))
    clips = [clips[i] for i in np.sort(rng.permutation(len(clips))[:128])]  # 2,048 frames are enough
    inferred, random, copied, flows = [], [], [], []
    for number, clip in enumerate(clips):
        steps = [np.array([of_row[row + stride * step] for row in clip]) for step in range(ROLLED)]
        true, flow = _rolled(model, cache, clip, steps)
        inferred.append(true)
        random.append(_rolled(model, cache, clip, [rng.integers(codes, size=len(clip)) for _ in steps])[0])
        first = frames_at(cache, clip)
        copied.append([_psnr(first, frames_at(cache, clip + stride * (step + 1))) for step in range(ROLLED)])
        flows.append((steps[0], flow, shown_shift(first, frames_at(cache, clip + stride))))
        report(number + 1, len(clips), "examining")
    better = np.array([[a - b for a, b in zip(x, y)] for x, y in zip(inferred, random)])  # [clips, ROLLED, CLIP]
    found: dict = {"frames": len(rows), "stride": stride}
    for name, step in (("psnr_db", 0), ("rolled", ROLLED - 1)):
        found[name] = {
            "inferred": float(np.mean([clip[step] for clip in inferred])),
            "random": float(np.mean([clip[step] for clip in random])),
            "copied": float(np.mean([clip[step] for clip in copied])),
            "difference": float(better[:, step].mean()),
            "interval": _interval(better[:, step].mean(1), rng),
        }
    which, drawn, seen = (np.concatenate(parts) for parts in zip(*flows))
    found["codes"] = [_of_code(float((code == k).mean()), drawn[which == k], seen[which == k]) for k in range(codes)]
    if cache.pose is not None:
        moved = _moved(cache, rows, stride)
        for k in range(codes):
            for name, values in moved.items():
                mine = values[code == k]
                found["codes"][k][name] = [float(mine.mean()), float(mine.std())] if len(mine) else None
        found["explained"] = {name: _explained(values, code, codes) for name, values in moved.items()}
    if cache.action is not None and cache.action_names:
        found["actions"] = agreement(np.asarray(cache.action[rows]), code)
    return found


def _rolled(model: LatentModel, cache: ClipCache, clip: np.ndarray, codes: list[np.ndarray]):
    """PSNR of each frame of a clip after 1, 2, ... predictions, and the mean flow [n, 2] in pixels of the first one."""
    frame, quality, flow = frames_at(cache, clip), [], None
    for step, code in enumerate(codes):
        frame, moved = model.predict(frame, torch.from_numpy(np.asarray(code)))
        flow = moved.mean((2, 3)).neg().numpy() if flow is None else flow  # from where it comes -> where it goes
        quality.append(_psnr(frame, frames_at(cache, clip + model.config.stride * (step + 1))))
    return quality, flow


def _psnr(a: torch.Tensor, b: torch.Tensor) -> np.ndarray:
    """Of each frame, in dB; 60 where they are all but equal."""
    return -10 * (a - b).square().mean((1, 2, 3)).clamp_min(1e-6).log10().numpy()


def _interval(values: np.ndarray, rng: np.random.Generator) -> list[float]:
    means = values[rng.integers(len(values), size=(2000, len(values)))].mean(1)
    return [float(edge) for edge in np.percentile(means, (2.5, 97.5))]


def _of_code(share: float, drawn: np.ndarray, seen: np.ndarray) -> dict:
    if not len(drawn):
        return {"share": share}
    usual = np.median(seen, axis=0)
    near = np.linalg.norm(seen - usual, axis=1) <= 2
    return {
        "share": share,
        "drawn_px": drawn.mean(0).tolist(),
        "seen_px": usual.tolist(),
        "agreement": float(near.mean()),
    }


def shown_shift(before: torch.Tensor, after: torch.Tensor) -> np.ndarray:
    """By how many whole pixels (x to the right, y down) most of what `before` [B, 3, H, W] shows lies elsewhere in `after`:
    int64 [B, 2], the peak of their phase correlation."""
    height, width = before.shape[-2:]
    window = torch.hann_window(height, periodic=False)[:, None] * torch.hann_window(width, periodic=False)
    one, two = (
        torch.fft.rfft2((grey - grey.mean((1, 2), keepdim=True)) * window) for grey in (before.mean(1), after.mean(1))
    )
    cross = two * one.conj()
    alike = torch.fft.irfft2(cross / cross.abs().clamp_min(1e-6), (height, width)).flatten(1).argmax(1)
    y, x = alike // width, alike % width
    return torch.stack([(x + width // 2) % width - width // 2, (y + height // 2) % height - height // 2], 1).numpy()


def _moved(cache: ClipCache, rows: np.ndarray, stride: int) -> dict[str, np.ndarray]:
    """Turn to the left in degrees and advance in metres from `rows` to `stride` rows later, as recorded."""
    assert cache.pose is not None
    before, after = (torch.from_numpy(np.array(cache.pose[some])).double() for some in (rows, rows + stride))
    heading, turned = yaw(before), yaw(after) - yaw(before)
    way = after[:, :2] - before[:, :2]
    ahead = way[:, 0] * heading.cos() + way[:, 1] * heading.sin()
    return {"turn_deg": torch.atan2(turned.sin(), turned.cos()).rad2deg().numpy(), "ahead_m": ahead.numpy()}


def _explained(values: np.ndarray, code: np.ndarray, codes: int) -> float:
    within = sum(((values[code == k] - values[code == k].mean()) ** 2).sum() for k in range(codes) if (code == k).any())
    return float(1 - within / max(((values - values.mean()) ** 2).sum(), 1e-12))


def agreement(actions: np.ndarray, code: np.ndarray) -> dict[str, float]:
    """How codes int64 [n] go with recorded actions [n, A]; see `examine_latent`."""
    kinds, which = np.unique(actions, axis=0, return_inverse=True)
    table = np.zeros((int(code.max()) + 1, len(kinds)))
    np.add.at(table, (code, which.reshape(-1)), 1 / len(code))
    codes, acts = table.sum(1), table.sum(0)
    there = table > 0
    mutual = float((table[there] * np.log(table[there] / np.outer(codes, acts)[there])).sum())
    entropy = float(-(acts * np.log(acts)).sum())
    return {
        "purity": min(1.0, float(table.max(1).sum())),
        "commonest": float(acts.max()),
        "information": mutual / entropy if entropy > 0 else 0.0,
    }
