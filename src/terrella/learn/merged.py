"""A recording that `data merge` made of several bodies, as one recording for each, with the body's own actions."""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import numpy as np

from ..core.errors import DatasetError
from .recording import Recording, controls_of


def by_body(opened: Recording) -> list[Recording]:
    """One recording for each body that was merged; the recording itself where it is of one. DatasetError where the merged one does
    not hold the whole action of a body."""
    bodies = (opened.dataset.about.get("embodiments") if opened.dataset else None) or ()
    if len(bodies) < 2:
        return [opened]
    cache, recordings = opened.cache, []
    of_row = np.asarray(cache.arrays["embodiment"]).reshape(-1)
    of_episode, of_all = of_row[cache.ranges[:, 0]], Recording.of(cache, list(range(len(cache.episodes))), None).usable
    for body in bodies:
        if not body.get("actions"):
            raise DatasetError(
                f"{opened.name} does not hold the whole action of {body['name']}: merge again without leaving numbers out, or name "
                f"the recordings, --from {' '.join(path for one in bodies for path in one.get('sources', ()))}."
            )
        at, scale, offset = np.array(body["actions"]["numbers"]).T
        own = copy(cache)
        own.action = ((np.asarray(cache.action)[:, at.astype(int)] - offset) / scale).astype(np.float32)
        own.action_valid = np.asarray(cache.action_valid) & np.asarray(cache.arrays["action_mask"])[
            :, at.astype(int)
        ].all(1)
        own.world = {**cache.world, **body["actions"]["space"]}
        held_out = tuple(number for number in opened.held_out if of_episode[number] == body["id"])
        usable, mine = opened.usable & (of_row == body["id"]), of_all & (of_row == body["id"])
        if mine.any() and not usable.any():  # all its episodes were held out: it learns from them
            usable, held_out = mine, ()
        recordings.append(replace(opened, cache=own, controls=controls_of(own), usable=usable, held_out=held_out))
    return recordings
