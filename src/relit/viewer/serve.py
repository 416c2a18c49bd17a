"""The local server behind `relit view`: loopback only, one folder, no foreign hosts or origins.

A page of another site can make a browser send requests to 127.0.0.1. Three checks keep it out: the
Host header must name this machine's loopback (against DNS rebinding), an Origin header must be the
server's own, and nothing is sent that allows other origins.
"""

from __future__ import annotations

import json
import mimetypes
import shutil
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import quote, unquote, urlsplit

from relit.errors import EXIT_ENVIRONMENT, UserError
from relit.viewer.manifest import manifest, status
from relit.viewer.page import page_text

LOOPBACK = "127.0.0.1"
MAX_BODY = 64 << 20  # bytes of a posted mask
POLICY = (
    "default-src 'none'; script-src 'self' 'unsafe-inline' blob:; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
    "connect-src 'self' data: blob:; worker-src blob:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


class Server(ThreadingHTTPServer):
    """One folder on a loopback port. answers: {path: () -> JSON value}. posts: {path: (bytes,
    query) -> JSON value}. pictures: {path: query -> (bytes, type)}."""

    daemon_threads = True

    def __init__(
        self,
        root: Path,
        answers: dict[str, Callable],
        posts: dict[str, Callable] | None = None,
        pictures: dict[str, Callable] | None = None,
        port: int = 0,
    ):
        self.root, self.answers, self.posts, self.pictures = (
            Path(root).resolve(),
            answers,
            posts or {},
            pictures or {},
        )
        self.page = page_text().encode()
        super().__init__((LOOPBACK, port), Handler)

    @property
    def url(self) -> str:
        return f"http://{LOOPBACK}:{self.server_address[1]}/"


def address_of(root: Path) -> Callable[[Path], str]:
    """Path below `root` -> the address at which `Server` has it."""
    base = Path(root).resolve()
    return lambda path: "files/" + quote(Path(path).resolve().relative_to(base).as_posix())


class Handler(BaseHTTPRequestHandler):
    """GET / (the page), /NAME.json (answers), /files/PATH (below the root); POST to the server's
    `posts`."""

    server: Server
    server_version, sys_version = "relit", ""
    protocol_version = "HTTP/1.1"
    timeout = 30

    def do_GET(self) -> None:
        if not self._ours():
            return self._refuse(
                HTTPStatus.FORBIDDEN, "requests from other hosts or pages are refused"
            )
        path = urlsplit(self.path).path
        if path == "/":
            return self._send(self.server.page, "text/html; charset=utf-8")
        if path.lstrip("/") in self.server.answers:
            return self._answer(self.server.answers[path.lstrip("/")])
        if path.lstrip("/") in self.server.pictures:
            try:
                body, kind = self.server.pictures[path.lstrip("/")](urlsplit(self.path).query)
            except (UserError, OSError, ValueError, LookupError) as error:
                return self._refuse(HTTPStatus.NOT_FOUND, str(error))
            return self._send(body, kind)
        if path.startswith("/files/"):
            return self._file(unquote(path[len("/files/") :]))
        return self._refuse(HTTPStatus.NOT_FOUND, "there is no such page")

    do_HEAD = do_GET

    def do_POST(self) -> None:
        length = self.headers.get("Content-Length", "")
        act = self.server.posts.get(urlsplit(self.path).path.lstrip("/"))
        own_page = (
            self.headers.get("Origin") is not None
        )  # browsers send it with every POST: others have no business here
        if not self._ours() or not own_page or act is None:
            return self._refuse(HTTPStatus.FORBIDDEN, "refused")
        if not length.isascii() or not length.isdigit() or int(length) > MAX_BODY:
            return self._refuse(
                HTTPStatus.REQUEST_ENTITY_TOO_LARGE,
                "the body is too large or its length is missing",
            )
        body = self.rfile.read(int(length))
        return self._answer(lambda: act(body, urlsplit(self.path).query))

    def _ours(self) -> bool:
        port = self.server.server_address[1]
        hosts = {f"{name}:{port}" for name in (LOOPBACK, "localhost")} | (
            {LOOPBACK, "localhost"} if port == 80 else set()
        )
        origin = self.headers.get("Origin")
        if self.headers.get_all("Host", []) not in [[h] for h in hosts]:
            return False
        if self.headers.get("Sec-Fetch-Site", "none") not in ("none", "same-origin"):
            return False
        return origin is None or origin in {f"http://{h}" for h in hosts}

    def _answer(self, act: Callable) -> None:
        try:
            text = json.dumps(act(), allow_nan=False)
        except UserError as error:
            return self._send(
                json.dumps({"error": str(error)}).encode(),
                "application/json",
                HTTPStatus.UNPROCESSABLE_ENTITY,
            )
        except (OSError, ValueError, LookupError, TypeError) as error:
            text = json.dumps({"error": f"{type(error).__name__}: {error}"})
            return self._send(text.encode(), "application/json", HTTPStatus.INTERNAL_SERVER_ERROR)
        return self._send(text.encode(), "application/json")

    def _file(self, name: str) -> None:
        root = self.server.root
        if "\0" in name:
            return self._refuse(HTTPStatus.NOT_FOUND, "there is no such file")
        try:
            path = (root / name).resolve()
            if (
                not path.is_relative_to(root) or not path.is_file()
            ):  # symbolic links that lead out are refused as well
                return self._refuse(HTTPStatus.NOT_FOUND, "there is no such file")
            file = path.open("rb")
        except OSError:
            return self._refuse(HTTPStatus.NOT_FOUND, "there is no such file")
        with file:
            size = path.stat().st_size
            self._head(mimetypes.guess_type(path.name)[0] or "application/octet-stream", size)
            if self.command != "HEAD":
                try:
                    shutil.copyfileobj(file, self.wfile)
                except OSError:
                    self.close_connection = True

    def _send(self, body: bytes, kind: str, code: HTTPStatus = HTTPStatus.OK) -> None:
        self._head(kind, len(body), code)
        if self.command != "HEAD":
            try:
                self.wfile.write(body)
            except OSError:  # the page has gone
                self.close_connection = True

    def _head(self, kind: str, size: int, code: HTTPStatus = HTTPStatus.OK) -> None:
        self.send_response(code)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(size))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Content-Security-Policy", POLICY)
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.send_header("Referrer-Policy", "no-referrer")
        self.end_headers()

    def _refuse(self, code: HTTPStatus, text: str) -> None:
        self.close_connection = True
        self._send((text + "\n").encode(), "text/plain; charset=utf-8", code)

    def log_message(self, *_) -> None:
        """Requests are not logged."""


