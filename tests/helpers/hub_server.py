"""A server on this machine that speaks as much of the hub's protocol as a download of one file needs."""

import hashlib
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


@dataclass
class Hub:
    """content: of every file. etag: its hash as the server says it, None for the true one. breaks: after how many
    bytes each of the next downloads is cut off. requests: what was asked, as (method, range).
    """

    content: bytes
    etag: str | None = None
    breaks: list[int] = field(default_factory=list)
    requests: list[tuple[str, str | None]] = field(default_factory=list)
    address: str = ""


@contextmanager
def serve(hub: Hub) -> Iterator[Hub]:
    """Serves `hub` at `hub.address` for as long as the block runs."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), _handler(hub))
    hub.address = f"http://127.0.0.1:{server.server_port}"
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield hub
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def _handler(hub: Hub) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        def do_HEAD(self) -> None:
            self._answer(body=False)

        def do_GET(self) -> None:
            self._answer(body=True)

        def log_message(self, *_: object) -> None:
            """Silence."""

        def _answer(self, body: bool) -> None:
            asked = self.headers.get("Range")
            hub.requests.append((self.command, asked))
            if "/resolve/" not in self.path or "absent" in self.path:
                self.send_error(404)
                return
            begin = int(asked.removeprefix("bytes=").split("-")[0]) if asked else 0
            part = hub.content[begin:]
            self.send_response(206 if asked else 200)
            self.send_header("ETag", f'"{hub.etag or hashlib.sha256(hub.content).hexdigest()}"')
            self.send_header("X-Repo-Commit", "0" * 40)
            self.send_header("Content-Length", str(len(part)))
            if asked:
                self.send_header("Content-Range", f"bytes {begin}-{len(hub.content) - 1}/{len(hub.content)}")
            self.end_headers()
            if body:
                self.wfile.write(part[: hub.breaks.pop(0)] if hub.breaks else part)
                self.close_connection = True

    return Handler
