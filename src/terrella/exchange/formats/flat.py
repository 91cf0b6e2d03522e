"""Flat arrays: one array per key for many episodes, and something that says where each of them ends.

The layouts of D4RL (terminals, timeouts), OGBench (terminals; qpos, qvel beside), stable-baselines (episode_starts), Dreamer
(is_first, is_last) and diffusion policy (data/…, meta/episode_ends).
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from ...core.errors import DatasetError
from ...data.source import Sensor, Take
from . import arrays, rows
from .arrays import Array, Place
from .spaces import is_instruction, split_texts

SPELLINGS = {  # `rollouts.write` uses the first
    rows.OBSERVATION: ("observations", "observation", "obs"),
    rows.ACTION: ("actions", "action", "acts", "act"),
    rows.REWARD: ("rewards", "reward", "rews", "rew"),
    rows.DONE: (
        "terminations", "terminated", "terminateds", "terminals", "terminal", "terminal_flags", "dones", "done",
        "dones_float", "done_bool", "done_flags", "is_terminal", "is_done", "next_done", "next_dones", "absorbing",
    ),
    rows.TRUNCATED: ("truncations", "truncated", "truncateds", "timeouts", "timeout", "is_truncated",
        "TimeLimit.truncated", "TimeLimit_truncated"),
    rows.INFO: ("infos", "info"),
}  # fmt: skip
NAMES = {spelling: role for role, spellings in SPELLINGS.items() for spelling in spellings}
NEXT = ("next_observations", "next_observation", "next_obs", "obs_next", "next_state", "next_states")
LAST, FIRST = ("is_last", "last"), ("is_first", "episode_starts", "episode_start")  # flags with a row for each step
_STEP_TYPE, _LAST_STEP = "step_type", 2  # of dm_env
# of each episode the row after its last one; its last one, where the very last row is named
_ENDS = ("episode_ends", "traj_ends", "trajectory_ends", "ep_ends", "episode_data_index.to", "cu_seqlens")
LENGTHS = ("episode_lengths", "traj_lengths", "trajectory_lengths", "path_lengths", "ep_lengths", "ep_len")
# of each episode its first row; "episode_starts" may also be a flag for each step
_STARTS = (
    "episode_starts",
    "traj_starts",
    "trajectory_starts",
    "path_starts",
    "ep_offset",
    "episode_offsets",
    "episode_data_index.from",
)
_NUMBERS = (  # of the episode of each row
    "episode_index", "episode_id", "episode_ids", "episode", "episode_num", "ep_idx", "traj_id", "traj_ids",
    "trajectory_id", "trajectory_ids", "demo_id",
)  # fmt: skip
_GOES_ON = ("not_done", "not_dones", "not_terminal", "nonterminal", "nonterminals", "discounts")  # 0 at an end
_COUNTERS = ("step_idx", "step", "timestep", "frame_index", "discount", "valids", "masks")
_FOLDERS = ("data", "meta", "steps")  # of diffusion policy's files, of RLDS
Times = Callable[[int], np.ndarray]
BARE = "no array has a name of observations: others with a row for each step are taken for them."


@dataclass(frozen=True)
class Episodes:
    """The arrays of a file, and the rows [start, stop) of each of its episodes.

    stored: place -> array. Those that have no row for each step are emptied, so that they are named as left out.
    more:   place -> its rows beside those of the steps: 0, 1 at the very end, or 1 after each episode.
    after:  place of an observation -> its array of next observations.
    texts:  place -> texts with a row for each step, or one instruction for all.
    notes:  what to say where nothing marks an end.
    """

    stored: Mapping[Place, Array]
    spans: list[tuple[int, int]]
    more: Mapping[Place, int]
    after: Mapping[Place, Array]
    texts: Mapping[Place, Array]
    notes: tuple[str, ...]

    def cut(self, number: int) -> dict[Place, Array]:
        """The arrays of one episode."""
        stop = self.spans[number][1]
        parts = {place: self._part(number, place, array) for place, array in self.stored.items()}
        for place, following in self.after.items():
            parts[place] = _joined(parts[place], _slice(following, stop - 1, stop))
        return parts

    def take(self, number: int, sensors: Mapping[Place, Sensor], times: Times, where: str, task: str = "") -> Take:
        """One episode, whose n rows have the times `times(n)`."""
        parts = {place: part for place, part in self.cut(number).items() if place in sensors and part.shape}
        count = max((it.shape[0] for at, it in parts.items() if rows.role_of(sensors[at].name) != rows.INFO), default=0)
        texts = {place: arrays.texts(self._part(number, place, array)) for place, array in self.texts.items()}
        task, kept = split_texts(texts, task)
        facts = {"texts": kept} if kept else {}
        return Take(arrays.readings(parts, sensors, times(count), where), task, facts=facts)

    def _part(self, number: int, place: Place, array: Array) -> Array:
        if len(self.spans) == 1 or not array.shape:
            return array
        (start, stop), more, last = self.spans[number], self.more[place], number == len(self.spans) - 1
        shift = number if more > 1 else 0
        return _slice(array, start + shift, stop + shift + (more > 1 or (more == 1 and last)))


def home(place: Place) -> Place:
    """A place without the folder of diffusion policy's layout: ("data", "action") -> ("action",)."""
    return place[1:] if len(place) > 1 and place[0] in _FOLDERS else place


