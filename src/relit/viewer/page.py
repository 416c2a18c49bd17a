"""The built page that the package carries (viewer/ in the repository, `make viewer`)."""

from __future__ import annotations

import json
from pathlib import Path

from relit.errors import EXIT_ENVIRONMENT, UserError

PAGE = Path(__file__).parent / "static" / "index.html"
SLOT = '<script type="application/json" id="relit-manifest"></script>'


def page_text() -> str:
    """The page without data. Raises UserError (5) where it has not been built."""
    if not PAGE.is_file():
        raise UserError(
            "the page has not been built",
            "this is a checkout of the sources, where the page is built with node",
            "sudo apt-get install -y nodejs npm, then make viewer",
            code=EXIT_ENVIRONMENT,
        )
    return PAGE.read_text(encoding="utf-8")


def page_with(manifest: dict) -> str:
    """The page with its data inside."""
    text = page_text()
    if text.count(SLOT) != 1:
        raise ValueError("the built page has no place for the data")
    data = json.dumps(manifest, allow_nan=False).replace("</", "<\\/").replace("<!--", "<\\u0021--")
    return text.replace(SLOT, SLOT.replace("></script>", f">{data}</script>"))
