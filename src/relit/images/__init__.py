"""Reading and writing pictures. Everything inside Relit is linear float32; the transfer curve is
applied here and nowhere else."""

from relit.images.decode import EXTENSIONS, FLOAT, RAW, turn_upright
from relit.images.read import Header, Image, read_data, read_header, read_image, read_small
from relit.images.write import (
    encode_jpeg,
    encode_png,
    write_bytes,
    write_data,
    write_linear,
    write_srgb,
)

__all__ = [
    "EXTENSIONS",
    "FLOAT",
    "RAW",
    "Header",
    "Image",
    "encode_jpeg",
    "encode_png",
    "read_data",
    "read_header",
    "read_image",
    "read_small",
    "turn_upright",
    "write_bytes",
    "write_data",
    "write_linear",
    "write_srgb",
]
