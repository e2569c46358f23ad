"""Libraries: prepared once, taken up again, checked; the server is on the loopback interface, pictures are made by formula."""

from __future__ import annotations

import gc
import hashlib
import re

import cv2
import numpy as np
import pytest
from library_samples import NAME, SHAPE, fetch, listed

from MedColorLib.errors import Cancelled, InputError, SettingsError
from MedColorLib.features import download
from MedColorLib.references import library, visible_human
from MedColorLib.references.loading import load_references
from MedColorLib.references.visible_human import fetch_library, list_photographs, missing_photographs

pytestmark = pytest.mark.usefixtures("cache")


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
        gc.collect()  # a connection that was left open is a warning now, and a warning an error

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
