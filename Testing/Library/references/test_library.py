"""Libraries of references: added, listed, removed, by folder or name, on the command line."""

from __future__ import annotations

import json
import logging
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from library_samples import NAME

from MedColorLib.cli.main import main
from MedColorLib.errors import Cancelled, InputError, OutputError, SettingsError
from MedColorLib.phantom import section
from MedColorLib.references import library
from MedColorLib.references.loading import load_references
from MedColorLib.references.photograph import prepare_reference
from MedColorLib.references.visible_human import check_png

pytestmark = pytest.mark.usefixtures("cache")


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "My Atlas" / "more").mkdir(parents=True)
    for number, level in ((2, -0.4), (10, 0.1)):
        cv2.imwrite(str(tmp_path / "My Atlas" / f"plate {number}.png"), section(level)[..., ::-1])
    big = cv2.resize(section(0.5), (2480, 2640))
    cv2.imwrite(str(tmp_path / "My Atlas" / "more" / "big.jpg"), big[..., ::-1])
    return tmp_path / "My Atlas"


class TestAdd:
    def test_pictures_are_cut_and_bounded(self, folder, cache):
        name, index = library.add_library(folder, credit="Somebody")
        assert name == "my-atlas" and index["complete"] and index["credit"] == "Somebody"
        assert [entry["source"] for entry in index["pictures"]] == ["more/big.jpg", "plate 2.png", "plate 10.png"]
        references = load_references([name], exposure="off")
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
        with caplog.at_level(logging.WARNING, "MedColorLib"):
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
        capsys.readouterr()
        assert self.medcolor("library", "list") == 0
        assert "no library yet: `medcolor library add FOLDER` makes one" in capsys.readouterr().out

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


class TestOnlyItsOwn:
    """What a library deletes is what MedColor made, and what it reads lies in it."""

    @pytest.fixture
    def atlas(self, folder, cache) -> Path:
        name, _ = library.add_library(folder)
        return cache / name

    @pytest.mark.parametrize("damaged", [False, True])
    def test_files_of_others_stay(self, atlas, damaged, caplog):
        (atlas / "notes.txt").write_text("mine")
        (atlas / "own-photograph.png").write_bytes(b"mine")
        (atlas / "thesis").mkdir()
        if damaged:
            (atlas / "library.json").write_text("{")
        library.remove_library(atlas.name)
        assert sorted(p.name for p in atlas.iterdir()) == ["notes.txt", "own-photograph.png", "thesis"]
        assert "3 files that are not MedColor's stay" in caplog.text

    def test_a_folder_without_an_index_is_none(self, cache):
        (cache / "photos").mkdir(parents=True)
        (cache / "photos" / "mine.png").write_bytes(b"mine")
        with pytest.raises(OutputError, match="none of MedColor's"):
            library.remove_library("photos")
        assert (cache / "photos" / "mine.png").exists()

    def test_links_are_not_followed(self, atlas, tmp_path):
        elsewhere = tmp_path / "elsewhere"
        atlas.rename(elsewhere)
        atlas.symlink_to(elsewhere)
        count = len(list(elsewhere.iterdir()))
        with pytest.raises(OutputError, match="is a link, which is not followed"):
            library.remove_library(atlas.name)
        assert len(list(elsewhere.iterdir())) == count

    @pytest.mark.parametrize(
        "name", ["../secret.png", "/etc/secret.png", "sub/secret.png", "..", "C:secret.png", "a\\b.png", ""]
    )
    def test_pictures_elsewhere_are_not_read_or_deleted(self, atlas, name, tmp_path):
        (atlas.parent / "secret.png").write_bytes(b"mine")
        index = json.loads((atlas / "library.json").read_text())
        index["pictures"][0]["file"] = name
        (atlas / "library.json").write_text(json.dumps(index))
        with pytest.raises(InputError, match="which lies outside of it; run `medcolor library remove"):
            load_references([atlas.name])
        library.remove_library(atlas.name)
        assert (atlas.parent / "secret.png").exists() and not atlas.exists()

    def test_a_link_leads_elsewhere(self, atlas, tmp_path):
        index = json.loads((atlas / "library.json").read_text())
        file = atlas / index["pictures"][0]["file"]
        file.rename(tmp_path / "elsewhere.png")
        file.symlink_to(tmp_path / "elsewhere.png")
        with pytest.raises(InputError, match="which lies outside of it"):
            load_references([atlas.name])

    @pytest.mark.parametrize(
        "text", ["{}", "[]", "null", "3", '{"pictures": 3}', "[" * 5000, '{"pictures": [{"file": 3}]}']
    )
    def test_any_index_that_is_none(self, atlas, text):
        (atlas / "library.json").write_text(text)
        with pytest.raises(InputError, match="missing or damaged"):
            library.read_index(atlas)
        assert library.list_libraries() == []

    def test_a_folder_of_photographs_beside_another_programs_index(self, folder):
        before = load_references([folder])
        (folder / "library.json").write_text('{"name": "of another program"}')
        for one, other in zip(before, load_references([folder])):
            np.testing.assert_array_equal(one.mask, other.mask)

    def test_a_damaged_picture_is_left_out_and_the_others_keep_their_share(self, atlas):
        index = library.read_index(atlas)
        (atlas / index["pictures"][0]["file"]).write_bytes(b"damaged")
        found = load_references([atlas.name])
        assert [r.removed for r in found] == [e["removed"] for e in index["pictures"][1:]]
        assert "left out of library" in found[0].notes[0]


def test_what_can_be_fetched_is_said():
    from MedColorLib.references.visible_human import SOURCES

    assert tuple(SOURCES) == library.FETCHED
    for ask in (library.library_folder, lambda name: load_references([name]), library.remove_library):
        with pytest.raises(InputError, match="run `medcolor library fetch visible-human-male` to get it"):
            ask("visible-human-male")
