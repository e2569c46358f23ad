"""What the tests of library share: samples and small helpers."""

from __future__ import annotations

import contextlib
import http.server
import re

import cv2

from MedColorLib.phantom import section
from MedColorLib.references.visible_human import fetch_library, list_photographs

NAME = "visible-human-male"


SHAPE = (132, 124)


def encoded(level: float) -> bytes:
    small = cv2.resize(section(level), SHAPE[::-1], interpolation=cv2.INTER_AREA)
    return cv2.imencode(".png", small[..., ::-1])[1].tobytes()


class Server(http.server.BaseHTTPRequestHandler):
    """Attributes, set by the fixture `server`:
    files: path -> bytes, as served. listed: path -> size, as the page announces it; None: without.
    cuts: path -> lengths after which connections break, one by one. busy: statuses of the next answers.
    redirect: where all requests are sent, or None. requests: (method, path, range) of each.
    """

    redirect = None

    def do_GET(self):
        self.requests.append((self.command, self.path, self.headers.get("Range")))
        if self.busy:
            self.send_error(self.busy.pop(0))
            return
        if self.redirect:
            self.send_response(302)
            self.send_header("Location", self.redirect)
            self.end_headers()
            return
        body = self.page() if self.path.endswith("/index.html") else self.files.get(self.path)
        if body is None:
            self.send_error(404)
            return
        start = int(re.match(r"bytes=(\d+)-", self.headers.get("Range", "bytes=0-"))[1])
        self.send_response(206 if start else 200)
        if start:
            self.send_header("Content-Range", f"bytes {start}-{len(body) - 1}/{len(body)}")
        self.send_header("Content-Length", str(len(body) - start))
        self.end_headers()
        cut = self.cuts.get(self.path)
        if self.command == "GET":
            with contextlib.suppress(ConnectionError):
                self.wfile.write(body[start : cut.pop(0)] if cut else body[start:])

    do_HEAD = do_GET

    def page(self) -> bytes:
        part = self.path.rsplit("/", 1)[0]
        rows = [
            f'<tr><td><a href="{path.rsplit("/", 1)[1]}">{path}</a></td>'
            + ("" if size is None else f'<td class="size">{size}</td>')
            + '<td class="date">2019-07-01</td></tr>'
            for path, size in self.listed.items()
            if path.startswith(part + "/")
        ]
        return f"<html><a href='../'>up</a><table>{''.join(rows)}</table></html>".encode()

    def log_message(self, *_):
        pass


def listed(server, step_mm=1, parts=("head", "thorax")):
    return list_photographs(NAME, step_mm, parts, server.url)


def fetch(server, **options):
    options.setdefault("wait", lambda seconds: None)
    return fetch_library(NAME, listed(server), **options)
