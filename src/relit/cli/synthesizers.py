"""The verb synthesize: one entry of SYNTHESIZERS for each kind of capture, with its own flags.

A new kind adds a flags function, an act and its entry here.
"""

from __future__ import annotations

from pathlib import Path

from relit.cli.parser import Kind, Parser, device_flag, out_flag, relight_flag
from relit.cli.photographed import PHOTOGRAPHED, delivery_flags, delivery_of
from relit.errors import EXIT_USAGE, UserError


def synthesize_flags(parser: Parser) -> None:
    """Flags of every kind."""
    parser.add_argument(
        "kind",
        choices=tuple(SYNTHESIZERS),
        help=f"{', '.join(SYNTHESIZERS)}: each has its own --help",
    )
    add = parser.common.add_argument
    add(
        "--asset",
        required=True,
        type=Path,
        metavar="FILE",
        help="model: .glb, .gltf, .obj, or procedural:SEED[:KIND]",
    )
    out_flag(parser, "output folder")
    device_flag(parser)
    more = parser.more.add_argument
    more("--seed", type=int, default=0, help="random seed (default 0)")
    more("--roughness", type=float, default=None, help="constant in place of the file's texture")
    more("--metallic", type=float, default=None, help="constant in place of the file's texture")


def do_synthesize(args) -> None:
    from relit.synthesize.objects import object_file

    args.asset = object_file(args.asset)
    SYNTHESIZERS[args.kind].act(args)
    print(args.out)


def sampling_flags(
    parser: Parser, *, views: int, test_views: int, resolution: int, spp: int, test_spp: int
) -> None:
    """Number, size and samples of the images; the arguments are the defaults."""
    add, more = parser.common.add_argument, parser.more.add_argument
    add("--views", type=int, default=views, help=f"training photos (default {views})")
    add("--test-views", type=int, default=test_views, help=f"test photos (default {test_views})")
    more(
        "--resolution", type=int, default=resolution, help=f"pixels per side (default {resolution})"
    )
    more(
        "--spp", type=int, default=spp, help=f"samples per pixel of training photos (default {spp})"
    )
    more(
        "--test-spp",
        type=int,
        default=test_spp,
        help=f"samples per pixel of test images (default {test_spp})",
    )


def renderer_flag(parser: Parser) -> None:
    """--renderer, of the truth."""
    from relit.synthesize.renderers import RENDERERS

    parser.common.add_argument(
        "--renderer",
        choices=RENDERERS,
        default="relit",
        help="renderer of the truth: relit (default), mitsuba (principled) or cycles (Blender)",
    )


# ---------------------------------------------------------------- multiview


def multiview_flags(parser: Parser) -> None:
    add = parser.common.add_argument
    add(
        "--light",
        required=True,
        type=Path,
        nargs="+",
        metavar="FILE",
        help="light: lat-long .hdr or .exr",
    )
    relight_flag(parser)
    renderer_flag(parser)
    sampling_flags(parser, views=60, test_views=12, resolution=400, spp=64, test_spp=256)
    delivery_flags(parser)


def multiview(args) -> None:
    if len(args.light) != 1:
        raise UserError(
            "a multiview capture has one light",
            fix="give one file to --light, other lights to --relight",
            code=EXIT_USAGE,
        )
    from relit.device import use_device
    from relit.log import Log
    from relit.synthesize.multiview import synthesize_multiview

    use_device(args.device)
    synthesize_multiview(
        args.asset,
        args.light[0],
        args.out,
        views=args.views,
        test_views=args.test_views,
        relights=args.relight,
        resolution=args.resolution,
        spp=args.spp,
        test_spp=args.test_spp,
        seed=args.seed,
        renderer=args.renderer,
        roughness=args.roughness,
        metallic=args.metallic,
        delivery=delivery_of(args),
        say=Log().say,
    )


# ---------------------------------------------------------------- flash


def flash_flags(parser: Parser) -> None:
    more = parser.more.add_argument
    sampling_flags(parser, views=120, test_views=20, resolution=400, spp=64, test_spp=256)
    more(
        "--node",
        nargs="*",
        default=[],
        metavar="NAME",
        help="nodes of a .glb to use (default: all)",
    )
    more(
        "--flash-offset",
        type=float,
        nargs=3,
        default=None,
        metavar=("X", "Y", "Z"),
        help="offset of the flash: right, down, forward (default -.11 -.06 0)",
    )
    more("--png", action="store_true", help="write photos as 8-bit PNG instead of linear EXR")
    more("--paint", default="own", help="colours: own (default), dark or bright")
    more(
        "--material",
        default="plastic",
        help="plastic (default), or own: the file's by Mitsuba's principled",
    )
    more(
        "--ambient",
        type=float,
        default=0.0,
        metavar="SHARE",
        help="light of the room, by --light, as a share of the flash's (default 0)",
    )
    more("--light", type=Path, nargs=1, default=(), metavar="FILE", help="light of the room")


