"""HTTP server of the viewer: the page and its images, for this machine and the printed address only.

Every URL begins with a secret that is random for each run, so that neither other users of the machine nor other pages
in the browser can request an image. A request with a foreign ``Host`` is refused (DNS rebinding). No part of a URL is a
path: a sequence is given by its position, a frame by its number, a layer by its name in the file's header.
"""

import json
import secrets
import socket
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

from hybrid import player
from hybrid.files.exr import ExrError
from hybrid.viewer.sequence import Sequence, encode_picture

LOOPBACK = "127.0.0.1"
# The page may only request what this server provides.
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
HEADERS = {
    "Content-Security-Policy": POLICY,
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
PAGE = {
    "": ("page.html", "text/html; charset=utf-8"),
    "page.css": ("page.css", "text/css; charset=utf-8"),
    "page.js": ("page.js", "text/javascript; charset=utf-8"),
}
KINDS = {"png": "image/png", "jpg": "image/jpeg"}


class ViewServer(ThreadingHTTPServer):
    """Serves sequences (the first is the result) to a browser on this machine; port 0: any free port.

    Other sequences of a folder that is named, also later ones, follow. `report` is called with each error, once.
    """

    daemon_threads = True
    allow_reuse_address = sys.platform != "win32"  # there it lets two servers share a port

    def __init__(
        self,
        sequences: list[Sequence],
        *,
        rate: float = 24,
        port: int = 0,
        report: Callable[[Exception], object] = lambda error: None,
    ) -> None:
        self.sequences, self._named = [*sequences], tuple(sequences)
        self.rate = rate
        self._report, self._reported = report, set[str]()
        self._lock = threading.Lock()
        self.secret = secrets.token_urlsafe(16)
        self._exposure: float | None = None
        super().__init__((LOOPBACK, port), _Handler)

    def server_bind(self) -> None:
        """Bind the port; on Windows so that no other program can bind it as well."""
        if sys.platform == "win32":
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_EXCLUSIVEADDRUSE, 1)
        super().server_bind()

    @property
    def port(self) -> int:
        return int(self.server_address[1])

    @property
    def url(self) -> str:
        return f"http://{LOOPBACK}:{self.port}/{self.secret}/"

    @property
    def hosts(self) -> set[str]:
        return {f"{name}:{self.port}" for name in (LOOPBACK, "localhost")}

    @property
    def exposure(self) -> float:
        """Divisor of radiance at 0 EV for all sequences, from the middle frame of the last sequence that has frames."""
        for sequence in reversed(self._named) if self._exposure is None else ():
            if numbers := sorted(sequence.files()):
                with suppress(OSError, ExrError):  # incomplete so far
                    self._exposure = sequence.exposure(numbers[len(numbers) // 2])
                    break
        return self._exposure or 1.0

    def state(self) -> dict[str, Any]:
        """Return the current frames with their versions, the layers, and the record of the run."""
        self._add_others()
        names = [Path(sequence.spec).name for sequence in self.sequences]
        if len(set(names)) < len(names):  # noisy/shot.####.exr and denoised/shot.####.exr
            names = ["/".join(Path(sequence.spec).parts[-2:]) for sequence in self.sequences]
        described = [{"name": n, **self._describe(s)} for n, s in zip(names, self.sequences, strict=True)]
        return {"rate": self.rate, "sequences": described}

    def _add_others(self) -> None:
        """Append the sequences that the named folders have beside those that are served."""
        with self._lock, suppress(OSError, ValueError):  # said where the sequence is described
            found = [*self._named, *(other for sequence in self._named for other in sequence.others())]
            for sequence in found:
                sequence.files()
            known = {sequence.key for sequence in self.sequences}
            self.sequences += [sequence for sequence in found if sequence.key not in known]

    def report(self, error: Exception) -> None:
        """Report an error, unless it was reported before."""
        if str(error) not in self._reported:
            self._reported.add(str(error))
            self._report(error)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Report an error of a connection, but not that the browser has closed it."""
        error = sys.exception()
        if isinstance(error, Exception) and not isinstance(error, ConnectionError):
            self.report(error)

    def _describe(self, sequence: Sequence) -> dict[str, Any]:
        try:
            versions, error = sequence.versions(), ""
        except (OSError, ValueError) as fault:
            self.report(fault)
            versions, error = {}, str(fault)
        layers: list[str] = []
        first = ""
        for number in versions:
            with suppress(OSError, ExrError):
                layers, first = sequence.layers(number)
                break
        record = sequence.record() if sequence.finished else {}
        return {"frames": versions, "layers": layers, "layer": first, "record": record, "error": error}


class _Handler(BaseHTTPRequestHandler):
    server: ViewServer
    protocol_version = "HTTP/1.1"
    timeout = 60  # seconds until an idle connection is closed

    def do_GET(self) -> None:
        if self.headers.get("Host") not in self.server.hosts:
            self._answer(403, "text/plain", b"this server answers to its own name only")
            return
        parts = urlsplit(self.path)
        secret, _, rest = parts.path.removeprefix("/").partition("/")
        if not secrets.compare_digest(secret.encode(), self.server.secret.encode()):
            self._answer(404, "text/plain", b"not found")
            return
        try:
            code, kind, body, lasting = self._find(rest, parse_qs(parts.query))
        except (ExrError, OSError) as error:  # the page may ask again: the file may be incomplete so far
            self._fail(409, error)
        except (KeyError, IndexError, ValueError) as error:
            self._answer(404, "text/plain; charset=utf-8", str(error).encode())
        except MemoryError as error:
            self._fail(507, MemoryError(f"not enough memory: {error}"))
        except Exception as error:
            self._fail(500, error)
        else:
            self._answer(code, kind, body, lasting=lasting)

    def _find(self, rest: str, query: dict[str, list[str]]) -> tuple[int, str, bytes, bool]:
        """Status, media type and body of a request, and whether the browser may cache it."""
        if rest in PAGE:
            name, kind = PAGE[rest]
            text = files("hybrid.viewer").joinpath(name).read_text(encoding="utf-8")
            return 200, kind, (f"{player.script()}\n{text}" if name == "page.js" else text).encode(), False
        if rest == "state":
            return 200, "application/json", json.dumps(self.server.state()).encode(), False
        what, index, name = rest.split("/")
        if not index.isdecimal():
            raise KeyError(index)
        sequence = self.server.sequences[int(index)]
        number, _, suffix = name.rpartition(".")
        if what == "facts" and suffix == "json":
            return 200, "application/json", json.dumps(sequence.facts(int(number))).encode(), False
        if what == "values" and suffix == "json":
            x, y = (int(query[axis][0]) for axis in "xy")
            values = sequence.values(int(number), query["layer"][0], x, y)
            return 200, "application/json", json.dumps(values).encode(), False
        if what != "frame" or suffix not in KINDS:
            raise KeyError(rest)
        ev = float(query["ev"][0])
        if not -32 <= ev <= 32:  # NaN is refused as well
            raise ValueError(f"ev is {ev}, expected -32 to 32")
        gain, view = 2**ev / self.server.exposure, query.get("view", ["srgb"])[0]
        picture = sequence.picture(int(number), query["layer"][0], gain, ev, view)
        return 200, KINDS[suffix], encode_picture(picture, suffix), "version" in query  # of the file

    def _fail(self, code: int, error: Exception) -> None:
        self.server.report(error)
        self._answer(code, "text/plain; charset=utf-8", str(error).encode())

    def _answer(self, code: int, kind: str, body: bytes, *, lasting: bool = False) -> None:
        self.send_response(code)
        for name, value in HEADERS.items():
            self.send_header(name, value)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "private, max-age=86400, immutable" if lasting else "no-store")
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: object) -> None:
        """Log no request: the terminal belongs to the user."""
