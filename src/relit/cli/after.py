"""Verbs that use an asset: export, relight, view."""

from __future__ import annotations

import argparse
from pathlib import Path

from relit.asset.forms import SUFFIXES, form_of
from relit.cli.parser import Parser, device_flag, free, out_flag, overwrite_flag, path_in
from relit.errors import EXIT_USAGE, UserError


def export_flags(parser: Parser) -> None:
    path_in(parser, "run", "run folder or asset folder")
    out_flag(parser, "output file (folder for mitsuba)")
    parser.common.add_argument(
        "--format",
        choices=tuple(SUFFIXES),
        default=None,
        help="format (default: from the suffix of -o)",
    )
    overwrite_flag(parser)
    parser.more.add_argument(
        "--no-photos", action="store_true", help="html: omit the photos for a smaller file"
    )


def do_export(args) -> None:
    kind = form_of(args.out, args.format)
    free(args.out, args.overwrite)
    if kind == "html":
        from relit.viewer.export_html import export_html

        export_html(args.run, args.out, photos=not args.no_photos)
    else:
        from relit.asset.export import export_asset

        export_asset(args.run, kind, args.out)
    print(args.out)


def scale(text: str) -> tuple[float, ...]:
    try:
        values = tuple(float(p) for p in text.split(","))
    except ValueError:
        values = ()
    if len(values) not in (1, 3) or not all(0 < v < 1e6 for v in values):
        raise argparse.ArgumentTypeError(f"'{text}' is not one number or R,G,B, each above 0")
    return values


def relight_flags(parser: Parser) -> None:
    path_in(parser, "run", "run folder or asset folder")
    light = "light: lat-long .hdr or .exr, or spherical Gaussians as .json"
    parser.common.add_argument("--light", required=True, type=Path, metavar="FILE", help=light)
    out_flag(parser, "output folder of images, or FILE.mp4")
    add = parser.common.add_argument
    add(
        "--cameras",
        default="capture",
        metavar="WHICH",
        help="cameras: capture (default), orbit:N for a turntable, or a transforms.json",
    )
    device_flag(parser)
    more = parser.more.add_argument
    more("--spp", type=int, default=64, help="samples per pixel (default 64)")
    more("--size", type=int, default=None, metavar="PIXELS", help="longer side of the images")
    more(
        "--rotate",
        type=float,
        default=0.0,
        metavar="DEGREES",
        help="rotate the light about the object's up axis",
    )
    more(
        "--albedo-scale",
        type=scale,
        default=None,
        metavar="S or R,G,B",
        help="factor on the base colour",
    )
    more("--exr", action="store_true", help="also write linear EXR images")
    overwrite_flag(parser)


def do_relight(args) -> None:
    free(args.out, args.overwrite)
    from relit.device import use_device
    from relit.log import counted

    use_device(args.device)
    from relit.relight import relight

    options = {
        "cameras": args.cameras,
        "spp": args.spp,
        "size": args.size,
        "exr": args.exr,
        "rotate": args.rotate,
    }
    options["albedo_scale"] = args.albedo_scale
    with counted("relight, samples per pixel") as progress:
        relight(args.run, args.light, args.out, progress=progress, **options)
    print(args.out)


def view_flags(parser: Parser) -> None:
    path_in(parser, "run", "run folder (running or finished) or asset folder")
    add = parser.common.add_argument
    add("--no-browser", action="store_true", help="print the address; do not open a browser")
    add("--port", type=int, default=0, help="port on 127.0.0.1 (default: any free port)")


def do_view(args) -> None:
    from relit.viewer.serve import run_server, serve_until_stopped

    if not 0 <= args.port <= 65535:
        raise UserError(
            f"--port {args.port} is not a port", fix="choose 1024 to 65535", code=EXIT_USAGE
        )
    serve_until_stopped(
        run_server(args.run, args.port), lambda text: print(text, flush=True), not args.no_browser
    )
