"""Uses of latent actions: labelling a recording with codes, and mapping keys to codes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from ..core.errors import DatasetError
from ..data import ClipCache, Dataset, Readings, Sensor, Source, Take, split
from ..data.source import is_action
from .objectives.latent_model import LatentModel
from .recipes.latent_actions import frames_at, load_latent, pair_rows, pictures
from .trainer import Report


def infer_codes(model: LatentModel, cache: ClipCache, rows: np.ndarray) -> np.ndarray:
    """Codes int64 [n] of the motion from each of `rows` to `stride` rows later."""
    codes = [
        model.infer(frames_at(cache, some), frames_at(cache, some + model.stride))
        for some in np.array_split(rows, max(1, -(-len(rows) // 256)))
    ]
    return torch.cat(codes).numpy()


@dataclass(frozen=True)
class Labels:
    """A recording with inferred codes as actions: its source, whether its pictures are lossless, and facts."""

    source: Source
    exact: bool
    facts: dict


def labelled(run: str | Path, data: str | Path, report: Report, keys: KeyMap | None = None) -> Labels:
    """A copy of a recording with inferred codes as actions, so that any training on recordings gives a world that is played with
    codes. An action has a number, 0 or 1, for each code but the stillest, which is what happens while no key is pressed. Recorded
    actions are dropped; the digit keys 1, 2, ... stand for codes, and so do the recorded world's keys, if `keys` maps them.

    The code of a row is that of the motion over the next `stride` rows; near an episode's end, that of its last ones.
    """
    model = load_latent(run)
    cache, dataset = pictures(data, model.size, report), Dataset(data)
    stride, codes, source = model.stride, model.codes, dataset.source()
    still = stillest(model, cache)
    buttons = np.delete(np.eye(codes, dtype=np.float32), still, 1)
    short = [number for number, (first, stop) in enumerate(cache.episodes) if stop - first <= stride]
    if short:
        raise DatasetError(f"episode {short[0]} of {data} has no more than {stride} rows: too few to infer a motion.")

    def take(number: int, recorded: Take) -> Take:
        first, stop = cache.episodes[number]
        rows = np.minimum(np.arange(first, stop - 1), stop - 1 - stride)
        onehot = buttons[infer_codes(model, cache, rows)]
        kept = {name: readings for name, readings in recorded.readings.items() if not is_action(name)}
        report(number + 1, len(cache.episodes), "labelling")
        return replace(recorded, readings={**kept, "action": Readings(dataset.time_s(number)[:-1], onehot)})

    names = tuple(f"code_{code + 1}" for code in range(codes) if code != still)
    sensors = {name: sensor for name, sensor in source.sensors.items() if not is_action(name)}
    sensors["action"] = Sensor("action", "vector", (codes - 1,), names=names)
    world = {key: value for key, value in dataset.world.items() if key != "action_space"}
    world |= {"name": f"{dataset.world.get('name', dataset.name)}, latent actions", "dt_s": 1 / dataset.fps}
    world |= {"action_names": list(names), "discrete": False, "keys": _keys_of_codes(buttons, dataset, keys)}
    facts = {**source.facts, "world": world, "latent_actions": {"codes": codes, "stride": stride, "still": still + 1}}
    takes = lambda: (take(number, recorded) for number, recorded in enumerate(source.takes()))  # noqa: E731
    relabelled = replace(source, sensors=sensors, takes=takes, facts=facts)
    exact = dataset.features[dataset.rgb_key or ""]["dtype"] == "image"
    return Labels(relabelled, exact, {"codes": codes, "still": still + 1, "frames": cache.length})


def stillest(model: LatentModel, cache: ClipCache) -> int:
    """The code with the smallest flow over 32 frames of a recording."""
    before = frames_at(cache, np.linspace(0, cache.length - 1, 32).astype(int))
    codes = range(model.codes)
    flows = [model.predict(before, torch.full((32,), code))[1].norm(dim=1).mean() for code in codes]
    return int(torch.stack(flows).argmin())


def _keys_of_codes(buttons: np.ndarray, dataset: Dataset, keys: KeyMap | None) -> dict[str, list[float]]:
    """Browser keys -> actions, rows of `buttons` [K, K - 1]."""
    key_actions = {
        f"Digit{code + 1}": buttons[code].tolist() for code in range(min(len(buttons), 9)) if buttons[code].any()
    }
    if keys is not None and set(keys.names) <= set(dataset.action_names):
        columns = [dataset.action_names.index(name) for name in keys.names]
        for key, action in dataset.world.get("keys", {}).items():
            code = keys.code_of(np.asarray(action, np.float32).reshape(-1)[columns])
            if code is not None:
                key_actions[key] = buttons[code].tolist()
    return key_actions


@dataclass(frozen=True)
class KeyMap:
    """The recorded action of each code, from a few labelled frames, and its accuracy on other frames.

    names:      of the numbers of an action.
    actions:    float32 [K, A]: the commonest recorded action where code k was inferred.
    pairs:      recorded action -> the code that was inferred most often for it.
    used:       labelled frames.
    accuracy:   share of held-out frames whose whole action is that of their code.
    commonest:  the accuracy of the commonest action alone, as a baseline.
    """

    names: tuple[str, ...]
    actions: np.ndarray
    pairs: dict[tuple[float, ...], int]
    used: int
    accuracy: float
    commonest: float

    def code_of(self, action: np.ndarray) -> int | None:
        """The code of an action; None if it was never recorded."""
        return self.pairs.get(tuple(float(number) for number in np.asarray(action).reshape(-1)))


def map_keys(run: str | Path, data: str | Path, report: Report, frames: int = 200, seed: int = 0) -> KeyMap:
    """Maps recorded actions to codes by `frames` labelled frames, in clips of 10 from the training episodes of `data`, and tests
    the map on its held-out episodes. DatasetError if the recording has no actions, or too few."""
    model = load_latent(run)
    cache = pictures(data, model.size, report)
    if cache.action is None or not cache.action_names:
        raise DatasetError(f"{data} has no recorded actions; keys are mapped by a few labelled clips.")
    train, held_out = split(len(cache.episodes))
    clips = clips_of(pair_rows(cache, train, model.stride), 10)
    if len(clips) * 10 < frames or frames < 1:
        raise DatasetError(f"{data} has {len(clips) * 10} rows with actions to label, not {frames}; ask for fewer.")
    order = np.random.default_rng(seed).permutation(len(clips))[: -(-frames // 10)]
    rows = np.concatenate([clips[i] for i in order])[:frames]
    recorded, code = np.asarray(cache.action[rows], np.float32), infer_codes(model, cache, rows)
    common = _commonest(recorded)
    actions = np.stack([_commonest(recorded[code == k]) if (code == k).any() else common for k in range(model.codes)])
    kinds, which = np.unique(recorded, axis=0, return_inverse=True)
    which = which.reshape(-1)
    pairs = {tuple(kind.tolist()): int(np.bincount(code[which == i]).argmax()) for i, kind in enumerate(kinds)}
    tested = pair_rows(cache, held_out, model.stride)
    if not len(tested):
        raise DatasetError(f"{data} has no held-out frames to test keys on; record two episodes or more.")
    truth, guess = np.asarray(cache.action[tested], np.float32), actions[infer_codes(model, cache, tested)]
    right, usual = (truth == guess).all(1).mean(), (truth == common).all(1).mean()
    return KeyMap(tuple(cache.action_names), actions, pairs, len(rows), float(right), float(usual))


def clips_of(rows: np.ndarray, length: int) -> list[np.ndarray]:
    """Stretches of `length` consecutive rows."""
    breaks = np.flatnonzero(np.diff(rows) != 1) + 1
    return [run[at : at + length] for run in np.split(rows, breaks) for at in range(0, len(run) - length + 1, length)]


def _commonest(actions: np.ndarray) -> np.ndarray:
    kinds, counts = np.unique(actions, axis=0, return_counts=True)
    return kinds[counts.argmax()]
