"""Recommendation: the section of the volume's own level comes first, and a library is described only once."""

from __future__ import annotations

import logging
import os

import cv2
import numpy as np
import pytest

from MedColorLib.errors import Cancelled, InputError
from MedColorLib.features.contrast_net import Contrast
from MedColorLib.matching.recommend import Recommender, index_library, recommend
from MedColorLib.phantom import section

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
    descriptor = Contrast.descriptor
    monkeypatch.setattr(Contrast, "descriptor", lambda self, x: seen.append(len(x)) or descriptor(self, x))
    return seen


def ask(ct, library, **options):
    found = recommend(ct.volume, library, features="embedded", device="cpu", **options)
    return [(os.path.basename(path)[:-4], score) for path, score in found]


@pytest.mark.parametrize(("k", "name"), [(3, "eyes"), (7, "middle")])
def test_a_slice_finds_its_level(ct, library, k, name):
    found = ask(ct, library, slice_index=k)
    assert found[0][0] == name and [s for _, s in found] == sorted((s for _, s in found), reverse=True)
    assert all(-1 <= score <= 1 + 1e-6 for _, score in found)


@pytest.mark.parametrize(("top", "count"), [(1, 1), (2, 2), (99, 3)])
def test_as_many_as_asked_for_and_there(ct, library, top, count):
    assert len(ask(ct, library, top=top)) == count


def test_described_once_and_again_when_changed(ct, library, described, sections):
    first = ask(ct, library, slice_index=3)
    assert len(described) == 1 + 3
    assert ask(ct, library, slice_index=3) == first and len(described) == 4 + 1
    (library / "eyes.png").rename(library / "renamed.png")  # the same content under another name
    assert ask(ct, library, slice_index=3)[0][0] == "renamed" and len(described) == 5 + 1
    cv2.imwrite(str(library / "renamed.png"), np.ascontiguousarray(sections["middle"][:-2]))
    ask(ct, library, slice_index=3)
    assert len(described) == 6 + 2


def test_a_damaged_index_is_made_anew(ct, library, cache, caplog):
    first = ask(ct, library)
    (index,) = (cache / "library").iterdir()
    index.write_bytes(b"damaged")
    with caplog.at_level(logging.WARNING, "MedColorLib"):
        assert ask(ct, library) == first
    assert "index is damaged" in caplog.text and [p.name for p in (cache / "library").iterdir()] == [index.name]


def test_a_cache_that_cannot_be_written_costs_time_only(ct, library, cache, caplog):
    cache.write_text("a file in the way")
    with caplog.at_level(logging.WARNING, "MedColorLib"):
        assert ask(ct, library, slice_index=3)[0][0] == "eyes"
    assert "index is not kept" in caplog.text


def test_unusable_pictures_are_left_out_and_named(ct, library, caplog):
    (library / "broken.png").write_bytes(b"no picture")
    cv2.imwrite(str(library / "grey.png"), np.arange(400, dtype=np.uint16).reshape(20, 20))
    with caplog.at_level(logging.WARNING, "MedColorLib"):
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
    extractor, seen = Contrast(), []
    with pytest.raises(Cancelled):
        index_library(library, extractor, lambda *step: seen.append(step), lambda: len(seen) >= 2)
    assert len(described) == 2 and [fraction for fraction, _ in seen] == [0, pytest.approx(1 / 3)]
    paths, descriptors = index_library(library, extractor)
    assert len(described) == 3 and len(paths) == len(descriptors) == 3
    assert descriptors.shape[1] == 2


def test_a_recommender_answers_as_one_call_does_and_describes_nothing_again(ct, mr, library, described, monkeypatch):
    from MedColorLib.scan import body

    outlined = []
    find_body = body.find_body
    monkeypatch.setattr(body, "find_body", lambda view, *rest: outlined.append(view) or find_body(view, *rest))
    one = Recommender(library, "embedded", "cpu")
    for volume, k in ((ct.volume, 3), (ct.volume, 7), (ct.volume, None), (mr.volume, 7)):
        found = one.recommend(volume, slice_index=k)
        again = recommend(volume, library, slice_index=k, features="embedded", device="cpu")
        assert [path for path, _ in found] == [path for path, _ in again]
        np.testing.assert_allclose([s for _, s in found], [s for _, s in again], atol=2e-3)  # the index is float16
    assert sum(view is outlined[0] or np.shares_memory(view, ct.volume.array) for view in outlined) == 1 + 3
    assert len(described) == 3 + 4 * 2  # three pictures once; each question one pass


def test_a_recommender_takes_up_new_pictures_when_it_looks_again(ct, library, sections):
    one = Recommender(library, "embedded", "cpu")
    assert len(one.recommend(ct.volume, 9)) == 3
    cv2.imwrite(str(library / "new.png"), section(0.0)[..., ::-1])
    assert len(one.recommend(ct.volume, 9)) == 3
    one.look_again()
    assert len(one.recommend(ct.volume, 9)) == 4


@pytest.mark.parametrize("flip", [np.s_[::-1], np.s_[::-1, ::-1]], ids=["upside down", "turned by half"])
def test_photographs_that_lie_the_other_way_are_found_as_well(ct, tmp_path, sections, flip):
    (tmp_path / "down").mkdir()
    for name, picture in sections.items():
        cv2.imwrite(str(tmp_path / "down" / f"{name}.png"), np.ascontiguousarray(picture[flip]))
    assert [ask(ct, tmp_path / "down", slice_index=k)[0][0] for k in (3, 7)] == ["eyes", "middle"]


def test_a_library_by_its_name(ct, library, cache):
    from MedColorLib.references.library import add_library

    add_library(library, "plates")
    by_name, by_folder = ask(ct, "plates", slice_index=3), ask(ct, library, slice_index=3)
    assert by_name[0][0].startswith("eyes-") and by_name[0][1] == pytest.approx(by_folder[0][1], abs=0.01)


def test_a_picture_that_cannot_be_read_is_left_out(ct, library, caplog, monkeypatch):
    from pathlib import Path

    read_bytes = Path.read_bytes

    def refused(path):
        if path.name == "eyes.png":
            raise PermissionError(13, "Permission denied")
        return read_bytes(path)

    monkeypatch.setattr(Path, "read_bytes", refused)
    with caplog.at_level(logging.WARNING, "MedColorLib"):
        assert len(ask(ct, library)) == 2
    assert "eyes.png: cannot be read (Permission denied)" in caplog.text


def test_a_link_that_leads_nowhere_is_no_picture(ct, library):
    (library / "gone.png").symlink_to(library / "nothing.png")
    assert len(ask(ct, library, top=9)) == 3
