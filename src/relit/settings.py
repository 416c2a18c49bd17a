"""Options of a recipe: a flat frozen dataclass, changed by `--set key=value` or a TOML file. Values
are checked against their types."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Iterable
from pathlib import Path

from relit.errors import EXIT_USAGE, UserError, did_you_mean
from relit.files import parse_toml


def with_pairs(options, pairs: Iterable[str], prefix: str = "--set"):
    """`options` with 'key=value' texts applied. Raises UserError (code 2) for an unknown key or a
    value of another type."""
    changes = {}
    for pair in pairs:
        key, equals, text = pair.partition("=")
        if not equals:
            raise UserError(
                f"{prefix} {pair}: '=' is missing", fix=f"{prefix} key=value", code=EXIT_USAGE
            )
        changes[key.strip()] = text.strip()
    return with_values(options, changes, prefix)


def with_values(options, values: dict, source: str):
    """`options` with {key: value} applied; values are texts (from the command line) or TOML values.
    source: named in errors."""
    hints = typing.get_type_hints(type(options))
    changes = {}
    for key, value in values.items():
        if key not in hints:
            what = f"{source}: unknown key '{key}'.{did_you_mean(key, hints)}"
            raise UserError(what, f"known keys: {', '.join(hints)}", code=EXIT_USAGE)
        try:
            changes[key] = convert(value, hints[key])
        except ValueError:
            what = f"{source}: {key}={value} is not valid; expected {type_name(hints[key])}"
            raise UserError(
                what, f"{key} is {getattr(options, key)!r} by default", code=EXIT_USAGE
            ) from None
    try:
        return dataclasses.replace(options, **changes)
    except ValueError as error:  # a recipe's own check
        why = ", ".join(f"{key} is {getattr(options, key)!r} by default" for key in changes)
        raise UserError(f"{source}: {error}", why, code=EXIT_USAGE) from None


def preset(quality: str, presets: dict[str, dict]) -> dict:
    """A recipe's options at 'draft', 'standard' or 'high'. Raises UserError (code 2) for others."""
    if quality not in presets:
        what = f"quality '{quality}' is not known.{did_you_mean(quality, presets)}"
        raise UserError(what, fix=f"one of: {', '.join(presets)}", code=EXIT_USAGE)
    return presets[quality]


def check_parts(without: Iterable[str], known: Iterable[str]) -> None:
    """Raises ValueError for a part that a recipe cannot switch off (its option `without`)."""
    for name in without:
        if name not in known:
            raise ValueError(
                f"without={name} is not known.{did_you_mean(name, known)} Known: {', '.join(known)}"
            )


def check_levels(options) -> None:
    """Raises UserError (code 2) unless `level_steps` has one entry for each of `levels`."""
    if len(options.levels) != len(options.level_steps):
        raise UserError(
            "levels and level_steps differ in length",
            fix="give one number of steps per level",
            code=EXIT_USAGE,
        )


def convert(value, hint):
    """A text or a TOML value -> a value of type `hint`: bool, int, float, str, Literal, tuple/list
    of those, or one of them or None."""
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        if value is None or (
            isinstance(value, str) and value.lower() in ("none", "") and type(None) in args
        ):
            return None
        for arm in (a for a in args if a is not type(None)):
            try:
                return convert(value, arm)
            except ValueError:
                continue
        raise ValueError
    if origin is typing.Literal:
        return next((a for a in args if str(a) == str(value)), None) or _fail()
    if origin in (tuple, list):
        parts = (
            [p for p in value.replace("[", "").replace("]", "").split(",") if p.strip()]
            if isinstance(value, str)
            else list(value)
        )
        kinds = (
            [args[0]] * len(parts)
            if len(args) != len(parts) or args[-1] is Ellipsis or origin is list
            else list(args)
        )
        if origin is tuple and Ellipsis not in args and len(args) != len(parts):
            raise ValueError
        return origin(
            convert(p.strip() if isinstance(p, str) else p, k)
            for p, k in zip(parts, kinds, strict=True)
        )
    if hint is bool:
        return _bool(value)
    if isinstance(value, bool):
        raise ValueError
    if hint is int:
        number = float(value)
        return int(number) if number.is_integer() else _fail()
    if hint is float:
        return float(value)
    if hint is str and isinstance(value, str):
        return value
    raise ValueError


def _bool(value) -> bool:
    if isinstance(value, bool):
        return value
    words = {
        "true": True,
        "yes": True,
        "on": True,
        "1": True,
        "false": False,
        "no": False,
        "off": False,
        "0": False,
    }
    return words[str(value).lower()] if str(value).lower() in words else _fail()


def _fail():
    raise ValueError


def type_name(hint) -> str:
    """'whole number', 'true or false', 'draft, standard or high'."""
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return " or ".join("none" if a is type(None) else type_name(a) for a in args)
    if origin is typing.Literal:
        return "one of " + ", ".join(str(a) for a in args)
    if origin in (tuple, list):
        return f"list of {type_name(args[0])}"
    return {bool: "true or false", int: "whole number", float: "number", str: "text"}.get(
        hint, str(hint)
    )


def read_config(path: str | Path) -> dict:
    """A TOML file as a dictionary. Raises UserError (code 2) when it is missing or malformed."""
    path = Path(path)
    try:
        return parse_toml(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UserError(
            "the configuration file does not exist", fix=f"check the path: {path}", code=EXIT_USAGE
        ) from None
    except (OSError, ValueError) as error:
        what = f"the configuration file cannot be read: {error}"
        raise UserError(
            what, fix=f"it must be TOML, key = value: {path}", code=EXIT_USAGE
        ) from None
