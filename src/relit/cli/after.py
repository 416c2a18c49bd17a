"""export, relight, view: what is done with an asset."""

from __future__ import annotations

import argparse
from pathlib import Path

from relit.asset.forms import SUFFIXES, form_of
from relit.cli.parser import DEVICES, Parser, free, out_flag, path_in
from relit.errors import EXIT_USAGE, UserError


def export_flags(parser: Parser) -> None:
    path_in(parser, "run", "run folder or asset folder")
    out_flag(parser, "file (or folder, for mitsuba) to write")
    parser.common.add_argument(
        "--format", choices=tuple(SUFFIXES), default=None, help="default: by the ending of -o"
    )
    parser.more.add_argument("--overwrite", action="store_true", help="replace an existing file")
    parser.more.add_argument(
        "--no-photos", action="store_true", help="html: leave the photos out, a smaller file"
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
    light = "lat-long .hdr or .exr, or spherical Gaussians in a .json"
    parser.common.add_argument("--light", required=True, type=Path, metavar="FILE", help=light)
    out_flag(parser, "folder of pictures, or FILE.mp4")
    add = parser.common.add_argument
    add(
        "--cameras",
        default="capture",
        metavar="WHICH",
        help="capture (default), orbit:N for a turntable, or a transforms.json",
    )
    add("--device", choices=DEVICES, default="auto", help="auto takes the GPU when there is one")
    more = parser.more.add_argument
    more("--spp", type=int, default=64, help="samples a pixel (default 64)")
    more("--size", type=int, default=None, metavar="PIXELS", help="longer side of the pictures")
    more(
        "--rotate",
        type=float,
        default=0.0,
        metavar="DEGREES",
        help="turn the light about the object's up",
    )
    more(
        "--albedo-scale",
        type=scale,
        default=None,
        metavar="S or R,G,B",
        help="multiplies the base colour",
    )
    more("--exr", action="store_true", help="linear EXR pictures besides the PNG ones")
    more("--overwrite", action="store_true", help="replace existing pictures")


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
    with counted("relight, samples a pixel") as progress:
        relight(args.run, args.light, args.out, progress=progress, **options)
    print(args.out)


def view_flags(parser: Parser) -> None:
    path_in(parser, "run", "run folder (one at work too) or asset folder")
    add = parser.common.add_argument
    add("--no-browser", action="store_true", help="print the address only")
    add("--port", type=int, default=0, help="port on 127.0.0.1 (default: a free one)")


def do_view(args) -> None:
    from relit.viewer.serve import run_server, serve_until_stopped

    if not 0 <= args.port <= 65535:
        raise UserError(
            f"--port {args.port} is no port", fix="choose 1024 to 65535", code=EXIT_USAGE
        )
    serve_until_stopped(
        run_server(args.run, args.port), lambda text: print(text, flush=True), not args.no_browser
    )
