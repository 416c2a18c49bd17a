"""Verbs that change a scene: edit (material, instances), insert (a new object)."""

from __future__ import annotations

import argparse
from pathlib import Path

from relit.cli.parser import Parser, device_flag, free, out_flag, overwrite_flag, path_in
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
    out_flag(parser, "output asset folder; with --photo also photo.png in it")
    add, more = parser.common.add_argument, parser.more.add_argument
    add(
        "--photo",
        type=Path,
        default=None,
        metavar="FILE",
        help="photo of the run to edit, matched by name or content",
    )
    add("--tint", type=colour, default=None, metavar="R,G,B", help="factor on the base colour")
    add(
        "--base-color",
        type=colour,
        default=None,
        metavar="R,G,B",
        help="constant base colour, linear",
    )
    add("--roughness", type=float, default=None, help="constant roughness")
    add("--metallic", type=float, default=None, help="constant metallic")
    add(
        "--remove",
        type=int,
        nargs="*",
        default=[],
        metavar="LABEL",
        help="instances to remove; labels beside --photo give their exact outlines",
    )
    device_flag(parser)
    more("--spp", type=int, default=64, help="samples per pixel (default 64)")
    overwrite_flag(parser)


def do_edit(args) -> None:
    if args.base_color is not None and max(args.base_color) > 1:
        raise UserError(
            "--base-color has a value above 1",
            "a surface cannot reflect more light than it receives",
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
    out_flag(parser, "output image")
    add, more = parser.common.add_argument, parser.more.add_argument
    add(
        "--photo",
        type=Path,
        required=True,
        metavar="FILE",
        help="photo of the run, matched by name or content",
    )
    add(
        "--model",
        type=Path,
        required=True,
        metavar="FILE",
        help="model to insert: .glb, .gltf, .obj or an asset folder",
    )
    add(
        "--at",
        type=pixel,
        required=True,
        metavar="X,Y",
        help="pixel of the photo where the model touches the ground",
    )
    add(
        "--size",
        type=float,
        default=1.0,
        help="size of its bounding sphere, relative to the recovered object (default 1)",
    )
    add("--turn", type=float, default=0.0, metavar="DEGREES", help="rotation about the vertical")
    device_flag(parser)
    more("--spp", type=int, default=128, help="samples per pixel (default 128)")
    overwrite_flag(parser)


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
