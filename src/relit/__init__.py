"""Relit: relightable 3D assets from photographs of an object."""

import contextlib
import ctypes

# pycolmap's wheel (4.2.1) exports its own zlib symbols, and the system's libz.so.1, loaded later,
# binds to them: the next PNG or zlib.compress corrupts the heap. A libz loaded before pycolmap binds
# to itself.
with contextlib.suppress(OSError):
    ctypes.CDLL("libz.so.1")

__version__ = "0.1.0"
__all__ = ["AssetFolder", "__version__", "inspect", "load", "open_capture", "reconstruct"]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str):
    """Functions of `relit.api`, imported on first use: `import relit` and `relit --help` stay
    fast."""
    import importlib

    if name == "open_capture":
        return importlib.import_module("relit.capture.open").open_capture
    if name in ("AssetFolder", "inspect", "load", "reconstruct"):
        return getattr(importlib.import_module("relit.api"), name)
    raise AttributeError(f"module 'relit' has no attribute '{name}'")
