"""The forms that an asset is exported in. Light to import: the command line's help asks for it."""

from __future__ import annotations

from pathlib import Path

from relit.errors import EXIT_USAGE, UserError, did_you_mean

SUFFIXES = {
    "glb": ".glb",
    "obj": ".obj",
    "ply": ".ply",
    "mitsuba": "",
    "gaussians": ".json",
    "html": ".html",
}  # mitsuba: a folder


def form_of(out: Path, named: str | None) -> str:
    """The form that is named, else the one that the ending of `out` tells. Raises UserError for
    none, an unknown one or a wrong ending."""
    ending = out.suffix.lower()
    form = named or next(
        (form for form, suffix in SUFFIXES.items() if suffix and suffix == ending), None
    )
    if form is None:
        fix = f"add the format: {', '.join(SUFFIXES)}"
        raise UserError(
            "the form cannot be told from the ending of the output", fix=fix, code=EXIT_USAGE
        )
    if form not in SUFFIXES:
        raise UserError(
            f"unknown format '{form}'.{did_you_mean(form, SUFFIXES)}",
            fix=f"choose {', '.join(SUFFIXES)}",
            code=EXIT_USAGE,
        )
    if SUFFIXES[form] not in ("", ending):
        raise UserError(
            f"the output of format '{form}' must end in {SUFFIXES[form]}",
            fix=f"rename it: {out}",
            code=EXIT_USAGE,
        )
    return form
