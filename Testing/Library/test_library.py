"""Libraries: prepared once, taken up again, checked; the server is on the loopback interface, pictures are made by formula."""

from __future__ import annotations

import contextlib
import hashlib
import http.server
import json
import logging
import re
import threading
from dataclasses import replace

import cv2
import numpy as np
import pytest

from MedColorLib.cli.main import main
from MedColorLib.errors import Cancelled, InputError, OutputError, SettingsError
from MedColorLib.features import download
from MedColorLib.phantom import section
from MedColorLib.references import library, visible_human
from MedColorLib.references.loading import load_references
from MedColorLib.references.photograph import prepare_reference
from MedColorLib.references.visible_human import check_png, fetch_library, list_photographs, missing_photographs

NAME = "visible-human-male"
SHAPE = (132, 124)


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setattr("MedColorLib.features.weights.cache_folder", lambda: tmp_path / "cache")
    return tmp_path / "cache" / "libraries"


def encoded(level: float) -> bytes:
    small = cv2.resize(section(level), SHAPE[::-1], interpolation=cv2.INTER_AREA)
    return cv2.imencode(".png", small[..., ::-1])[1].tobytes()


@pytest.fixture(scope="session")
def photographs() -> dict[str, bytes]:
    """Path on the server -> PNG; numbers 1001 to 1011 in two parts that overlap at 1006."""
    content = {1001 + n: encoded(level) for n, level in enumerate(np.linspace(0.6, -0.6, 11))}
    files = {f"/head/a_vm{n}.png": content[n] for n in range(1001, 1007)}
    return {**files, **{f"/thorax/a_vm{n}.png": content[n] for n in range(1006, 1012)}}


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


def listed(server, step_mm=1, parts=("head", "thorax")):
    return list_photographs(NAME, step_mm, parts, server.url)


def fetch(server, **options):
    options.setdefault("wait", lambda seconds: None)
    return fetch_library(NAME, listed(server), **options)


def fetched(server):
    """Names of the files that were asked for, pages and repetitions left out."""
    return sorted({path.rsplit("/", 1)[1] for _, path, _ in server.requests if path.endswith(".png")})


class TestListing:
    def test_chosen_by_step_and_each_once(self, server):
        assert [p.number for p in listed(server)] == list(range(1001, 1012))
        chosen = listed(server, step_mm=5)
        assert [p.number for p in chosen] == [1001, 1006, 1011]
        assert [p.size for p in chosen] == [len(server.files[p.url[len(server.url) - 1 :]]) for p in chosen]
        assert [p.number for p in listed(server, 5, ["thorax"])] == [1006, 1011]
        assert not fetched(server)

    def test_sizes_that_the_page_does_not_give_are_asked_for(self, server):
        server.listed = dict.fromkeys(server.listed)
        assert [p.size for p in listed(server, 5)] == [
            len(server.files[f"/{p}"]) for p in ("head/a_vm1001.png", "head/a_vm1006.png", "thorax/a_vm1011.png")
        ]
        assert {method for method, path, _ in server.requests if path.endswith(".png")} == {"HEAD"}

    def test_a_page_without_photographs(self, server):
        server.listed = {}
        with pytest.raises(InputError, match=r"head/index\.html: lists no photograph"):
            listed(server)

    def test_no_connection(self, server):
        with pytest.raises(InputError, match=r"no connection .*library add FOLDER --name visible-human-male"):
            list_photographs(NAME, url="http://127.0.0.1:9/")  # the port of `discard`, where nobody listens

    @pytest.mark.parametrize("url", ["http://example.org/", "ftp://127.0.0.1/", "file:///etc"])
    def test_only_https(self, url):
        with pytest.raises(SettingsError, match="only https"):
            list_photographs(NAME, url=url)

    @pytest.mark.parametrize("target", ["http://localhost:{port}/head/index.html", "ftp://127.0.0.1/x"])
    def test_redirects_to_elsewhere_are_not_followed(self, server, target):
        server.redirect = target.format(port=server.url.split(":")[-1].strip("/"))
        with pytest.raises(InputError, match=r"redirected to .* not followed|302"):
            listed(server)
        assert len(server.requests) == 1

    @pytest.mark.parametrize("options", [{"step_mm": 0}, {"parts": ["tail"]}, {"name": "atlas"}])
    def test_wrong_arguments(self, options):
        with pytest.raises(SettingsError):
            list_photographs(**{"name": NAME, **options})


