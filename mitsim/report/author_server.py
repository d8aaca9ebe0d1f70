"""Serve the authoring page to one browser on this machine, and write the files that it saves.

The server listens on 127.0.0.1 only. Every request must carry the token of this run in its path and name this machine
in its ``Host`` header. Programs of other users and pages of other sites can therefore not write files.

Saved files are checked before anything is written: the scene must load, and the task and the study must be readable.
Either all files are written or none.
"""

from __future__ import annotations

import json
import secrets
import tempfile
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

from characterisation.files.atomic_io import atomic_write, write_text
from characterisation.files.documents import read_toml
from characterisation.files.errors import InputError
from mitsim.scene.authoring.check_task import read_features

_LARGEST = 64 * 1024**2

#: longest time that a connection may stay silent, since connections are answered one after another [s]
_SECONDS = 10.0

#: returns the page for a token
Page = Callable[[str], str]
Check = Callable[[], list[dict[str, str]]]


class AuthorServer:
    """Server of a page at ``address``; :meth:`serve` returns when the page says that the user has finished."""

    def __init__(self, folder: Path, names: dict[str, str], page: Page, check: Check, port: int = 0) -> None:
        self.folder, self.names, self.page, self.check = folder, names, page, check
        self.token, self.done, self.saved = secrets.token_urlsafe(24), False, 0
        #: whether the study was made by this page, which proposes one but does not edit it
        self._own_study = False
        owner = self

        class Handler(BaseHTTPRequestHandler):
            timeout = _SECONDS

            def do_GET(self) -> None:
                if self._allowed(""):
                    try:
                        page = owner.page(owner.token)
                    except InputError as error:  # a file was changed by hand meanwhile
                        self._answer(422, f"{error}\nMend the file, then load this page again.", "text/plain")
                    else:
                        self._answer(200, page, "text/html")

            def do_POST(self) -> None:
                if self.path == f"/{owner.token}/done" and self._allowed("done"):
                    owner.done = True
                    self._answer(200, "{}", "application/json")
                elif self._allowed("save"):
                    length = int(self.headers.get("Content-Length", "0") or 0)
                    if not 0 < length <= _LARGEST:
                        self._answer(400, json.dumps({"fault": "no files, or too large"}), "application/json")
                        return
                    code, answer = owner.save(self.rfile.read(length))
                    self._answer(code, json.dumps(answer), "application/json")

            def _allowed(self, action: str) -> bool:
                """Return whether a request comes from the page itself."""
                host = self.headers.get("Host", "")
                here = {f"{name}:{owner.port}" for name in ("127.0.0.1", "localhost")}
                origin = self.headers.get("Origin")
                from_here = origin is None or origin in {f"http://{address}" for address in here}
                if host in here and from_here and self.path == f"/{owner.token}/{action}":
                    return True
                self._answer(403, "access denied: open the address that mitsim printed", "text/plain")
                return False

            def _answer(self, code: int, text: str, kind: str) -> None:
                data = text.encode()
                try:
                    self.send_response(code)
                    self.send_header("Content-Type", f"{kind}; charset=utf-8")
                    self.send_header("Content-Length", str(len(data)))
                    self.send_header("Cache-Control", "no-store")
                    self.send_header("Referrer-Policy", "no-referrer")
                    self.end_headers()
                    self.wfile.write(data)
                except OSError:  # the page was closed, or its program hangs
                    self.close_connection = True

            def log_message(self, *_: Any) -> None:
                pass

        self._server = HTTPServer(("127.0.0.1", port), Handler)
        self.port = int(self._server.server_address[1])
        self.address = f"http://127.0.0.1:{self.port}/{self.token}/"

    def serve(self) -> None:
        """Answer requests until the user has finished."""
        try:
            while not self.done:
                self._server.handle_request()
        finally:
            self._server.server_close()

    def save(self, body: bytes) -> tuple[int, dict[str, Any]]:
        """Check and write the files of a page; return the HTTP status with the findings, or with the fault.

        The user has finished if the request says ``done`` and its files are written.
        """
        try:
            request = json.loads(body)
            sent = request["files"]
            texts = {self.names[key]: str(text) for key, text in sent.items() if key in self.names}
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
            return 400, {"fault": "the request does not hold the files of this page"}
        try:
            self._check_texts(texts)
        except InputError as error:
            return 422, {"fault": str(error)}
        study = self.names.get("study", "")
        if study in texts and (self.folder / study).exists() and not self._own_study:
            del texts[study]  # it was written since the page was loaded
        paths = {name: self.folder / name for name in texts}
        before = {name: path.read_bytes() if path.exists() else None for name, path in paths.items()}
        try:
            for name, text in texts.items():
                write_text(self.folder / name, text)
            findings = self.check()
        except BaseException as error:
            for name, data in before.items():  # restore the files, since the new scene does not load
                _restore(self.folder / name, data)
            if not isinstance(error, InputError):
                raise
            return 422, {"fault": str(error)}
        self._own_study |= study in texts
        self.saved += 1
        self.done = request.get("done") is True
        return 200, {"findings": findings, "written": sorted(texts)}

    def _check_texts(self, texts: dict[str, str]) -> None:
        from mitsim.study import StudyFile

        with tempfile.TemporaryDirectory() as folder:
            for key, name in self.names.items():
                if name in texts and key != "scene":
                    path = Path(folder) / name
                    path.write_text(texts[name], encoding="utf-8")
                    if key == "task":
                        read_features(path)
                    else:
                        read_toml(path, StudyFile)


def _restore(path: Path, data: bytes | None) -> None:
    if data is None:
        path.unlink(missing_ok=True)
        return
    with atomic_write(path) as part:
        part.write_bytes(data)
