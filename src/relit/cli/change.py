"""edit, insert: a recovered pile with another material, an instance less, a new object."""

from __future__ import annotations

import argparse
from pathlib import Path

from relit.cli.parser import DEVICES, Parser, free, out_flag, path_in
from relit.errors import EXIT_USAGE, UserError


def colour(text: str) -> tuple[float, ...]:
    try:
        values = tuple(float(p) for p in text.split(","))
    except ValueError:
        values = ()
    if len(values) != 3 or not all(0 <= v <= 100 for v in values):
        raise argparse.ArgumentTypeError(f"'{text}' is not R,G,B, each at least 0")
    return values


def pixel(text: str) -> tuple[float, ...]:
    try:
        values = tuple(float(p) for p in text.split(","))
    except ValueError:
        values = ()
    if len(values) != 2:
        raise argparse.ArgumentTypeError(f"'{text}' is not X,Y")
    return values


def edit_flags(parser: Parser) -> None:
    path_in(parser, "run", "run folder or asset folder")
    out_flag(parser, "asset folder to write; with --photo also photo.png in it")
    add, more = parser.common.add_argument, parser.more.add_argument
    add(
        "--photo",
        type=Path,
        default=None,
        metavar="FILE",
        help="a photo of the run, known by its name or content: it is changed as well",
    )
    add("--tint", type=colour, default=None, metavar="R,G,B", help="multiplies the base colour")
    add(
        "--base-color",
        type=colour,
        default=None,
        metavar="R,G,B",
        help="linear, in place of the texture",
    )
    add("--roughness", type=float, default=None, help="a constant in place of the map")
    add("--metallic", type=float, default=None, help="a constant in place of the map")
    add(
        "--remove",
        type=int,
        nargs="*",
        default=[],
        metavar="LABEL",
        help="instances to take away; labels beside --photo say exactly where they are",
    )
    add("--device", choices=DEVICES, default="auto", help="auto takes the GPU when there is one")
    more("--spp", type=int, default=64, help="samples a pixel (default 64)")
    more("--overwrite", action="store_true", help="replace what is there")


def do_edit(args) -> None:
    if args.base_color is not None and max(args.base_color) > 1:
        raise UserError(
            "--base-color has a value above 1",
            "a surface reflects no more than it receives",
            code=EXIT_USAGE,
        )
    free(args.out, args.overwrite)
    from relit.device import use_device
    from relit.log import counted

    use_device(args.device)
    from relit.edit import edit

    names = ("photo", "tint", "base_color", "roughness", "metallic", "remove", "spp")
    with counted("edit, thousands of pixels") as progress:
        written = edit(
            args.run, args.out, **{name: getattr(args, name) for name in names}, progress=progress
        )
    for path in written:
        print(path)


def insert_flags(parser: Parser) -> None:
    path_in(parser, "run", "run folder or asset folder of a duplicates capture")
    out_flag(parser, "picture to write")
    add, more = parser.common.add_argument, parser.more.add_argument
    add(
        "--photo",
        type=Path,
        required=True,
        metavar="FILE",
        help="a photo of the run, known by its name or content",
    )
    add(
        "--model",
        type=Path,
        required=True,
        metavar="FILE",
        help=".glb, .gltf, .obj or an asset folder",
    )
    add(
        "--at",
        type=pixel,
        required=True,
        metavar="X,Y",
        help="pixel of the photo where it stands on the ground",
    )
    add(
        "--size",
        type=float,
        default=1.0,
        help="of its bounding sphere, in that of the recovered object (default 1)",
    )
    add("--turn", type=float, default=0.0, metavar="DEGREES", help="about the vertical")
    add("--device", choices=DEVICES, default="auto", help="auto takes the GPU when there is one")
    more("--spp", type=int, default=128, help="samples a pixel (default 128)")
    more("--overwrite", action="store_true", help="replace what is there")


def do_insert(args) -> None:
    free(args.out, args.overwrite)
    from relit.device import use_device
    from relit.log import counted

    use_device(args.device)
    from relit.edit import insert

    names = ("photo", "at", "size", "turn", "spp")
    with counted("insert, thousands of pixels") as progress:
        written = insert(
            args.run,
            args.model,
            args.out,
            **{name: getattr(args, name) for name in names},
            progress=progress,
        )
    print(written)