def run_server(run: Path, port: int = 0) -> Server:
    """A server of a run folder (or asset folder), not yet serving. Raises UserError for a folder
    that is neither, or a taken port."""
    run = Path(run)
    address = address_of(run)
    live = (run / "config.toml").is_file()
    manifest(run, address, live=live)  # what is wrong with the folder is said before the page opens
    answers = {
        "manifest.json": lambda: manifest(run, address, live=live),
        "status.json": lambda: status(run, address),
    }
    return open_port(lambda: Server(run, answers, port=port), port)


def open_port(make: Callable[[], Server], port: int) -> Server:
    """`make()`, with a taken port told as such."""
    try:
        return make()
    except OSError as error:
        why = error.strerror or str(error)
        raise UserError(
            f"port {port} cannot be used",
            why,
            "give another --port, or none",
            code=EXIT_ENVIRONMENT,
        ) from None


def serve_until_stopped(server: Server, say: Callable[[str], None], browse: bool) -> None:
    """Serve until Ctrl-C. browse: open the page in the user's browser."""
    say(f"{server.url}  (Ctrl-C ends it)")
    if browse:
        import webbrowser

        webbrowser.open(server.url)
    try:
        server.serve_forever(poll_interval=0.2)
    except KeyboardInterrupt:
        pass
    finally:
        server.server_close()
