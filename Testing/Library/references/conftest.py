"""Fixtures of the tests of `references/`."""

from __future__ import annotations

import http.server
import threading
from dataclasses import replace

import cv2
import numpy as np
import pytest
from library_samples import NAME, SHAPE, Server, encoded
from pictures_samples import SHAPE as PICTURE_SHAPE

from MedColorLib.references import visible_human


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setattr("MedColorLib.features.weights.cache_folder", lambda: tmp_path / "cache")
    return tmp_path / "cache" / "libraries"


@pytest.fixture(scope="session")
def photographs() -> dict[str, bytes]:
    """Path on the server -> PNG; numbers 1001 to 1011 in two parts that overlap at 1006."""
    content = {1001 + n: encoded(level) for n, level in enumerate(np.linspace(0.6, -0.6, 11))}
    files = {f"/head/a_vm{n}.png": content[n] for n in range(1001, 1007)}
    return {**files, **{f"/thorax/a_vm{n}.png": content[n] for n in range(1006, 1012)}}


@pytest.fixture
def server(monkeypatch, photographs):
    files = dict(photographs)
    listed = {path: len(data) for path, data in files.items()}
    handler = type("Handler", (Server,), {"files": files, "listed": listed, "cuts": {}, "requests": [], "busy": []})
    source = replace(visible_human.SOURCES[NAME], shape=SHAPE)
    monkeypatch.setitem(visible_human.SOURCES, NAME, source)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as running:
        thread = threading.Thread(target=running.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        handler.url = f"http://127.0.0.1:{running.server_port}/"
        yield handler
        running.shutdown()
        thread.join()


@pytest.fixture
def colors() -> np.ndarray:
    """(40, 60, 3): four quarters and a corner, so that no turn or flip leaves it the same; smooth."""
    picture = np.zeros((*PICTURE_SHAPE, 3), np.float32)
    picture[:20, :30], picture[20:, :30] = (200, 40, 30), (40, 160, 50)
    picture[:20, 30:], picture[20:, 30:] = (30, 50, 200), (220, 210, 70)
    picture[3:9, 4:14] = 250
    return np.rint(cv2.GaussianBlur(picture, (0, 0), 2)).astype(np.uint8)