def guess(bare: bool, place: Place, shape: tuple[int, ...], dtype: np.dtype) -> Sensor | None:
    """The sensor of an array with a row for each step. One of an unknown name is a picture, if its bytes look like one; else
    "info.NAME", or an observation if `bare` (no array has a name of observations) and its name is not about steps."""
    head, *below = place
    if depth := rows.depth_sensor(arrays.joined((*below,) if below and head in NAMES else place), shape, dtype):
        return depth
    if place[0] in NAMES:
        return arrays.sensor_at(NAMES, place, shape, dtype)
    about_steps = place[0] in (*LAST, *FIRST, *_NUMBERS, *_COUNTERS, _STEP_TYPE)
    observed = (bare and not about_steps) or rows.picture_layout(shape, dtype) is not None
    return rows.sensor_for(rows.OBSERVATION if observed else rows.INFO, arrays.joined(place), shape, dtype)


def is_bare(stored: Mapping[Place, Array]) -> bool:
    """Whether arrays have actions, or bounds of episodes, but no name of observations."""
    heads = {str(place[0]) for place in stored}
    acted = heads & {*SPELLINGS[rows.ACTION], *_ENDS, *LENGTHS}
    return bool(acted) and not heads & set(SPELLINGS[rows.OBSERVATION])


def split(stored: Mapping[Place, Array], where: str, whole: bool = False) -> Episodes:
    """Cuts the arrays of a file into episodes: at the bounds that it states, else after each terminal and each timeout. Rows
    after the last end are an episode too. `whole`: it holds one episode, whatever its flags say.

    DatasetError where the bounds do not fit the rows.
    """
    count = _steps(stored)
    ends = np.zeros(count, bool) if whole else _ends(stored, count, where)
    stops = sorted({*(np.flatnonzero(ends) + 1).tolist(), count} - {0}) or [0]
    spans = list(zip([0, *stops[:-1]], stops))
    kept: dict[Place, Array] = {}
    more: dict[Place, int] = {}
    after: dict[Place, Array] = {}
    texts: dict[Place, Array] = {}
    for place, array in stored.items():
        role, rest = NAMES.get(str(place[0])), place[1:]
        if place[0] in (*_ENDS, *LENGTHS) or _are_starts(place, array, count):
            continue
        kept[place], more[place] = array, (array.shape[0] if array.shape else 0) - count
        if array.dtype.kind in "USO" and len(array.shape) < 2:
            rowwise, instruction = bool(array.shape) and more[place] in (0, 1, len(spans)), is_instruction(place)
            if array.is_text and (rowwise or (instruction and not array.shape)):
                texts[place] = kept.pop(place)
            else:
                kept[place] = Array((), array.dtype)
            continue
        following = next((stored[name, *rest] for name in NEXT if (name, *rest) in stored), None)
        if role == rows.OBSERVATION and following is not None and following.shape == array.shape and not more[place]:
            after[place] = following
        surplus = {0} if role not in (rows.OBSERVATION, rows.INFO, None) else {0, 1, len(spans)}
        if (len(spans) > 1 or role is None) and more[place] not in surplus:
            if role not in (rows.INFO, None):
                has = f"{array.shape[0] if array.shape else 'no'} rows where {count} are needed"
                raise DatasetError(f"'{arrays.spelled(place)}' in {where} has {has}; mend or drop it.")
            kept[place] = Array((), array.dtype)
    observed = [place for place in kept if NAMES.get(str(place[0])) == rows.OBSERVATION]
    after = after if len(after) == len(observed) else {}  # a last observation needs every sensor
    for place in [place for place in kept if place[0] in NEXT]:
        if after:
            del kept[place]
        else:
            kept[place] = Array((), kept[place].dtype)
    open_ = f"nothing marks the end of an episode: the {count} rows of {where} are one."
    return Episodes(kept, spans, more, after, texts, () if whole or ends.any() else (open_,))


