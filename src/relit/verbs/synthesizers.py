"""synthesize: one entry of SYNTHESIZERS for each kind of capture that can be rendered, with its own flags.

A new kind adds a flags function, an act and its entry here.
"""

from __future__ import annotations

from pathlib import Path

from relit.errors import EXIT_USAGE, UserError
from relit.verbs.parser import DEVICES, KINDS, Kind, Parser, out_flag


def synthesize_flags(parser: Parser) -> None:
    """What every kind takes."""
    parser.add_argument("kind", choices=KINDS, help="kind of capture; each has flags of its own: relit synthesize KIND --help")
    add = parser.common.add_argument
    add("--asset", required=True, type=Path, metavar="FILE", help=".glb, .gltf or .obj")
    out_flag(parser, "folder to write")
    add("--device", choices=DEVICES, default="auto", help="auto takes the GPU when there is one")
    more = parser.more.add_argument
    more("--seed", type=int, default=0, help="default 0")
    more("--roughness", type=float, default=None, help="constant instead of the file's map")
    more("--metallic", type=float, default=None, help="constant instead of the file's map")


def do_synthesize(args) -> None:
    if args.kind not in SYNTHESIZERS:
        what = f"synthesize {args.kind} is not available in this version"
        raise UserError(what, f"captures that can be rendered: {', '.join(SYNTHESIZERS)}", code=EXIT_USAGE)
    SYNTHESIZERS[args.kind].act(args)
    print(args.out)


def sampling_flags(parser: Parser, *, views: int, test_views: int, resolution: int, spp: int, test_spp: int) -> None:
    """How many pictures of what size; the arguments are the defaults."""
    add, more = parser.common.add_argument, parser.more.add_argument
    add("--views", type=int, default=views, help=f"training photos (default {views})")
    add("--test-views", type=int, default=test_views, help=f"test photos (default {test_views})")
    more("--resolution", type=int, default=resolution, help=f"pixels a side (default {resolution})")
    more("--spp", type=int, default=spp, help=f"samples a pixel of training photos (default {spp})")
    more("--test-spp", type=int, default=test_spp, help=f"samples a pixel of what is measured against (default {test_spp})")


# ---------------------------------------------------------------- multiview


def multiview_flags(parser: Parser) -> None:
    add = parser.common.add_argument
    add("--light", required=True, type=Path, nargs="+", metavar="FILE", help="lat-long .hdr or .exr")
    add("--relight", type=Path, nargs="*", default=[], metavar="FILE", help="other lights, for the truth of relighting")
    sampling_flags(parser, views=60, test_views=12, resolution=400, spp=64, test_spp=256)


def multiview(args) -> None:
    if len(args.light) != 1:
        raise UserError("a multiview capture has one light", fix="give one file to --light; others go to --relight", code=EXIT_USAGE)
    from relit.capture.synthetic import synthesize_multiview
    from relit.device import use_device
    from relit.log import Log

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
        roughness=args.roughness,
        metallic=args.metallic,
        say=Log().say,
    )


SYNTHESIZERS: dict[str, Kind] = {"multiview": Kind(multiview_flags, multiview)}
