"""Verbs that measure: evaluate, benchmark."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from relit.cli.parser import Parser, device_flag, job_flags, path_in

RESULTS = Path("benchmarks/results")


def evaluate_flags(parser: Parser) -> None:
    path_in(parser, "run", "run folder or asset folder")
    truth = "folder of relit synthesize, or the capture itself (uses its held-out photos)"
    parser.common.add_argument("--truth", required=True, type=Path, metavar="DIR", help=truth)
    parser.common.add_argument(
        "--json", type=Path, default=None, metavar="FILE", help="write the figures there"
    )
    protocol = "how to measure: relit, or as a paper's released code: sfd, pir, samurai, orb"
    parser.common.add_argument("--protocol", default="relit", metavar="NAME", help=protocol)
    device_flag(parser)
    network = "also LPIPS, by this network of two inputs; needs onnxruntime"
    parser.more.add_argument("--lpips", type=Path, default=None, metavar="FILE.onnx", help=network)
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
    result = evaluate(args.run, args.truth, spp=args.spp, protocol=args.protocol, lpips=args.lpips)
    if args.json:
        args.json.parent.mkdir(parents=True, exist_ok=True)
        write_text(args.json, json.dumps(result, indent=1) + "\n")
    from rich.console import Console

    Console(width=None if sys.stdout.isatty() else 160).print(figures_table(result))


def benchmark_flags(parser: Parser) -> None:
    from relit.benchmark.splits import SPLIT_NAMES
    from relit.benchmark.suites import SUITES

    names = ", ".join(name for name in SUITES if name != "registration")
    parser.add_argument("suite", nargs="?", help=f"{names} or registration")
    job_flags(parser, "standard")
    add = parser.common.add_argument
    add("--json", type=Path, default=None, metavar="FILE", help="write the record of the run there")
    add("--ablate", default="", metavar="NAME,...", help="also run with these parts switched off")
    seeds = "run seeds 0 ... N-1, each with a record in benchmarks/results; resumes"
    add("--seeds", type=int, default=None, metavar="N", help=seeds)
    report = "print RESULTS.md from the records in DIR (default benchmarks/results)"
    add("--report", nargs="?", const=RESULTS, type=Path, default=None, metavar="DIR", help=report)
    split = "objects: tune (settings were chosen on them, default) or report"
    add("--split", choices=SPLIT_NAMES, default="", help=split)
    minutes = "begin no object after so many minutes; the next call with the same --out goes on"
    add("--minutes", type=float, default=None, metavar="N", help=minutes)
    more = parser.more.add_argument
    more("--part", default=None, metavar="K/N", help="measure every N-th object, from the K-th on")
    more("--objects", default="", metavar="NAME,...", help="only these objects of the suite")
    more("--cache", type=Path, default=None, metavar="DIR", help="where rendered captures are kept")
    more(
        "--assets", type=Path, default=None, metavar="DIR", help="folder with assets/ and envmaps/"
    )
    out = "where the runs go, and go on; with --report the file to write"
    more("-o", "--out", type=Path, default=None, metavar="PATH", help=out)


def do_benchmark(args) -> None:
    from relit.benchmark import SuiteOptions, run_seeds, run_suite
    from relit.errors import EXIT_USAGE, UserError
    from relit.files import write_text

    if args.report is not None:
        from relit.benchmark.report import report

        text = report(args.report)
        if args.out is None:
            print(text, end="")
        else:
            write_text(args.out, text)
        return
    if args.suite is None:
        raise UserError("no suite was named", fix="relit benchmark SUITE", code=EXIT_USAGE)
    options = SuiteOptions(
        quality=args.quality,
        split=args.split,
        share=_share(args),
        ablate=[a for a in args.ablate.split(",") if a],
        objects=[o for o in args.objects.split(",") if o],
        device=args.device,
        seed=args.seed or 0,
        cache=args.cache,
        assets=args.assets,
        out=args.out,
        json_file=args.json,
    )
    if args.seeds:
        run_seeds(args.suite, options, args.seeds)
    else:
        run_suite(args.suite, options)


def _share(args):
    """The Share that --part and --minutes name."""
    import math

    from relit.benchmark.progress import Share, parse_part

    part, parts = parse_part(args.part) if args.part else (1, 1)
    return Share(part, parts, math.inf if args.minutes is None else args.minutes)
