"""Reading captures: `open_capture(path)` recognises the format and returns a `Capture`."""

from relit.capture.opening import open_capture

__all__ = ["open_capture"]
