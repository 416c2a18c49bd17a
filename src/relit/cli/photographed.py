"""Flags of captures that pass through a camera model, and the verbs of those that exist for it:
everyday and turntable."""

from __future__ import annotations

from pathlib import Path

from relit.cli.parser import Kind, Parser, relight_flag


def delivery_flags(parser: Parser) -> None:
    """Camera model, errors of masks, and what is handed over, of a capture that by default has
    ideal photos, masks and cameras."""
    _model_flags(parser, "ideal photos")
    parser.more.add_argument("--no-masks", action="store_true", help="write no masks")
    parser.more.add_argument("--no-cameras", action="store_true", help="write no cameras")


def _model_flags(parser: Parser, default: str) -> None:
    parser.common.add_argument(
        "--camera-model",
        metavar="MODEL",
        default=None,
        help=f"phone, key=value,... or phone,key=value,... (default {default})",
    )
    parser.more.add_argument(
        "--mask-errors",
        metavar="ERRORS",
        default=None,
        help="segmenter, key=value,... or segmenter,key=value,... (default off)",
    )


def delivery_of(args):
    """The Delivery that the flags of `delivery_flags` name; None where none is given."""
    if not (args.camera_model or args.mask_errors or args.no_masks or args.no_cameras):
        return None
    from relit.synthesize.delivery import Delivery

    given = Delivery(masks=not args.no_masks, cameras=not args.no_cameras)
    return _with_models(given, args)


def _with_models(delivery, args):
    from dataclasses import replace

    from relit.synthesize.camera_model import parse_camera_model
    from relit.synthesize.mask_errors import parse_mask_errors

    if args.camera_model:
        delivery = replace(delivery, camera=parse_camera_model(args.camera_model))
    if args.mask_errors:
        delivery = replace(delivery, mask_errors=parse_mask_errors(args.mask_errors))
    return delivery


def _staged_flags(parser: Parser, views: int, camera: str) -> None:
    """Flags of everyday and turntable."""
    add, more = parser.common.add_argument, parser.more.add_argument
    add("--light", required=True, type=Path, metavar="FILE", help="light: lat-long .hdr or .exr")
    relight_flag(parser)
    add("--views", type=int, default=views, help=f"photos (default {views})")
    add("--test-views", type=int, default=8, help="test views of the object alone (default 8)")
    more("--resolution", type=int, default=400, help="pixels of the longer side (default 400)")
    more("--spp", type=int, default=128, help="samples per pixel of photos (default 128)")
    more("--test-spp", type=int, default=192, help="samples per pixel of test views (default 192)")
    _model_flags(parser, camera)
    more("--masks", action="store_true", help="write masks beside the photos")
    more("--cameras", action="store_true", help="write cameras beside the photos")


def _staged_parts(args, delivery):
    """Files, sampling and delivery of the flags of `_staged_flags`; chooses the device."""
    from dataclasses import replace

    from relit.device import use_device
    from relit.synthesize.object_truth import CaptureFiles, Sampling

    use_device(args.device)
    files = CaptureFiles(args.asset, args.light, tuple(args.relight), args.roughness, args.metallic)
    sampling = Sampling(
        views=args.views,
        test_views=args.test_views,
        resolution=args.resolution,
        spp=args.spp,
        test_spp=args.test_spp,
        seed=args.seed,
    )
    given = replace(delivery, masks=args.masks, cameras=args.cameras)
    return files, sampling, _with_models(given, args)


def everyday_flags(parser: Parser) -> None:
    _staged_flags(parser, 40, "phone")
    parser.more.add_argument(
        "--table",
        default="wood",
        metavar="TEXTURE",
        help="texture of the table: wood (default), cloth, speckle or a picture",
    )


def everyday(args) -> None:
    from relit.log import Log
    from relit.synthesize.everyday import EVERYDAY, synthesize_everyday

    files, sampling, delivery = _staged_parts(args, EVERYDAY)
    synthesize_everyday(
        files, args.out, sampling, texture=args.table, delivery=delivery, say=Log().say
    )


def turntable_flags(parser: Parser) -> None:
    _staged_flags(parser, 36, "still, JPEG")
    parser.more.add_argument(
        "--elevations",
        type=float,
        nargs="+",
        default=[25.0],
        metavar="DEGREES",
        help="of the camera, one turn of the plate for each (default 25)",
    )


def turntable(args) -> None:
    from relit.log import Log
    from relit.synthesize.turntable import TURNTABLE, synthesize_turntable

    files, sampling, delivery = _staged_parts(args, TURNTABLE)
    synthesize_turntable(
        files,
        args.out,
        sampling,
        elevations=tuple(args.elevations),
        delivery=delivery,
        say=Log().say,
    )


PHOTOGRAPHED: dict[str, Kind] = {
    "everyday": Kind(everyday_flags, everyday),
    "turntable": Kind(turntable_flags, turntable),
}
