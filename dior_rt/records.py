"""Convert JSON to frozen dataclasses and back, strictly: unknown, missing or mistyped values are refused."""

from __future__ import annotations

import dataclasses
import json
import math
import types
import typing
from pathlib import Path
from typing import Any, TypeVar

T = TypeVar("T")


def read_json(path: Path, most_bytes: int) -> Any:
    """Return the JSON document at `path`.

    Raises ValueError for one that is too long, too deep, or not standard JSON.

    Keys that occur twice and the numbers NaN and Infinity are refused, because two readers could disagree
    about them. Raises OSError where the file cannot be read.
    """
    with path.open("rb") as file:
        data = file.read(most_bytes + 1)
    if len(data) > most_bytes:
        raise ValueError(f"it is longer than {most_bytes} bytes")
    return loads(data)


def loads(data: bytes) -> Any:
    """Return the JSON document in `data`, as strictly as `read_json`. Raises ValueError."""
    try:
        # Windows' shells write UTF-16, or UTF-8 with a byte order mark. The standard lets a reader accept
        # both.
        text = data.decode(json.detect_encoding(data))
        return json.loads(text, object_pairs_hook=_unique, parse_constant=_no_constant)
    except RecursionError:
        raise ValueError("it is nested too deep") from None


def parse(kind: type[T], value: Any, where: str = "") -> T:
    """Build a `kind` (a type annotation: a dataclass, a container of them, a JSON scalar) from parsed JSON.

    Dataclasses in a union are distinguished by their field `kind`. Raises ValueError, which names the place.
    """
    origin, args = typing.get_origin(kind), typing.get_args(kind)
    if origin in (types.UnionType, typing.Union):
        return _parse_union(args, value, where)
    if origin is typing.Literal:
        if type(value) not in {type(a) for a in args} or value not in args:
            raise ValueError(f"{_at(where)} must be {' or '.join(map(repr, args))}, not {_short(value)}")
        return value
    if dataclasses.is_dataclass(kind):
        return _parse_dataclass(kind, value, where)
    if origin is dict:
        _expect(dict, value, where)
        return typing.cast(T, {key: parse(args[1], item, f"{where}.{key}") for key, item in value.items()})
    if origin is tuple:
        _expect(list, value, where)
        return typing.cast(T, tuple(parse(args[0], item, f"{where}[{i}]") for i, item in enumerate(value)))
    return _parse_scalar(kind, value, where)


def unparse(record: Any) -> Any:
    """Return the JSON form of a dataclass, ready for `json.dumps`. Tuples become lists."""
    return dataclasses.asdict(record)


def _parse_union(options: tuple[Any, ...], value: Any, where: str) -> Any:
    kinds: list[Any] = [option for option in options if dataclasses.is_dataclass(option)]
    if isinstance(value, dict) and len(kinds) > 1:
        named = {typing.get_args(typing.get_type_hints(kind)["kind"])[0]: kind for kind in kinds}
        name = value.get("kind")
        if not isinstance(name, str) or name not in named:
            raise ValueError(f"{_at(where)}.kind must be {' or '.join(sorted(named))}, not {_short(name)}")
        return parse(named[name], value, where)
    if isinstance(value, dict) and kinds:
        return parse(kinds[0], value, where)
    for option in options:
        # The exact type comes first: 1 is an int before it is a float, and True is not an int.
        if type(value) is option:
            return parse(option, value, where)
    if type(value) is int and float in options:
        return float(value)
    names = " or ".join("null" if o is type(None) else getattr(o, "__name__", str(o)) for o in options)
    raise ValueError(f"{_at(where)} must be {names}, not {_short(value)}")


def _parse_dataclass(kind: Any, value: Any, where: str) -> Any:
    _expect(dict, value, where)
    hints = typing.get_type_hints(kind)
    if unknown := sorted(value.keys() - hints.keys()):
        raise ValueError(f"{_at(where)} has the unknown key {unknown[0]!r}")
    if missing := sorted(hints.keys() - value.keys()):
        raise ValueError(f"{_at(where)} lacks the key {missing[0]!r}")
    try:
        return kind(**{name: parse(hint, value[name], f"{where}.{name}") for name, hint in hints.items()})
    except OverflowError:
        raise ValueError(f"{_at(where)} holds a number that is too large") from None


def _parse_scalar(kind: Any, value: Any, where: str) -> Any:
    if kind is float and type(value) is int:
        value = float(value)
    _expect(kind, value, where)
    if kind is float and not math.isfinite(value):
        raise ValueError(f"{_at(where)} must be a finite number")
    return value


def _expect(kind: type, value: Any, where: str) -> None:
    if type(value) is not kind:
        raise ValueError(f"{_at(where)} must be of type {kind.__name__}, not {_short(value)}")


def _at(where: str) -> str:
    return where.removeprefix(".") or "the document"


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:40]}..."


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    keys = [key for key, _ in pairs]
    if len(set(keys)) < len(keys):
        raise ValueError("a key occurs twice")
    return dict(pairs)


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is no JSON number")