class TestFetch:
    def test_whole_library(self, server, cache):
        seen = []
        index = fetch(server, progress=lambda fraction, text: seen.append(fraction))
        assert index["complete"] and len(index["pictures"]) == 11 and not index["left_out"]
        assert seen == sorted(seen) and seen[-1] <= 1
        assert index["credit"] == "Courtesy of the U.S. National Library of Medicine"
        first, last = index["pictures"][0], index["pictures"][-1]
        assert (first["source"], first["position_mm"], last["position_mm"]) == ("a_vm1001.png", 0, 10)
        assert first["sha256"] == hashlib.sha256(server.files["/head/a_vm1001.png"]).hexdigest()
        assert first["mm_per_pixel"] == pytest.approx(0.33)
        names = {"library.json", *(entry["file"] for entry in index["pictures"])}
        assert {path.name for path in (cache / NAME).iterdir()} == names  # no photograph and no .part stays
        references = load_references([NAME])
        assert [r.name for r in references] == [entry["file"][:-4] for entry in index["pictures"]]
        assert {r.credit for r in references} == {index["credit"]}

    def test_nothing_to_do_the_second_time(self, server):
        fetch(server)
        server.requests.clear()
        assert not missing_photographs(NAME, listed(server)) and fetch(server)["complete"]
        assert not fetched(server)

    def test_a_finer_step_keeps_what_is_there(self, server):
        fetch_library(NAME, listed(server, 5))
        server.requests.clear()
        assert len(fetch(server)["pictures"]) == 11
        assert len(fetched(server)) == 8

    @pytest.mark.parametrize("stop", [KeyboardInterrupt, None])
    def test_interrupted_and_taken_up_again(self, server, cache, stop, monkeypatch):
        monkeypatch.setattr(download, "_CHUNK_BYTES", 4000)
        seen = []

        def progress(fraction, text):
            seen.append(text)
            if stop and text.startswith("a_vm1004") and seen.count(text) == 2:
                raise stop

        cancelled = (lambda: False) if stop else (lambda: sum(t.startswith("a_vm1004") for t in seen) >= 2)
        with pytest.raises(stop or Cancelled):
            fetch(server, progress=progress, cancelled=cancelled)
        index = library.read_index(cache / NAME)
        assert not index["complete"] and len(index["pictures"]) == 3
        assert len(load_references([NAME])) == 3  # usable as far as it goes
        server.requests.clear()
        assert len(fetch(server)["pictures"]) == 11
        assert fetched(server)[0] == "a_vm1004.png" and len(fetched(server)) == 8
        assert next(r for _, p, r in server.requests if p.endswith("1004.png")) is not None  # from where it broke off

    def test_broken_connections(self, server):
        server.cuts["/head/a_vm1002.png"] = [3000, 7000]
        assert len(fetch(server)["pictures"]) == 11
        ranges = [r for _, path, r in server.requests if path.endswith("1002.png")]
        assert ranges == [None, "bytes=3000-", "bytes=7000-"]

    @pytest.mark.parametrize("refusals", [1, 3])
    def test_a_busy_server_is_waited_for(self, server, refusals):
        waited, photographs = [], listed(server)
        server.busy[:] = [503] * refusals
        index = fetch_library(NAME, photographs, wait=waited.append)
        assert waited == [1, 4, 16][:refusals] and len(index["pictures"]) == 11

    def test_a_server_that_stays_busy(self, server, cache):
        waited, photographs = [], listed(server)
        server.busy[:] = [503] * 4
        with pytest.raises(InputError, match="answers 503"):
            fetch_library(NAME, photographs, wait=waited.append)
        assert waited == [1, 4, 16] and not list(cache.glob("*/*.png"))

    @pytest.mark.parametrize(
        ("spoil", "why"),
        [
            (lambda data: None, "404"),
            (lambda data: data[:-20], "cut short|damaged PNG"),
            (lambda data: b"<!DOCTYPE html><title>busy</title>".ljust(len(data)), "not a PNG"),
            (lambda data: data[:2000] + bytes([data[2000] ^ 1]) + data[2001:], "damaged PNG"),
            (lambda data: cv2.imencode(".png", np.zeros((9, 8, 3), np.uint8))[1].tobytes(), "8 x 9 pixels instead of"),
            (lambda data: b"", "0 bytes cannot be"),
        ],
        ids=["404", "truncated", "html", "bit", "dimensions", "empty"],
    )
    def test_one_bad_file_in_the_middle_is_left_out(self, server, cache, spoil, why):
        path = "/head/a_vm1003.png"
        spoilt = spoil(server.files.pop(path))
        if spoilt is not None:
            server.files[path] = spoilt
            server.listed[path] = len(spoilt)
        index = fetch(server)
        assert [entry["source"] for entry in index["left_out"]] == ["a_vm1003.png"]
        assert re.search(why, index["left_out"][0]["why"]) and len(index["pictures"]) == 10
        assert not list((cache / NAME).glob(".*"))

    def test_many_bad_files_stop_it(self, server):
        for path in list(server.files)[:4]:
            server.files[path] = b"<html>".ljust(len(server.files[path]))
        with pytest.raises(
            InputError, match=r"3 photographs are missing or damaged on the server, the last: .*not a PNG"
        ):
            fetch(server)

    def test_another_size_than_listed(self, server):
        server.listed["/head/a_vm1003.png"] -= 1
        with pytest.raises(InputError, match=r"a_vm1003\.png: the file there has .* not the expected photograph"):
            fetch(server)

    def test_too_large(self, server, monkeypatch):
        monkeypatch.setattr(visible_human, "MAX_PHOTOGRAPH_BYTES", 100_000)
        server.listed["/head/a_vm1003.png"] = 10**10
        index = fetch(server)
        assert "10000000000 bytes cannot be" in index["left_out"][0]["why"]
        assert "a_vm1003.png" not in fetched(server)

    def test_a_file_that_changed(self, server, cache, photographs):
        (cache / NAME / fetch(server)["pictures"][2]["file"]).unlink()  # has to be made again
        again = fetch(server)
        assert len(again["pictures"]) == 11
        (cache / NAME / again["pictures"][2]["file"]).write_bytes(b"damaged")
        server.files["/head/a_vm1003.png"] = photographs["/thorax/a_vm1011.png"]
        server.listed["/head/a_vm1003.png"] = len(server.files["/head/a_vm1003.png"])
        with pytest.raises(InputError, match=r"a_vm1003\.png: differs from the file .* library remove"):
            fetch(server)

    def test_a_rest_of_another_version_is_thrown_away(self, server, cache):
        (cache / NAME).mkdir(parents=True)
        (cache / NAME / ".a_vm1001.png.part").write_bytes(bytes(3000))
        (cache / NAME / ".a_vm1002.png.part").write_bytes(bytes(10**6))
        assert len(fetch(server)["pictures"]) == 11

    def test_slices_without_tissue_are_asked_for_once(self, server):
        blue = np.full((*SHAPE, 3), (120, 74, 28), np.uint8)
        server.files["/head/a_vm1001.png"] = cv2.imencode(".png", blue)[1].tobytes()
        server.listed["/head/a_vm1001.png"] = len(server.files["/head/a_vm1001.png"])
        index = fetch(server)
        assert "no tissue" in index["left_out"][0]["why"] and len(index["pictures"]) == 10
        server.requests.clear()
        fetch(server)
        assert not fetched(server)


