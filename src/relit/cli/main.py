"""The command line: one level of verbs, one positional input, flags in any order.

Exit codes: 0 ok, 2 usage, 3 bad input, 4 reconstruction failed, 5 environment; 1 for an error of
Relit itself, 130 after Ctrl-C, 143 after SIGTERM. Results go to stdout, everything else to stderr.
Heavy modules are imported by the verb that needs them: `relit --help` stays fast.
"""

from __future__ import annotations

import itertools
import os
import sys
import tempfile
import threading
import traceback
from contextlib import nullcontext, suppress
from pathlib import Path

from relit import __version__
from relit.errors import EXIT_ENVIRONMENT, EXIT_OK, EXIT_USAGE, UserError, did_you_mean

EXIT_BUG, EXIT_INTERRUPTED, EXIT_TERMINATED = 1, 130, 143


def main(argv: list[str] | None = None) -> int:
    """Run one command and return its exit code. A user's mistake is printed, never raised."""
    argv = list(sys.argv[1:] if argv is None else argv)
    from relit.run import stopped_by, termination

    guard = (
        termination() if threading.current_thread() is threading.main_thread() else nullcontext()
    )
    try:
        with guard:
            return _dispatch(argv)
    except BrokenPipeError:
        # the reader closed the pipe; Python's flush at exit must not fail
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_OK
    except BaseException as raised:
        return _answer(stopped_by(raised), argv)


def command() -> None:
    """The `relit` command: ends the process with the exit code of `main`."""
    code = main()
    if code in (EXIT_INTERRUPTED, EXIT_TERMINATED):
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError):
                stream.flush()
        os._exit(code)  # Dr.Jit's threads may still run; a regular exit would abort
    sys.exit(code)


def _answer(error: BaseException, argv: list[str]) -> int:
    """Print what ended the command; returns its exit code."""
    from relit.run import Terminated

    if isinstance(error, UserError):
        return _report(error)
    if isinstance(error, KeyboardInterrupt):
        print("interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    if isinstance(error, Terminated):
        print("terminated", file=sys.stderr)
        return EXIT_TERMINATED
    if isinstance(error, MemoryError):
        what = "out of memory" + (f": {error}" if str(error) else "")
        return _report(
            UserError(
                what,
                fix="use --quality draft or a smaller --max-side, or close other programs",
                code=EXIT_ENVIRONMENT,
            )
        )
    if isinstance(error, Exception):
        return _unexpected(error, argv)
    raise error


def _dispatch(argv: list[str]) -> int:
    from relit.cli.verbs import VERBS, parser_for

    if not argv or argv[0] in ("-h", "--help", "help"):
        print(_overview(VERBS))
        return EXIT_OK
    if argv[0] in ("-V", "--version"):
        print(f"relit {__version__}")
        return EXIT_OK
    verb, rest = argv[0], argv[1:]
    if verb.startswith("-"):
        fix = "relit VERB INPUT flags, for example: relit reconstruct PHOTOS -o RUN"
        raise UserError(f"unknown flag '{verb}' before the verb", fix=fix, code=EXIT_USAGE)
    if verb not in VERBS:
        raise UserError(
            f"unknown verb '{verb}'.{did_you_mean(verb, VERBS)}",
            f"verbs: {', '.join(VERBS)}",
            "relit --help",
            code=EXIT_USAGE,
        )
    args = parser_for(verb, rest).parse(rest)
    if args is None:  # --help was printed
        return EXIT_OK
    return VERBS[verb].act(args) or EXIT_OK


def _overview(verbs: dict) -> str:
    width = max(len(v) for v in verbs)
    lines = [
        "usage: relit VERB INPUT [flags]",
        "",
        "Reconstruct a relightable 3D asset from photographs of an object.",
        "",
    ]
    lines += [f"  {name.ljust(width)}  {verb.summary}" for name, verb in verbs.items()]
    lines += [
        "",
        "relit VERB --help lists the flags of one verb. First steps: relit doctor, then relit demo.",
    ]
    return "\n".join(lines)


def _report(error: UserError) -> int:
    if os.environ.get("RELIT_DEBUG") == "1":
        traceback.print_exception(error, file=sys.stderr)
    print(f"error: {error}", file=sys.stderr)
    return error.code


def _unexpected(error: Exception, argv: list[str]) -> int:
    """A bug of Relit: print one line, write the traceback to a file."""
    if isinstance(error, OSError):
        from relit.files import disk_error

        known = disk_error(
            error, Path(error.filename).parent if isinstance(error.filename, str) else Path.cwd()
        )
        if known:
            return _report(known)
    if os.environ.get("RELIT_DEBUG") == "1":
        traceback.print_exception(error, file=sys.stderr)
    text = (
        f"relit {__version__}: relit {' '.join(argv)}\n{''.join(traceback.format_exception(error))}"
    )
    where = _keep(text, argv)
    message = f"error: {type(error).__name__}: {error}\nwhy: this is a bug in Relit, not in your input\nfix: report it with {where}"
    print(message, file=sys.stderr)
    return EXIT_BUG


def _keep(text: str, argv: list[str]) -> str:
    """Append the traceback to log.txt of the run folder, or write a temporary file. Returns its
    path."""
    for flag, value in itertools.pairwise(argv):
        log = Path(value) / "log.txt"
        if flag in ("-o", "--out") and log.is_file():
            try:
                with log.open("a", encoding="utf-8") as file:
                    file.write(text)
                return str(log)
            except OSError:
                break
    try:
        with tempfile.NamedTemporaryFile(
            "w", prefix="relit-", suffix=".txt", delete=False, encoding="utf-8"
        ) as file:
            file.write(text)
        return file.name
    except OSError:
        return "the traceback that RELIT_DEBUG=1 prints"


if __name__ == "__main__":
    command()
