"""Recommendation: the section of the volume's own level comes first, and a library is described only once."""

from __future__ import annotations

import logging
import os

import cv2
import numpy as np
import pytest

from MedColorLib.errors import Cancelled, InputError
from MedColorLib.features.embedded import Embedded
from MedColorLib.phantom import section
from MedColorLib.recommend import index_library, recommend

LEVELS = {"eyes": -0.45, "middle": 0.2, "top": 0.75}


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setattr("MedColorLib.features.weights.cache_folder", lambda: tmp_path / "cache")
    return tmp_path / "cache"


@pytest.fixture(scope="session")
def sections():
    return {name: section(level)[..., ::-1] for name, level in LEVELS.items()}


@pytest.fixture
def library(tmp_path, sections):
    (tmp_path / "library" / "deeper").mkdir(parents=True)
    for name, picture in sections.items():
        cv2.imwrite(str(tmp_path / "library" / ("deeper" if name == "top" else ".") / f"{name}.png"), picture)
    return tmp_path / "library"


@pytest.fixture
def described(monkeypatch):
    """Number of pictures or slices described so far."""
    seen = []
    descriptor = Embedded.descriptor
    monkeypatch.setattr(Embedded, "descriptor", lambda self, x: seen.append(len(x)) or descriptor(self, x))
    return seen


def ask(ct, library, **options):
    found = recommend(ct.volume, library, features="embedded", device="cpu", **options)
    return [(os.path.basename(path)[:-4], score) for path, score in found]


@pytest.mark.parametrize(("k", "name"), [(3, "eyes"), (4, "eyes"), (7, "middle")])
def test_a_slice_finds_its_level(ct, library, k, name):
    found = ask(ct, library, slice_index=k)
    assert found[0][0] == name and [s for _, s in found] == sorted((s for _, s in found), reverse=True)
    assert all(-1 <= score <= 1 + 1e-6 for _, score in found)


@pytest.mark.parametrize(("top", "count"), [(1, 1), (2, 2), (99, 3)])
def test_as_many_as_asked_for_and_there(ct, library, top, count):
    assert len(ask(ct, library, top=top)) == count


def test_described_once_and_again_when_changed(ct, library, described, sections):
    first = ask(ct, library, slice_index=4)
    assert len(described) == 1 + 3
    assert ask(ct, library, slice_index=4) == first and len(described) == 4 + 1
    (library / "eyes.png").rename(library / "renamed.png")  # the same content under another name
    assert ask(ct, library, slice_index=4)[0][0] == "renamed" and len(described) == 5 + 1
    cv2.imwrite(str(library / "renamed.png"), np.ascontiguousarray(sections["middle"][:-2]))
    ask(ct, library, slice_index=4)
    assert len(described) == 6 + 2


def test_a_damaged_index_is_made_anew(ct, library, cache, caplog):
    first = ask(ct, library)
    (index,) = (cache / "library").iterdir()
    index.write_bytes(b"damaged")
    with caplog.at_level(logging.WARNING, "MedColor"):
        assert ask(ct, library) == first
    assert "index is damaged" in caplog.text and [p.name for p in (cache / "library").iterdir()] == [index.name]


def test_a_cache_that_cannot_be_written_costs_time_only(ct, library, cache, caplog):
    cache.write_text("a file in the way")
    with caplog.at_level(logging.WARNING, "MedColor"):
        assert ask(ct, library, slice_index=4)[0][0] == "eyes"
    assert "index is not kept" in caplog.text


def test_unusable_pictures_are_left_out_and_named(ct, library, caplog):
    (library / "broken.png").write_bytes(b"no picture")
    cv2.imwrite(str(library / "grey.png"), np.arange(400, dtype=np.uint16).reshape(20, 20))
    with caplog.at_level(logging.WARNING, "MedColor"):
        assert len(ask(ct, library, top=9)) == 3
    assert "broken.png" in caplog.text and "grey.png" in caplog.text


def test_nothing_usable(ct, tmp_path):
    (tmp_path / "bad").mkdir()
    with pytest.raises(InputError, match="library bad: holds no picture"):
        ask(ct, tmp_path / "bad")
    (tmp_path / "bad" / "a.png").write_bytes(b"no picture")
    with pytest.raises(InputError, match="none of its 1 pictures"):
        ask(ct, tmp_path / "bad")
    with pytest.raises(InputError, match="no such folder"):
        ask(ct, tmp_path / "gone")


def test_a_slice_without_body(ct, library):
    with pytest.raises(InputError, match="slice 99: no body there; body was found in"):
        ask(ct, library, slice_index=99)


def test_cancelling_keeps_what_has_been_described(library, described):
    extractor, seen = Embedded(), []
    with pytest.raises(Cancelled):
        index_library(library, extractor, lambda *step: seen.append(step), lambda: len(seen) >= 2)
    assert len(described) == 2 and [fraction for fraction, _ in seen] == [0, pytest.approx(1 / 3)]
    paths, descriptors = index_library(library, extractor)
    assert len(described) == 3 and len(paths) == len(descriptors) == 3