def flash(args) -> None:
    if args.roughness is not None or args.metallic is not None:
        raise UserError(
            "the roughness of a flash capture is generated with the object",
            fix="leave out --roughness and --metallic",
            code=EXIT_USAGE,
        )
    from relit.device import use_device
    from relit.log import Log
    from relit.synthesize.flash import OFFSET, synthesize_flash

    use_device(args.device)
    synthesize_flash(
        args.asset,
        args.light,
        args.out,
        views=args.views,
        test_views=args.test_views,
        nodes=args.node,
        resolution=args.resolution,
        spp=args.spp,
        test_spp=args.test_spp,
        seed=args.seed,
        offset=args.flash_offset or OFFSET,
        png=args.png,
        paint=args.paint,
        material=args.material,
        ambient=args.ambient,
        say=Log().say,
    )


# ---------------------------------------------------------------- collection


def collection_flags(parser: Parser) -> None:
    add = parser.common.add_argument
    add(
        "--light",
        required=True,
        type=Path,
        nargs="+",
        metavar="FILE",
        help="lights: lat-long .hdr or .exr; each photo uses one",
    )
    relight_flag(parser)
    renderer_flag(parser)
    sampling_flags(parser, views=60, test_views=6, resolution=400, spp=48, test_spp=192)
    more = parser.more.add_argument
    more(
        "--rough-masks",
        type=float,
        default=1.0,
        metavar="PIXELS",
        help="amplitude of the error of mask outlines (default 1)",
    )
    more(
        "--roll",
        type=float,
        default=12.0,
        metavar="DEGREES",
        help="largest turn of a camera about its axis (default 12)",
    )
    more(
        "--wrong-hints",
        type=float,
        default=0.0,
        metavar="SHARE",
        help="photos whose answers in quadrants.json are wrong (default 0)",
    )
    more(
        "--occluders",
        type=float,
        default=0.0,
        metavar="SHARE",
        help="photos with a hand or a stand in front of the object (default 0)",
    )


def collection(args) -> None:
    from relit.device import use_device
    from relit.log import Log
    from relit.synthesize.collection import synthesize_collection

    use_device(args.device)
    synthesize_collection(
        args.asset,
        args.light,
        args.out,
        views=args.views,
        test_views=args.test_views,
        resolution=args.resolution,
        spp=args.spp,
        test_spp=args.test_spp,
        seed=args.seed,
        roughness=args.roughness,
        metallic=args.metallic,
        rough_masks=args.rough_masks,
        relights=args.relight,
        renderer=args.renderer,
        roll=args.roll,
        wrong_hints=args.wrong_hints,
        occluders=args.occluders,
        say=Log().say,
    )


# ---------------------------------------------------------------- duplicates


def duplicates_flags(parser: Parser) -> None:
    add, more = parser.common.add_argument, parser.more.add_argument
    add(
        "--light",
        required=True,
        type=Path,
        nargs="+",
        metavar="FILE",
        help="light: lat-long .hdr or .exr",
    )
    relight_flag(parser)
    renderer_flag(parser)
    add("--count", type=int, default=10, help="objects in the photo (default 10)")
    add("--photos", type=int, default=1, help="photos of the pile (default 1)")
    add("--test-views", type=int, default=8, help="novel views of the pile (default 8)")
    more("--resolution", type=int, default=1600, help="pixels per side of the photo (default 1600)")
    more(
        "--test-resolution",
        type=int,
        default=400,
        help="pixels per side of the novel views (default 400)",
    )
    more("--spp", type=int, default=64, help="samples per pixel of the photo (default 64)")
    more(
        "--test-spp",
        type=int,
        default=128,
        help="samples per pixel of test images (default 128)",
    )
    more(
        "--lean",
        type=float,
        default=12.0,
        metavar="DEGREES",
        help="standard deviation of the tilt away from the resting pose (default 12)",
    )
    more("--spread", type=float, default=1.0, help="factor on the radius of the pile (default 1)")
    more(
        "--node",
        nargs="*",
        default=[],
        metavar="NAME",
        help="nodes of a .glb to use (default: all)",
    )


def duplicates(args) -> None:
    if len(args.light) != 1:
        raise UserError(
            "a photo of duplicates has one light",
            fix="give one file to --light, other lights to --relight",
            code=EXIT_USAGE,
        )
    from relit.device import use_device
    from relit.log import Log
    from relit.synthesize.duplicates import synthesize_duplicates

    use_device(args.device)
    synthesize_duplicates(
        args.asset,
        args.light[0],
        args.out,
        count=args.count,
        renderer=args.renderer,
        photos=args.photos,
        test_views=args.test_views,
        relights=args.relight,
        resolution=args.resolution,
        test_resolution=args.test_resolution,
        spp=args.spp,
        test_spp=args.test_spp,
        seed=args.seed,
        lean=args.lean,
        spread=args.spread,
        nodes=args.node,
        roughness=args.roughness,
        metallic=args.metallic,
        say=Log().say,
    )


SYNTHESIZERS: dict[str, Kind] = {
    "multiview": Kind(multiview_flags, multiview),
    "flash": Kind(flash_flags, flash),
    "collection": Kind(collection_flags, collection),
    "duplicates": Kind(duplicates_flags, duplicates),
    **PHOTOGRAPHED,
}
