"""Relit: photographs of an object into a 3D asset that can be relit."""

import contextlib
import ctypes

# pycolmap's wheel (4.2.1) exports a zlib of its own and pulls in the system's libz.so.1, which then
# binds to that one: the next PNG or zlib.compress corrupts the heap. A libz that is loaded before
# pycolmap binds to itself.
with contextlib.suppress(OSError):
    ctypes.CDLL("libz.so.1")

__version__ = "0.1.0"
__all__ = ["AssetFolder", "__version__", "inspect", "load", "open_capture", "reconstruct"]


def __getattr__(name: str):
    """The functions of `relit.api`, imported when they are asked for: `import relit` and `relit
    --help` stay quick."""
    import importlib

    if name == "open_capture":
        return importlib.import_module("relit.capture.open").open_capture
    if name in ("AssetFolder", "inspect", "load", "reconstruct"):
        return getattr(importlib.import_module("relit.api"), name)
    raise AttributeError(f"module 'relit' has no attribute '{name}'")
