"""doctor, demo, inspect, reconstruct, quadrants: flags, and the function that each calls. Heavy
imports stand inside the functions."""

from __future__ import annotations

import json
from pathlib import Path

from relit.cli.parser import (
    DEVICES,
    OPENING,
    QUALITIES,
    Parser,
    capture_flag,
    free,
    job_flags,
    opening_flags,
    out_flag,
    path_in,
)

# ---------------------------------------------------------------- doctor, demo, inspect


def doctor_flags(parser: Parser) -> None:
    parser.common.add_argument("--json", action="store_true", help="print JSON")


def do_doctor(args) -> int:
    from relit import doctor

    checks = doctor.examine()
    print(doctor.as_json(checks) if args.json else doctor.as_text(checks))
    return doctor.verdict(checks)


def demo_flags(parser: Parser) -> None:
    out_flag(parser, "folder for the capture and the run (default runs/demo)", Path("runs/demo"))
    parser.common.add_argument(
        "--device", choices=DEVICES, default="auto", help="auto takes the GPU when there is one"
    )
    parser.common.add_argument(
        "--overwrite",
        action="store_true",
        help="begin anew where an earlier demo is complete or was stopped",
    )


def do_demo(args) -> None:
    from relit.demo import demo

    demo(args.out, device=args.device, overwrite=args.overwrite)


def inspect_flags(parser: Parser) -> None:
    path_in(parser, "input", "folder of photos, transforms.json, COLMAP model, ...")
    parser.common.add_argument("--json", action="store_true", help="print JSON")
    capture_flag(parser)
    parser.common.add_argument(
        "--quality",
        choices=QUALITIES,
        default="standard",
        help="for the estimate of time and memory",
    )
    parser.common.add_argument(
        "--plot",
        type=Path,
        default=None,
        metavar="FILE.svg",
        help="draw the cameras around the object sphere",
    )
    parser.common.add_argument(
        "--html",
        type=Path,
        default=None,
        metavar="FILE.html",
        help="a page with all that was looked at",
    )
    parser.more.add_argument(
        "--edit",
        action="store_true",
        help="open a page where masks are painted and the object is boxed",
    )
    parser.more.add_argument(
        "--port", type=int, default=0, help="of --edit, on 127.0.0.1 (default: a free one)"
    )
    parser.more.add_argument(
        "--no-browser", action="store_true", help="of --edit: print the address only"
    )
    opening_flags(parser)


def do_inspect(args) -> None:
    from relit.job import Job
    from relit.preflight.inspect import as_text, inspect

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
    found = inspect(args.input, job, args.plot, args.html)
    print(json.dumps(found, indent=2) if args.json else as_text(found))


# ---------------------------------------------------------------- reconstruct


def reconstruct_flags(parser: Parser) -> None:
    path_in(
        parser, "input", "folder of photos, transforms.json, COLMAP model, ... (docs/formats.md)"
    )
    out_flag(parser, "run folder; giving the same command again resumes")
    add = parser.common.add_argument
    capture_flag(parser)
    job_flags(parser, None)
    add(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        dest="pairs",
        help="one setting of the recipe; may be repeated",
    )
    add(
        "--config",
        type=Path,
        default=None,
        metavar="FILE.toml",
        help="settings from a file, a run's config.toml too; flags win",
    )
    opening_flags(parser)
    parser.more.add_argument(
        "--overwrite",
        action="store_true",
        help="remove what an earlier run left in the folder and begin anew",
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
    )
    print(asset / "object.glb")


# ---------------------------------------------------------------- quadrants


def quadrants_flags(parser: Parser) -> None:
    path_in(parser, "input", "folder of the photos of a collection")
    parser.common.add_argument(
        "--terminal", action="store_true", help="ask in the terminal instead of a page"
    )
    parser.common.add_argument(
        "--guess",
        metavar="RUN",
        help="fill in what the cameras of a finished run say; Enter takes it",
    )
    parser.more.add_argument(
        "--port", type=int, default=0, help="of the page, on 127.0.0.1 (default: a free one)"
    )
    parser.more.add_argument(
        "--no-browser", action="store_true", help="print the page's address only"
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
