"""Verbs around a reconstruction: doctor, demo, inspect, reconstruct, quadrants.

Heavy modules are imported inside the functions.
"""

from __future__ import annotations

import json
from pathlib import Path

from relit.cli.parser import (
    OPENING,
    Parser,
    capture_flag,
    device_flag,
    free,
    job_flags,
    opening_flags,
    out_flag,
    overwrite_flag,
    path_in,
    quality_flag,
)

# ---------------------------------------------------------------- doctor, demo, inspect


def doctor_flags(parser: Parser) -> None:
    parser.common.add_argument("--json", action="store_true", help="print JSON")


def do_doctor(args) -> int:
    from relit import doctor

    checks = doctor.examine()
    print(doctor.doctor_json(checks) if args.json else doctor.doctor_text(checks))
    return doctor.doctor_exit_code(checks)


def demo_flags(parser: Parser) -> None:
    out_flag(
        parser, "output folder for the capture and the run (default runs/demo)", Path("runs/demo")
    )
    device_flag(parser)
    overwrite_flag(parser, "replace an earlier demo")


def do_demo(args) -> None:
    from relit.demo import demo

    demo(args.out, device=args.device, overwrite=args.overwrite)


def inspect_flags(parser: Parser) -> None:
    path_in(parser, "input", "folder of photos, transforms.json, COLMAP model, ...")
    parser.common.add_argument("--json", action="store_true", help="print JSON")
    capture_flag(parser)
    quality_flag(parser, "standard", "quality for the estimate of time and memory")
    parser.common.add_argument(
        "--plot",
        type=Path,
        default=None,
        metavar="FILE.svg",
        help="plot the cameras around the object sphere",
    )
    parser.common.add_argument(
        "--html",
        type=Path,
        default=None,
        metavar="FILE.html",
        help="write a page with images of all checks",
    )
    parser.more.add_argument(
        "--edit",
        action="store_true",
        help="open a page to correct masks and the object sphere",
    )
    parser.more.add_argument(
        "--port", type=int, default=0, help="port of --edit on 127.0.0.1 (default: any free port)"
    )
    parser.more.add_argument(
        "--no-browser",
        action="store_true",
        help="with --edit: print the address; do not open a browser",
    )
    opening_flags(parser)


def do_inspect(args) -> None:
    from relit.job import Job
    from relit.preflight.inspect import inspect_input, inspection_text

    for path in (args.plot, args.html):
        if path is not None:
            free(path, overwrite=False)
    names = ("capture", "quality", *OPENING)
    job = Job(**{name: value for name in names if (value := getattr(args, name)) is not None})
    if args.edit:
        from relit.job import open_as
        from relit.viewer.correct import correction_server
        from relit.viewer.serve import serve_until_stopped

        server = correction_server(open_as(args.input, job)[0], args.port)
        return serve_until_stopped(
            server, lambda text: print(text, flush=True), not args.no_browser
        )
    found = inspect_input(args.input, job, args.plot, args.html)
    print(json.dumps(found, indent=2) if args.json else inspection_text(found))


# ---------------------------------------------------------------- reconstruct


def reconstruct_flags(parser: Parser) -> None:
    path_in(
        parser, "input", "folder of photos, transforms.json, COLMAP model, ... (docs/formats.md)"
    )
    out_flag(parser, "run folder; the same command again resumes")
    add = parser.common.add_argument
    capture_flag(parser)
    job_flags(parser, None)
    add(
        "-s",
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        dest="pairs",
        help="set one option of the recipe; may be repeated",
    )
    add(
        "-c",
        "--config",
        type=Path,
        default=None,
        metavar="FILE.toml",
        help="settings from a file or a run's config.toml; flags override it",
    )
    opening_flags(parser)
    overwrite_flag(parser, "delete an earlier run in the folder and start again")
    parser.more.add_argument(
        "--force",
        action="store_true",
        help="keep a result that the photos do not bear out (exit code 4 otherwise)",
    )
    parser.more.add_argument(
        "--until",
        default="",
        metavar="STAGE",
        help="stop after this stage, for example poses; the run goes on without it",
    )


def do_reconstruct(args) -> None:
    from relit.reconstruction import reconstruct

    asset = reconstruct(
        args.input,
        args.out,
        capture=args.capture,
        quality=args.quality,
        device=args.device,
        seed=args.seed,
        pairs=args.pairs,
        config=args.config,
        **{name: getattr(args, name) for name in OPENING},
        overwrite=args.overwrite,
        force=args.force,
        until=args.until,
    )
    print(asset if args.until else asset / "object.glb")


# ---------------------------------------------------------------- quadrants


def quadrants_flags(parser: Parser) -> None:
    path_in(parser, "input", "folder of photos of a collection")
    parser.common.add_argument(
        "--terminal", action="store_true", help="use the terminal instead of a page"
    )
    parser.common.add_argument(
        "--guess",
        metavar="RUN",
        help="suggest answers from the cameras of a finished run; Enter accepts",
    )
    parser.more.add_argument(
        "--port", type=int, default=0, help="port of the page on 127.0.0.1 (default: any free port)"
    )
    parser.more.add_argument(
        "--no-browser", action="store_true", help="print the address; do not open a browser"
    )


def do_quadrants(args) -> None:
    from relit.capture.open import open_capture
    from relit.viewer.quadrants import ask_in_terminal, guesses_of, quadrant_server
    from relit.viewer.serve import serve_until_stopped

    capture = open_capture(args.input, masks="none", min_photos=1)
    guesses = guesses_of(args.guess) if args.guess else {}
    if args.terminal:
        return print(ask_in_terminal(capture, guesses=guesses))
    return serve_until_stopped(
        quadrant_server(capture, args.port, guesses),
        lambda text: print(text, flush=True),
        not args.no_browser,
    )
