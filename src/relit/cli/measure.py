"""Verbs that measure: evaluate, benchmark."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from relit.cli.parser import Parser, device_flag, job_flags, path_in


def evaluate_flags(parser: Parser) -> None:
    path_in(parser, "run", "run folder or asset folder")
    truth = "folder of relit synthesize, or the capture itself (uses its held-out photos)"
    parser.common.add_argument("--truth", required=True, type=Path, metavar="DIR", help=truth)
    parser.common.add_argument(
        "--json", type=Path, default=None, metavar="FILE", help="write the figures there"
    )
    device_flag(parser)
    parser.more.add_argument(
        "--spp",
        type=int,
        default=None,
        help="samples per pixel of the compared images (default 256; 64 for duplicates)",
    )


def do_evaluate(args) -> None:
    from relit.device import use_device
    from relit.evaluate.dispatch import evaluate
    from relit.evaluate.results import figures_table
    from relit.files import write_text

    use_device(args.device)
    result = evaluate(args.run, args.truth, spp=args.spp)
    if args.json:
        args.json.parent.mkdir(parents=True, exist_ok=True)
        write_text(args.json, json.dumps(result, indent=1) + "\n")
    from rich.console import Console

    Console(width=None if sys.stdout.isatty() else 160).print(figures_table(result))


def benchmark_flags(parser: Parser) -> None:
    from relit.benchmark.suites import SUITES

    parser.add_argument("suite", help=f"name of a suite: {', '.join(SUITES)}")
    job_flags(parser, "standard")
    add = parser.common.add_argument
    add("--json", type=Path, default=None, metavar="FILE", help="write the figures there")
    add("--ablate", default="", metavar="NAME,...", help="also run with these parts switched off")
    more = parser.more.add_argument
    more("--objects", default="", metavar="NAME,...", help="only these objects of the suite")
    more("--cache", type=Path, default=None, metavar="DIR", help="where rendered captures are kept")
    more(
        "--assets", type=Path, default=None, metavar="DIR", help="folder with assets/ and envmaps/"
    )
    more("-o", "--out", type=Path, default=None, metavar="DIR", help="where the runs go")


def do_benchmark(args) -> None:
    from relit.benchmark import run_suite

    run_suite(
        args.suite,
        quality=args.quality,
        ablate=[a for a in args.ablate.split(",") if a],
        json_file=args.json,
        device=args.device,
        cache=args.cache,
        assets=args.assets,
        objects=[o for o in args.objects.split(",") if o],
        out=args.out,
        seed=args.seed or 0,
    )
