"""Errors that a user can fix: what happened, why, and how to fix it."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

EXIT_OK = 0
EXIT_USAGE = 2  # unknown verb, flag or configuration key
EXIT_INPUT = 3  # the photos, cameras, masks or folders given
EXIT_FAILED = 4  # the reconstruction failed; the message carries the diagnosis
EXIT_ENVIRONMENT = 5  # libLLVM, CUDA, memory, disk


class UserError(Exception):
    """An error that the user can fix, reported once.

    Args:
        what: what went wrong, one sentence with the relevant numbers.
        why: the likely cause.
        fix: what to do, a command where possible. Paths come last.
        code: the exit code of the command line (one of the `EXIT_*` above).
    """

    def __init__(self, what: str, why: str = "", fix: str = "", *, code: int = EXIT_INPUT):
        super().__init__(what)
        self.what, self.why, self.fix, self.code = what, why, fix, code

    def __str__(self) -> str:
        lines = [self.what]
        if self.why:
            lines.append(f"why: {self.why}")
        if self.fix:
            lines.append(f"fix: {self.fix}")
        return "\n".join(lines)


def did_you_mean(word: str, choices: Iterable[str]) -> str:
    """ " Did you mean 'x'?" or an empty string."""
    close = difflib.get_close_matches(word, list(choices), n=1, cutoff=0.55)
    return f" Did you mean '{close[0]}'?" if close else ""
