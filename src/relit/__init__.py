"""Relit: photographs of an object into a 3D asset that can be relit."""

import contextlib
import ctypes

# pycolmap's wheel (4.2.1) exports a zlib of its own and pulls in the system's libz.so.1, which then binds to that one: the next PNG or
# zlib.compress corrupts the heap. A libz that is loaded before pycolmap binds to itself.
with contextlib.suppress(OSError):
    ctypes.CDLL("libz.so.1")

__version__ = "0.1.0"
