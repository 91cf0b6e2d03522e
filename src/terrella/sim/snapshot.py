"""Snapshots of the Python state of a Gymnasium environment as plain numbers, which make it forkable.

A snapshot has every attribute of the environment and its wrappers that is a number, None, a flat list or tuple of numbers, or a
numeric array; text and nested containers must not change. An environment with any other attribute (a physics engine, an open file,
its own random generator) is refused, because a copy would be incomplete."""

import copy
from collections.abc import Sequence
from types import FunctionType

import gymnasium
import numpy as np

# Gymnasium's own fields, which do not affect the dynamics; the random generator is reseeded before every step.
_IGNORED = {"env", "spec", "metadata", "_np_random", "_np_random_seed", "_saved_kwargs", "_cached_spec"}
_IGNORED |= {"_action_space", "_observation_space", "_metadata"}
_CHECKERS = (gymnasium.wrappers.PassiveEnvChecker, gymnasium.wrappers.OrderEnforcing)  # without state of their own
_LEAVES = (type(None), bool, int, float) + tuple(
    getattr(np, name) for name in "bool_ int8 int16 int32 int64 uint8 uint16 uint32 uint64 float32 float64".split()
)
_CODE = {kind: code for code, kind in enumerate(_LEAVES)}
_MAKE = (lambda number: None, bool, int, *_LEAVES[3:])
_SCALAR, _TUPLE, _LIST, _ARRAY = range(4)
_FIXED = (str, bytes, type, FunctionType, gymnasium.Space, np.dtype)
_MAX_INTEGER = 2**53  # float64 is exact up to here
_MAX_NUMBERS = 100_000


class NotCopyable(Exception):
    """The environment has state that is not made of numbers; the message names it."""


class Snapshots:
    """Takes and restores snapshots of environments made alike; the layout is that of `env` after a reset."""

    ignored = frozenset(_IGNORED)

    def __init__(self, env: gymnasium.Env):
        self._slots: list[tuple[int, str, int, tuple[int, ...]]] = []  # layer, attribute, numbers, array shape
        self._fixed: list[tuple[int, str, object]] = []
        layers = _layers(env)
        self._names = [set(layer) for layer in layers]
        for depth, layer in enumerate(layers):
            for name, value in layer.items():
                if name in self.ignored:
                    continue
                parts = _parts(value)
                if parts is not None:
                    self._slots.append((depth, name, len(parts[1]), np.shape(value) if parts[0] == _ARRAY else ()))
                elif isinstance(value, (*_FIXED, dict, list, tuple, np.ndarray)):
                    self._fixed.append((depth, name, copy.deepcopy(value)))
                else:
                    raise NotCopyable(f"`{name}` is a {type(value).__name__}")
        if sum(width for _, _, width, _ in self._slots) > _MAX_NUMBERS:
            raise NotCopyable(f"its state has more than {_MAX_NUMBERS:,} numbers")

    def take(self, env: gymnasium.Env) -> tuple[list[float], list[int]]:
        """The numbers of the current state, and the types that turn them back into attributes."""
        layers, numbers, kinds = _layers(env), [], []
        for names, layer in zip(self._names, layers, strict=True):
            if len(layer) != len(names):
                raise NotCopyable(f"it has new attributes {sorted(set(layer) ^ names)}")
        for depth, name, constant in self._fixed:
            if not _alike(layers[depth][name], constant, name):
                raise NotCopyable(f"`{name}` changes and is not made of numbers")
        for depth, name, width, _ in self._slots:
            value = layers[depth][name]
            code = _CODE.get(type(value))
            if code is not None and width == 1:  # a single number, the usual case
                container, leaves, codes = _SCALAR, (value,), (code,)
            else:
                parts = _parts(value)
                if parts is None or len(parts[1]) != width:
                    raise NotCopyable(f"`{name}` became {type(value).__name__}, or changed its length")
                container, leaves = parts
                codes = [_CODE[type(leaf)] for leaf in leaves]
            kinds.append(container)
            kinds += codes
            for leaf in leaves:
                if type(leaf) is int and abs(leaf) > _MAX_INTEGER:
                    raise NotCopyable(f"`{name}` holds an integer beyond 2**53")
                numbers.append(0.0 if leaf is None else float(leaf))
        return numbers, kinds

    def put(self, env: gymnasium.Env, numbers: Sequence[float], kinds: Sequence[int]) -> None:
        """Restores a snapshot in `env`. Objects that `env` made for rendering (a surface, a clock) stay."""
        layers, at, kind = _layers(env), 0, 0
        for depth, name, width, shape in self._slots:
            container, codes = kinds[kind], kinds[kind + 1 : kind + 1 + width]
            leaves = [_MAKE[code](number) for code, number in zip(codes, numbers[at : at + width])]
            at, kind = at + width, kind + 1 + width
            if container == _SCALAR:
                value = leaves[0]
                if value is None and _parts(layers[depth].get(name)) is None:
                    continue
            elif container == _ARRAY:
                value = np.array(leaves, dtype=_LEAVES[codes[0]] if codes else None).reshape(shape)
            else:
                value = tuple(leaves) if container == _TUPLE else leaves
            layers[depth][name] = value


def _layers(env: gymnasium.Env) -> list[dict]:
    """The attributes of the wrappers, outermost first, and of the bare environment."""
    chain = [env]
    while isinstance(chain[-1], gymnasium.Wrapper):
        chain.append(chain[-1].env)
    return [vars(layer) for layer in chain if not isinstance(layer, _CHECKERS)]


def _parts(value) -> tuple[int, list] | None:
    """(container, leaves) of a value made of numbers, else None."""
    if type(value) in _CODE:
        return _SCALAR, [value]
    if type(value) in (tuple, list) and all(type(leaf) in _CODE for leaf in value):
        return (_TUPLE if type(value) is tuple else _LIST), list(value)
    if type(value) is np.ndarray and value.dtype.type in _CODE:
        return _ARRAY, list(value.reshape(-1))
    return None


def _alike(value, constant, name: str) -> bool:
    if isinstance(value, np.ndarray):
        return isinstance(constant, np.ndarray) and np.array_equal(value, constant)
    if isinstance(value, (gymnasium.Space, FunctionType)):  # instances differ, types do not
        return type(value) is type(constant)
    try:
        return type(value) is type(constant) and bool(value == constant)
    except ValueError as error:  # arrays in a container cannot be compared with ==
        raise NotCopyable(f"`{name}` keeps arrays inside a container") from error