def _steps(stored: Mapping[Place, Array]) -> int:
    """The number of steps: rows of the actions, else of the flags, else of the first array."""
    flags = (*SPELLINGS[rows.DONE], *SPELLINGS[rows.TRUNCATED], *LAST, *FIRST, *_NUMBERS)
    arrayed = {place: array.shape[0] for place, array in stored.items() if array.shape}
    for heads in (SPELLINGS[rows.ACTION], flags, SPELLINGS[rows.OBSERVATION]):
        for place, count in arrayed.items():
            if place[0] in heads:
                return count
    return max(arrayed.values(), default=0)


def _are_starts(place: Place, array: Array, count: int) -> bool:
    """Whether an array numbers the first rows of episodes."""
    rowwise = array.shape[:1] == (count,) and place[0] in FIRST
    return place[0] in _STARTS and array.dtype.kind in "iu" and len(array.shape) == 1 and not rowwise


def _ends(stored: Mapping[Place, Array], count: int, where: str) -> np.ndarray:
    """bool [count]: the last step of each episode."""
    ends, flags = np.zeros(count, bool), np.zeros(count, bool)
    for (head, *rest), array in stored.items():
        if rest or not array.is_numeric:
            continue
        rowwise = math.prod(array.shape) == array.shape[0] == count
        starts, flag = _are_starts((head,), array, count), NAMES.get(str(head)) in (rows.DONE, rows.TRUNCATED)
        if flag and math.prod(array.shape[1:]) > 1:
            has = f"{list(array.shape)} numbers, and one for each step is needed"
            raise DatasetError(f"'{head}' in {where} has {has}: store episodes one after another, or a file each.")
        if starts or head in (*_ENDS, *LENGTHS):
            values = array.read(0, array.shape[0]).reshape(-1).astype(np.int64)
            values = values[1:] if head in _ENDS and (values[:1] == 0).all() else values  # "cu_seqlens" begins with 0
            stops = np.cumsum(values) if head in LENGTHS else values + (values.max(initial=0) == count - 1)
            stops = np.append(values[1:], count) if starts else stops
            if (np.diff(stops, prepend=0) < 1).any() or stops.max(initial=0) > count:
                raise DatasetError(f"'{head}' in {where} does not fit its {count} rows; mend it, or drop it.")
            ends[stops - 1] = True
        elif rowwise and head in _NUMBERS:
            ends[:-1] |= np.diff(array.read(0, count).reshape(-1)) != 0
        elif rowwise and head in FIRST:
            ends[:-1] |= array.read(0, count).reshape(-1)[1:].astype(bool)
        elif rowwise and head == _STEP_TYPE:
            flags |= array.read(0, count).reshape(-1) == _LAST_STEP
        elif rowwise and (flag or head in LAST):
            flags |= np.nan_to_num(array.read(0, count).reshape(-1)).astype(bool)
    if not flags.any() and not ends.any():
        for head in _GOES_ON:
            if (head,) in stored and math.prod(stored[(head,)].shape) == stored[(head,)].shape[0] == count:
                flags |= stored[(head,)].read(0, count).reshape(-1) == 0
    if count > 1 and flags[-2:].all() and not flags[-3:-2].any():
        flags[-2] = False  # flagged at the last step and at the terminal observation
    return ends if ends.any() else flags


def _slice(array: Array, start: int, stop: int) -> Array:
    return replace(array, shape=(stop - start, *array.shape[1:]), read=lambda a, b: array.read(start + a, start + b))


def _joined(one: Array, other: Array) -> Array:
    count = one.shape[0]

    def read(start: int, stop: int) -> np.ndarray:
        begin, end = (max(at - count, 0) for at in (start, stop))
        return np.concatenate([one.read(min(start, count), min(stop, count)), other.read(begin, end)])

    return replace(one, shape=(count + other.shape[0], *one.shape[1:]), read=read)
