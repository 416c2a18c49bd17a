"""The verb `weights`: fetch the weights of a network, when asked for."""

from __future__ import annotations

import sys
from pathlib import Path

from relit.cli.parser import Parser


def weights_flags(parser: Parser) -> None:
    parser.add_argument("network", choices=("segmenter",), help="which network")
    source = "take this file in the place of a download"
    parser.common.add_argument(
        "--from", dest="source", type=Path, default=None, metavar="FILE", help=source
    )


def do_weights(args) -> None:
    from relit.masks.weights import SEGMENTER, keep_weights, kept_weights, sum_of

    print(f"{SEGMENTER.name}: {SEGMENTER.size / 1e6:.0f} MB\nlicence: {SEGMENTER.licence}")
    file = kept_weights()
    if file.is_file() and sum_of(file) == SEGMENTER.sha256:
        return print(f"it is there already: {file}")
    if args.source is None:
        print(f"source: {SEGMENTER.url}")

    def progress(done: int, total: int) -> None:
        if sys.stderr.isatty():
            print(f"\r{done / total:4.0%} of {total / 1e6:.0f} MB", end="", file=sys.stderr)

    print(f"kept in: {keep_weights(args.source, progress=progress)}")
