"""The parser of one verb: argparse with UserError messages, and the flags that several verbs share."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from relit.errors import EXIT_USAGE, UserError, did_you_mean

QUALITIES = ("draft", "standard", "high")
DEVICES = ("auto", "cpu", "cuda")
KINDS = ("multiview", "flash", "duplicates", "collection")


@dataclass(frozen=True)
class Kind:
    """One kind of capture of a verb. flags: adds the kind's own flags to the verb's parser. act:
    runs the verb for this kind."""

    flags: Callable[[Parser], None]
    act: Callable[[argparse.Namespace], int | None]


@dataclass(frozen=True)
class Verb:
    """One verb. summary: one line for the overview. flags: adds arguments to a parser. act: runs
    the verb. kinds: for a verb whose first positional is a kind of capture, one entry per kind."""

    summary: str
    flags: Callable[[Parser], None]
    act: Callable[[argparse.Namespace], int | None]
    kinds: Mapping[str, Kind] = field(default_factory=dict[str, Kind])

    def kind_in(self, argv: Sequence[str]) -> str:
        """The kind named in argv: the first word that is a kind and does not follow a flag; otherwise
        the first kind."""
        for before, word in zip(("", *argv), argv, strict=False):
            if word in self.kinds and (not before.startswith("-") or "=" in before):
                return word
        return next(iter(self.kinds))


class Parser(argparse.ArgumentParser):
    """argparse that raises UserError with a suggestion. `common` and `more` are the two groups of
    the help."""

    def __init__(self, verb: str, summary: str):
        super().__init__(
            prog=f"relit {verb}",
            description=f"{summary[0].upper()}{summary[1:]}.",
            allow_abbrev=False,
        )
        self.verb = verb
        self.common = self.add_argument_group("common flags")
        self.more = self.add_argument_group("more flags")

    def parse(self, argv: list[str]) -> argparse.Namespace | None:
        """Parsed arguments, or None after --help has been printed."""
        if "-h" in argv or "--help" in argv:
            self.print_help()
            return None
        argv = self._joined(argv)
        known = {o for a in self._actions for o in a.option_strings}
        for word in argv:
            if word.startswith("--") and word.split("=")[0] not in known:
                self._refuse(word)
        args, left = self.parse_known_args(argv)
        if left:
            self._refuse(left[0])
        return args

    def _joined(self, argv: list[str]) -> list[str]:
        """A value that begins with a minus and a digit is joined to its flag: argparse would take
        it for a flag."""
        taking = {
            o
            for a in self._actions
            for o in a.option_strings
            if o.startswith("--") and a.nargs is None
        }
        out: list[str] = []
        for word in argv:
            if out and out[-1] in taking and re.match(r"-[\d.]", word):
                out[-1] += f"={word}"
            else:
                out.append(word)
        return out

    def error(self, message: str):
        missing = re.match(r"the following arguments are required: (.*)", message)
        what = f"missing argument: {missing.group(1)}" if missing else message
        raise UserError(
            f"relit {self.verb}: {what}", fix=f"relit {self.verb} --help", code=EXIT_USAGE
        )

    def _check_value(self, action: argparse.Action, value: object) -> None:
        if action.choices is not None and value not in action.choices:
            name = action.option_strings[-1] if action.option_strings else action.dest
            what = f"relit {self.verb}: {name} {value} is not known.{did_you_mean(str(value), action.choices)}"
            raise UserError(what, f"one of: {', '.join(action.choices)}", code=EXIT_USAGE)

    def _refuse(self, word: str):
        flag = word.split("=")[0]
        flags = [o for a in self._actions for o in a.option_strings if o.startswith("--")]
        if word.startswith("-"):
            what = f"relit {self.verb}: unknown flag '{flag}'.{did_you_mean(flag, flags)}"
        else:
            what = f"relit {self.verb}: unexpected argument '{word}'"
        raise UserError(what, fix=f"relit {self.verb} --help", code=EXIT_USAGE)


def path_in(parser: Parser, name: str, text: str) -> None:
    parser.add_argument(name, type=Path, help=text)


def out_flag(parser: Parser, text: str, default: Path | None = None) -> None:
    parser.common.add_argument(
        "-o",
        "--out",
        type=Path,
        required=default is None,
        default=default,
        metavar="PATH",
        help=text,
    )


def device_flag(parser: Parser) -> None:
    text = "compute device; auto uses the GPU if there is one (default)"
    parser.common.add_argument("-d", "--device", choices=DEVICES, default="auto", help=text)


def relight_flag(parser: Parser) -> None:
    parser.common.add_argument(
        "--relight",
        type=Path,
        nargs="*",
        default=[],
        metavar="FILE",
        help="lights of the relighting ground truth",
    )


def overwrite_flag(parser: Parser, text: str = "replace existing output") -> None:
    parser.more.add_argument("-f", "--overwrite", action="store_true", help=text)


def quality_flag(parser: Parser, default: str | None, text: str) -> None:
    parser.common.add_argument("-q", "--quality", choices=QUALITIES, default=default, help=text)


def job_flags(parser: Parser, quality: str | None) -> None:
    """Quality, device and seed of a reconstruction."""
    quality_flag(parser, quality, "draft (about a minute), standard (default) or high")
    device_flag(parser)
    text = "random seed; on the CPU results repeat within tolerance (default 0)"
    parser.common.add_argument("--seed", type=int, default=None, help=text)


def capture_flag(parser: Parser) -> None:
    parser.common.add_argument(
        "--capture",
        choices=("auto", *KINDS),
        default=None,
        help="kind of photos (default auto)",
    )


OPENING = ("masks", "sphere", "max_side", "focal")  # `opening_flags`; fields of `relit.job.Job`


def opening_flags(parser: Parser) -> None:
    """Flags that control how the input is read."""
    add = parser.more.add_argument
    add(
        "--masks",
        default=None,
        metavar="HOW",
        help="auto (default), none, alpha, files, threshold, grabcut, segment[:NETWORK]",
    )
    add(
        "--sphere",
        type=sphere,
        default=None,
        metavar="X,Y,Z,R",
        help="sphere that contains the object, in the frame and unit of the cameras",
    )
    add(
        "--max-side",
        type=int,
        default=None,
        metavar="PIXELS",
        help="downscale photos to at most this longer side",
    )
    add(
        "--focal",
        type=float,
        default=None,
        metavar="PIXELS",
        help="focal length of photos without cameras",
    )


def sphere(text: str) -> tuple[float, ...]:
    parts = text.split(",")
    try:
        values = tuple(float(p) for p in parts)
    except ValueError:
        values = ()
    if len(values) != 4 or not values[3] > 0:
        raise argparse.ArgumentTypeError(f"'{text}' is not X,Y,Z,RADIUS")
    return values


def free(path: Path, overwrite: bool) -> None:
    """Refuse an existing file or a non-empty folder, so that nothing is overwritten silently."""
    taken = path.is_file() or (path.is_dir() and any(path.iterdir()))
    if taken and not overwrite:
        raise UserError(
            "the output already exists; nothing was overwritten",
            fix=f"give another -o, or --overwrite: {path}",
        )
    path.parent.mkdir(parents=True, exist_ok=True)