class TestAdd:
    @pytest.fixture
    def folder(self, tmp_path):
        (tmp_path / "My Atlas" / "more").mkdir(parents=True)
        for number, level in ((2, -0.4), (10, 0.1)):
            cv2.imwrite(str(tmp_path / "My Atlas" / f"plate {number}.png"), section(level)[..., ::-1])
        big = cv2.resize(section(0.5), (2480, 2640))
        cv2.imwrite(str(tmp_path / "My Atlas" / "more" / "big.jpg"), big[..., ::-1])
        return tmp_path / "My Atlas"

    def test_pictures_are_cut_and_bounded(self, folder, cache):
        name, index = library.add_library(folder, credit="Somebody")
        assert name == "my-atlas" and index["complete"] and index["credit"] == "Somebody"
        assert [entry["source"] for entry in index["pictures"]] == ["more/big.jpg", "plate 2.png", "plate 10.png"]
        references = load_references([name])
        assert max(references[0].rgb.shape) <= 1024
        whole = prepare_reference(section(-0.4))
        assert references[1].rgb.shape == whole.rgb.shape
        np.testing.assert_array_equal(references[1].mask, whole.mask)
        difference = np.abs(references[1].rgb.astype(int) - whole.rgb)[whole.mask]
        assert difference.max() <= 1  # black tissue is kept apart from the background

    def test_added_twice_is_prepared_once(self, folder, monkeypatch):
        library.add_library(folder)
        prepared = []
        monkeypatch.setattr(
            library, "prepare_reference", lambda rgb, name: prepared.append(name) or prepare_reference(rgb)
        )
        cv2.imwrite(str(folder / "plate 11.png"), section(0.3)[..., ::-1])
        _, index = library.add_library(folder)
        assert prepared == ["plate 11.png"] and len(index["pictures"]) == 4

    def test_what_cannot_be_used_is_named(self, folder, caplog):
        (folder / "broken.png").write_bytes(b"no picture")
        cv2.imwrite(str(folder / "grey.png"), np.arange(400, dtype=np.uint16).reshape(20, 20))
        with caplog.at_level(logging.WARNING, "MedColor"):
            _, index = library.add_library(folder)
        assert [entry["source"] for entry in index["left_out"]] == ["broken.png", "grey.png"]
        assert "broken.png" in caplog.text and len(index["pictures"]) == 3

    def test_nothing_usable_leaves_no_library(self, tmp_path):
        (tmp_path / "bad").mkdir()
        with pytest.raises(InputError, match="bad holds no picture"):
            library.add_library(tmp_path / "bad")
        cv2.imwrite(str(tmp_path / "bad" / "blue.png"), np.full((60, 60, 3), (120, 74, 28), np.uint8))
        with pytest.raises(InputError, match=r"none of 1 pictures in bad can be used; the first: .*no tissue"):
            library.add_library(tmp_path / "bad")
        assert library.list_libraries() == []
        with pytest.raises(InputError, match="no folder"):
            library.add_library(tmp_path / "gone")

    @pytest.mark.parametrize("name", ["", "../up", "Großer Atlas", "a/b", ".hidden", "x" * 65])
    def test_names_that_are_none(self, folder, name):
        with pytest.raises(SettingsError, match="library name"):
            library.add_library(folder, name)

    def test_a_full_disk(self, folder, monkeypatch, cache):
        cache.parent.mkdir(parents=True, exist_ok=True)
        cache.write_text("a file in the way")
        with pytest.raises(OutputError, match="cannot be written in the cache folder"):
            library.add_library(folder)

    def test_cancelled_and_taken_up_again(self, folder):
        seen = []
        with pytest.raises(Cancelled):
            library.add_library(folder, progress=lambda *step: seen.append(step), cancelled=lambda: len(seen) >= 2)
        assert [(row["pictures"], row["complete"]) for row in library.list_libraries()] == [(2, False)]
        assert len(library.add_library(folder)[1]["pictures"]) == 3

    def test_removed(self, folder):
        name, _ = library.add_library(folder)
        library.remove_library(name)
        assert library.list_libraries() == []
        for gone in (name, "..", ""):
            with pytest.raises(InputError, match="there is none yet"):
                library.remove_library(gone)

    def test_a_damaged_index(self, folder, cache):
        name, _ = library.add_library(folder)
        (cache / name / "library.json").write_text("{")
        with pytest.raises(InputError, match="missing or damaged; run `medcolor library remove my-atlas`"):
            load_references([name])
        assert library.list_libraries() == []
        library.remove_library(name)


