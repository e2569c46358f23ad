"""Weights: downloads survive what networks do. The server is on the loopback interface."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import http.server
import threading

import pytest
import torch
from weights_samples import (
    written,
)

from MedColorLib.errors import Cancelled, SettingsError, WeightsError
from MedColorLib.features import download, network_weights, weights

pytestmark = pytest.mark.usefixtures("cache")


# Downloads.
class Server(http.server.BaseHTTPRequestHandler):
    """One file, with the faults that a test asks for."""

    content = b""
    ranges = True
    cuts: list = []  # noqa: RUF012 - bytes after which each connection breaks, first to last
    status = None
    announced = None
    requests: list = []  # noqa: RUF012

    def do_GET(self):
        start = 0
        asked = self.headers.get("Range")
        type(self).requests.append(asked)
        if self.status:
            self.send_error(self.status)
            return
        if asked and self.ranges:
            start = int(asked[len("bytes=") : -1])
            self.send_response(206)
            self.send_header("Content-Range", f"bytes {start}-{len(self.content) - 1}/{len(self.content)}")
        else:
            self.send_response(200)
        body = self.content[start:]
        self.send_header("Content-Length", str(self.announced or len(body)))
        self.end_headers()
        cut = self.cuts.pop(0) if self.cuts else None
        with contextlib.suppress(ConnectionError):
            self.wfile.write(body[:cut])

    def log_message(self, *_):
        pass


@pytest.fixture
def server(monkeypatch, tmp_path):
    """A server of the narrow network as a legacy .pth, announced in the manifest."""
    path, tensors, *_ = written("pth-legacy", tmp_path)
    handler = type("Handler", (Server,), {"content": path.read_bytes(), "cuts": [], "requests": []})
    entry = {**weights.manifest()["vgg19"], "file": "narrow.pth", "bytes": len(handler.content)}
    entry["sha256"] = hashlib.sha256(handler.content).hexdigest()
    handler.tensors = tensors
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as running:
        thread = threading.Thread(target=running.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        entry["url"] = f"http://127.0.0.1:{running.server_port}/narrow.pth"
        monkeypatch.setattr(
            weights, "manifest", lambda: {"vgg19": entry, "gray-vgg19": {**entry, "url": None, "sha256": None}}
        )
        monkeypatch.setattr(download, "_CHUNK_BYTES", 1000)
        yield handler
        running.shutdown()
        thread.join()


def part_of(cache):
    return cache / "narrow.pth.part"


def only_files(cache):
    return sorted(file.name for file in cache.rglob("*") if file.is_file())


def test_fetched_weights_are_found_and_right(server, cache):
    seen = []
    path = weights.fetch_weights(progress=lambda present, size: seen.append((present, size)))
    assert seen[-1] == (len(server.content),) * 2
    assert [present for present, _ in seen] == sorted(present for present, _ in seen)
    assert only_files(cache) == [path.name]  # neither the download nor its .part stays
    found = weights.find_weights()
    assert (found.path, found.preprocessing) == (path, "torchvision")
    torch.testing.assert_close(weights.load_weights(path).tensor("conv5_4.weight"), server.tensors["conv5_4.weight"])
    assert weights.fetch_weights() == path and len(server.requests) == 1  # nothing to do the second time
    path.write_bytes(path.read_bytes()[:-5])
    weights.load_weights(weights.fetch_weights())  # fetching cures a spoilt file
    assert len(server.requests) == 2


@pytest.mark.parametrize("ranges", [True, False])
def test_broken_connections_are_taken_up_again(server, cache, ranges):
    server.ranges, server.cuts = ranges, [5000, 7000]
    weights.fetch_weights()
    assert server.requests == [None, "bytes=5000-", f"bytes={12000 if ranges else 7000}-"]


def test_a_dead_connection_ends_in_a_message_and_a_later_call_goes_on(server, cache):
    server.cuts = [5000, 0, 0, 0]
    with pytest.raises(WeightsError, match=r"after 5000 of \d+ bytes"):
        weights.fetch_weights()
    assert only_files(cache) == ["narrow.pth.part"] and part_of(cache).stat().st_size == 5000
    assert weights.find_weights() is None
    weights.fetch_weights()
    assert server.requests[-1] == "bytes=5000-"


def test_cancelling_keeps_what_came(server, cache):
    calls = []
    with pytest.raises(Cancelled):
        weights.fetch_weights(cancelled=lambda: calls.append(1) or len(calls) > 4)
    assert 0 < part_of(cache).stat().st_size < len(server.content)
    assert only_files(cache) == ["narrow.pth.part"]
    weights.fetch_weights()
    assert only_files(cache)[0].startswith("vgg19-")


def test_another_file_of_the_same_size_is_deleted(server, cache):
    server.content = bytes(len(server.content))
    with pytest.raises(WeightsError, match="not the expected file"):
        weights.fetch_weights()
    assert only_files(cache) == []


def test_a_spoilt_part_is_deleted_and_the_next_call_starts_anew(server, cache):
    cache.mkdir()
    part_of(cache).write_bytes(b"?" * 3000)
    with pytest.raises(WeightsError, match="was deleted"):
        weights.fetch_weights()
    weights.fetch_weights()
    assert server.requests == ["bytes=3000-", None]
    part_of(cache).write_bytes(b"?" * (len(server.content) + 1))
    (cache / weights.find_weights().path.name).unlink()
    with pytest.raises(WeightsError, match="was deleted"):
        weights.fetch_weights()
    assert only_files(cache) == []


def test_another_size_is_refused_before_the_download(server, cache):
    server.content += b"more"
    with pytest.raises(WeightsError, match="instead of"):
        weights.fetch_weights()
    assert only_files(cache) == []


@pytest.mark.parametrize("status", [404, 403, 500, 503])
def test_server_errors_are_told(server, cache, status):
    server.status = status
    with pytest.raises(WeightsError, match=str(status)):
        weights.fetch_weights()
    assert only_files(cache) == []


def test_offline_is_told(server, cache):
    import socket

    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))  # bound, not listening: refused at once
        port = unused.getsockname()[1]
        with pytest.raises(WeightsError, match=r"no connection.*copy the file from another machine"):
            weights.fetch_weights(url=f"http://127.0.0.1:{port}/x.pth")


def test_other_kinds_of_url_are_refused(server, tmp_path):
    (tmp_path / "x").write_bytes(server.content)
    with pytest.raises(SettingsError, match="only http and https"):
        weights.fetch_weights(url=(tmp_path / "x").as_uri())


def test_a_full_disk_is_told_before_and_during(server, cache, monkeypatch):
    usage = type("Usage", (), {"free": 10})
    with monkeypatch.context() as patch:
        patch.setattr(download.shutil, "disk_usage", lambda _: usage)
        with pytest.raises(WeightsError, match="make room"):
            weights.fetch_weights()

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(download, "_copy", full)
        with pytest.raises(WeightsError, match="No space left"):
            weights.fetch_weights()
    assert weights.find_weights() is None


def test_a_verified_download_survives_a_failed_conversion(server, cache, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(network_weights, "_save", lambda *_: (_ for _ in ()).throw(WeightsError("no room")))
        with pytest.raises(WeightsError, match="no room"):
            weights.fetch_weights()
    assert only_files(cache) == ["narrow.pth"]
    weights.fetch_weights()
    assert len(server.requests) == 1


def test_a_file_that_a_user_put_there_stays(server, cache):
    cache.mkdir(parents=True, exist_ok=True)
    (cache / "narrow.pth").write_bytes(server.content)
    weights.fetch_weights()
    assert (cache / "narrow.pth").read_bytes() == server.content and not server.requests


def test_what_has_no_checksum_is_not_fetched(server):
    with pytest.raises(WeightsError, match="gray-vgg19"):
        weights.fetch_weights("gray-vgg19")
    with pytest.raises(SettingsError):
        weights.fetch_weights("alexnet")
