"""Reading captures: `open_capture(path)` recognises the format and returns a `Capture`."""

from relit.capture.opening import open_capture, with_grabcut

__all__ = ["open_capture", "with_grabcut"]
