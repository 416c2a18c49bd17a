"""Frozen dataclasses as arrays: what a stage of a run hands to the next, kept in its folder.

A field is an array, a number, a text, an enum member, None, another dataclass, or a tuple or list
of those. Keys name the path to a value: `cameras.3.world_from_camera`.
"""

from __future__ import annotations

import dataclasses
import enum
import types
import typing
from collections.abc import Mapping
from typing import Any

import numpy as np

COUNT = "#"  # key of the number of entries of a tuple or list


def to_arrays(record: Any) -> dict[str, np.ndarray]:
    """{path: array} of all fields of a dataclass instance. Fields that are None have no key."""
    out: dict[str, np.ndarray] = {}
    for field in dataclasses.fields(record):
        _put(out, field.name, getattr(record, field.name))
    return out


def from_arrays(kind: type, arrays: Mapping[str, np.ndarray]) -> Any:
    """The inverse of `to_arrays`: an instance of the dataclass `kind`.

    Raises KeyError where the arrays lack a field that has no None, ValueError where a value does
    not fit the field's type.
    """
    return _record(kind, arrays, "")


def _put(out: dict[str, np.ndarray], key: str, value: Any) -> None:
    if value is None:
        return
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        for field in dataclasses.fields(value):
            _put(out, f"{key}.{field.name}", getattr(value, field.name))
    elif isinstance(value, (tuple, list)):
        out[f"{key}.{COUNT}"] = np.array(len(value))
        for i, entry in enumerate(value):
            if entry is None:
                raise TypeError(f"{key}: a list with None cannot be kept")
            _put(out, f"{key}.{i}", entry)
    elif isinstance(value, enum.Enum):
        out[key] = np.array(value.name)
    else:
        array = np.array(value, order="C", copy=None)  # sums over other orders round otherwise
        if array.dtype.hasobject:
            raise TypeError(f"{key}: {type(value).__name__} is neither array, number nor text")
        out[key] = array


def _record(kind: type, arrays: Mapping[str, np.ndarray], prefix: str) -> Any:
    hints = typing.get_type_hints(kind)
    values = {
        f.name: _get(hints[f.name], arrays, prefix + f.name) for f in dataclasses.fields(kind)
    }
    return kind(**values)


def _get(hint: Any, arrays: Mapping[str, np.ndarray], key: str) -> Any:
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        if not any(name == key or name.startswith(f"{key}.") for name in arrays):
            return None
        (hint,) = (a for a in args if a is not type(None))
        return _get(hint, arrays, key)
    if origin in (tuple, list):
        count = int(arrays[f"{key}.{COUNT}"])
        fixed = origin is tuple and Ellipsis not in args
        return origin(
            _get(args[i] if fixed else args[0], arrays, f"{key}.{i}") for i in range(count)
        )
    if dataclasses.is_dataclass(hint):
        return _record(typing.cast(type, hint), arrays, f"{key}.")
    array = arrays[key]
    if isinstance(hint, type) and issubclass(hint, enum.Enum):
        return hint[str(array)]
    if hint in (bool, int, float, str):
        return hint(array.item())
    return array
