"""Values of TOML and JSON as the types of frozen dataclasses, with a sentence for each mistake."""

from dataclasses import MISSING, fields, is_dataclass
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from .errors import TerrellaError


def typed(hint: Any, value: Any, where: str, error: type[TerrellaError] = TerrellaError) -> Any:
    """A parsed value as the type `hint`: a dataclass, tuple, dict, Literal, number, str or bool, or a union of these. `error` where
    the type is wrong, or a table has an unknown or missing key; `where` names the value in messages."""
    origin, parts = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        if value is None and NoneType in parts:
            return None
        given = [part for part in parts if is_dataclass(part) == isinstance(value, dict) and part is not NoneType]
        return typed((given or parts)[0], value, where, error)
    kind = list if origin is tuple else str if origin is Literal else dict if origin or is_dataclass(hint) else hint
    kinds = {list: (list, tuple), float: (int, float)}.get(kind, kind)
    if isinstance(value, bool) != (kind is bool) or not isinstance(value, kinds):
        raise error(f"{where} = {value!r} should be of type {'table' if kind is dict else kind.__name__}.")
    if origin is Literal and value not in parts:
        raise error(f"{where} = '{value}' is unknown; choose {' or '.join(parts)}.")
    if origin is tuple:
        each = (parts[0],) * len(value) if parts[-1] is Ellipsis else parts
        if len(each) != len(value):
            raise error(f"{where} has {len(value)} values; it needs {len(each)}.")
        one = f"{where[:-3]}y" if where.endswith("ies") else where.removesuffix("s")
        return tuple(typed(part, it, f"{one} {i}", error) for i, (part, it) in enumerate(zip(each, value)))
    if is_dataclass(hint):
        return _table_as(hint, value, where, error)
    if kind is dict:
        return {key: typed(parts[1], it, f"{where} '{key}'", error) for key, it in value.items()}
    return float(value) if kind is float else value


def _table_as(cls: Any, values: dict, where: str, error: type[TerrellaError]) -> Any:
    hints = get_type_hints(cls)
    for key in values:
        if key not in hints:
            raise error(f"{where} has an unknown key '{key}'; it may have {', '.join(hints)}.")
    for field in fields(cls):
        if field.default is MISSING and field.default_factory is MISSING and field.name not in values:
            raise error(f"{where} lacks '{field.name}'; add it.")
    return cls(**{key: typed(hints[key], it, f"{where} {key}", error) for key, it in values.items()})
