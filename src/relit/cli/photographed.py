"""Flags of captures that pass through a camera model."""

from __future__ import annotations

from relit.cli.parser import Kind, Parser


def delivery_flags(parser: Parser) -> None:
    """Camera model, errors of masks, and what is handed over."""
    add, more = parser.common.add_argument, parser.more.add_argument
    add(
        "--camera-model",
        metavar="MODEL",
        default=None,
        help="phone, key=value,... or phone,key=value,... (default: ideal photos)",
    )
    more(
        "--mask-errors",
        metavar="ERRORS",
        default=None,
        help="segmenter, or key=value,... (default: true masks)",
    )
    more("--no-masks", action="store_true", help="write no masks")
    more("--no-cameras", action="store_true", help="write no cameras beside the photos")


def delivery_of(args):
    """The Delivery that the flags of `delivery_flags` name; None where none is given."""
    if not (args.camera_model or args.mask_errors or args.no_masks or args.no_cameras):
        return None
    from relit.synthesize.camera_model import parse_camera_model
    from relit.synthesize.delivery import Delivery
    from relit.synthesize.mask_errors import parse_mask_errors

    return Delivery(
        parse_camera_model(args.camera_model or "off"),
        parse_mask_errors(args.mask_errors or "off"),
        masks=not args.no_masks,
        cameras=not args.no_cameras,
    )


PHOTOGRAPHED: dict[str, Kind] = {}