class TestFolderOrName:
    def test_a_folder_wins(self, tmp_path, monkeypatch):
        (tmp_path / "atlas").mkdir()
        cv2.imwrite(str(tmp_path / "atlas" / "a.png"), section(0.0)[..., ::-1])
        library.add_library(tmp_path / "atlas")
        assert library.library_folder("atlas") == library.find_library("atlas")
        monkeypatch.chdir(tmp_path)
        assert library.library_folder("atlas") == (tmp_path / "atlas").relative_to(tmp_path)

    @pytest.mark.parametrize("name", ["nobody", "visible-human-male"])
    def test_neither(self, name):
        with pytest.raises(InputError, match=f"library {name}: no such folder, and no library is called {name}"):
            library.library_folder(name)
        with pytest.raises(InputError, match=f"reference: no file {name}, and no library is called {name}"):
            load_references([name])


class TestCommand:
    def medcolor(self, *arguments) -> int:
        try:
            return main([str(a) for a in arguments])
        except SystemExit as end:
            return end.code

    def test_fetch_list_remove(self, server, capsys):
        line = ("library", "fetch", NAME, "--url", server.url, "--part", "head", "--part", "thorax")
        assert self.medcolor(*line) == 2  # nobody to ask
        told = capsys.readouterr()
        assert "3 photographs, one every 5 mm; 3 to fetch, 0." in told.out and "Courtesy of the U.S." in told.out
        assert told.err == "medcolor: library fetch: nobody can be asked here; add --yes to start the download\n"
        assert self.medcolor(*line, "--yes") == 0
        assert "library visible-human-male: 3 references. Courtesy of the U.S." in capsys.readouterr().out
        assert self.medcolor("library", "list") == 0
        assert re.search(r"visible-human-male\s+3 references, 0\.\d MB\. Courtesy", capsys.readouterr().out)
        assert self.medcolor("library", "remove", NAME) == 0
        assert self.medcolor("library", "remove", NAME) == 2

    def test_without_a_connection(self, capsys):
        assert self.medcolor("library", "fetch", NAME, "--yes", "--url", "https://127.0.0.1:9/") == 2
        error = capsys.readouterr().err
        assert (
            error.startswith("medcolor: https://127.0.0.1:9/head/index.html: no connection") and error.count("\n") == 1
        )

    def test_add_and_use(self, tmp_path, capsys, ct):
        (tmp_path / "plates").mkdir()
        cv2.imwrite(str(tmp_path / "plates" / "a.png"), section(0.0)[..., ::-1])
        assert self.medcolor("library", "add", tmp_path / "plates", "--name", "mine", "--credit", "Me") == 0
        assert "library mine: 1 references. Me" in capsys.readouterr().out
        from MedColorLib import Settings, colorize

        settings = Settings(preset="draft", features="embedded", slices=(4, 6))
        report = colorize(ct.volume, ["mine"], settings).report
        assert report["plan"]["steps"]["references"].endswith("; Me")
        assert [reference["credit"] for reference in report["references"]] == ["Me"]


def test_png_check_on_every_length_and_on_trailing_bytes():
    data = cv2.imencode(".png", np.zeros((3, 4, 3), np.uint8))[1].tobytes()
    check_png(data, (3, 4))
    for length in range(len(data)):
        with pytest.raises(ValueError, match="PNG"):
            check_png(data[:length], (3, 4))
    with pytest.raises(ValueError, match="PNG"):
        check_png(data + b"more than that", (3, 4))


def test_the_index_is_plain_json(tmp_path, cache):
    (tmp_path / "one").mkdir()
    cv2.imwrite(str(tmp_path / "one" / "a.png"), section(0.0)[..., ::-1])
    name, index = library.add_library(tmp_path / "one")
    text = (cache / name / "library.json").read_text(encoding="utf-8")
    assert json.loads(text) == index and str(tmp_path) not in text
