"""What a user names becomes references: pictures, folders, colour volumes in files and in memory."""

from __future__ import annotations

import os
import sys

import cv2
import numpy as np
import pytest
import SimpleITK as sitk
from PIL import Image
from scipy.ndimage import binary_erosion

from MedColorLib import ColorVolume, Settings, Volume, colorize, make_plan, read_color_volume, write_color_volume
from MedColorLib.color.difference import ciede2000
from MedColorLib.color.lab import lightness_to_gray, srgb_to_lab
from MedColorLib.errors import InputError
from MedColorLib.phantom import section
from MedColorLib.references.color_sections import MOST_SECTIONS, sections
from MedColorLib.references.loading import MANY, SIDE_OF_MANY_PX, describe_references, load_references


@pytest.fixture
def colored(ct) -> ColorVolume:
    return ColorVolume(ct.colors, ct.volume.ijk_to_ras, name="atlas")


def vector_file(path, values, ijk_to_ras) -> str:
    image = sitk.GetImageFromArray(np.ascontiguousarray(values), isVector=True)
    lps = np.diag([-1.0, -1.0, 1.0, 1.0]) @ ijk_to_ras
    spacing = np.linalg.norm(lps[:3, :3], axis=0)
    image.SetSpacing(spacing)
    image.SetDirection((lps[:3, :3] / spacing).ravel())
    image.SetOrigin(lps[:3, 3])
    sitk.WriteImage(image, str(path))
    return str(path)


def same(one, other):
    assert len(one) == len(other)
    for a, b in zip(one, other):
        np.testing.assert_array_equal(a.rgb, b.rgb)
        np.testing.assert_array_equal(a.mask, b.mask)


@pytest.mark.parametrize("ending", [".nrrd", ".nii.gz", ".mha", ".mhd"])
def test_a_file_and_the_object_give_the_same_references(colored, tmp_path, ending):
    path = vector_file(tmp_path / f"atlas{ending}", colored.rgb, colored.ijk_to_ras)
    found = load_references([path])
    same(found, load_references(colored))
    assert 8 <= len(found) <= 12 and all(r.mask.any() for r in found)


@pytest.mark.parametrize("ending", [".nrrd", ".nii.gz"])
def test_what_medcolor_wrote_is_a_reference(colored, tmp_path, ending):
    write_color_volume(colored, tmp_path / f"own{ending}")
    same(load_references([tmp_path / f"own{ending}"]), load_references([read_color_volume(tmp_path / f"own{ending}")]))


def test_sections_run_from_the_feet_up_whatever_way_the_volume_lies(colored):
    expected = load_references(colored)
    ijk_to_ras = colored.ijk_to_ras @ np.array([[0, 0, 1, 0], [0, 1, 0, 0], [1, 0, 0, 0], [0, 0, 0, 1.0]])
    swapped = ColorVolume(np.ascontiguousarray(colored.rgb.transpose(2, 1, 0, 3)), ijk_to_ras)
    same(load_references(swapped), expected)
    upside = colored.ijk_to_ras.copy()
    upside[:3, 2], upside[:3, 3] = -upside[:3, 2], upside[:3, 3] + 11 * upside[:3, 2]
    same(load_references(ColorVolume(np.ascontiguousarray(colored.rgb[::-1]), upside)), expected)


def test_transparent_voxels_are_not_tissue(colored, tmp_path):
    alpha = np.full((*colored.rgb.shape[:3], 1), 255, np.uint8)
    alpha[:, :, :20] = 0
    rgba = np.concatenate([colored.rgb, alpha], axis=3)
    found = load_references([vector_file(tmp_path / "rgba.nrrd", rgba, colored.ijk_to_ras)])
    cut = colored.rgb.copy()
    cut[:, :, :20] = 0
    same(found, load_references(ColorVolume(cut, colored.ijk_to_ras)))


@pytest.mark.parametrize(("count", "step"), [(64, 1), (65, 2), (200, 4), (1, 1)])
def test_at_most_so_many_sections_evenly_spread(count, step):
    rgb = np.zeros((count + 6, 8, 8, 3), np.uint8)
    rgb[3:-3, 2:6, 2:6] = (200, 100, 50)
    found = sections(rgb, np.eye(4), "stack")
    numbers = np.array([int(r.name.split()[-1]) for r in found])
    assert len(found) == -(-count // step) <= MOST_SECTIONS and set(np.diff(numbers)) <= {step}
    assert numbers[0] - 3 <= step / 2 and count + 2 - numbers[-1] <= step / 2
    text = describe_references(found)
    assert len(text) < 200 and (count < 8 or f"{len(found)} of colour volume stack, every" in text)


def test_air_inside_the_body_is_part_of_it(colored):
    rgb = np.zeros((1, 9, 9, 3), np.uint8)
    rgb[0, 1:8, 1:8] = 90
    rgb[0, 4, 4] = 0
    (found,) = sections(rgb, np.eye(4), "ring")
    assert found.mask.all() and found.rgb.shape == (7, 7, 3)


@pytest.mark.parametrize(
    ("write", "words"),
    [
        (lambda p, c: vector_file(p / "x.nrrd", np.zeros_like(c.rgb), c.ijk_to_ras), "black everywhere"),
        (lambda p, c: vector_file(p / "x.nrrd", c.rgb.astype(np.uint16), c.ijk_to_ras), "not a colour volume"),
        (lambda p, c: vector_file(p / "x.mha", c.rgb[..., :2], c.ijk_to_ras), "with 2 components"),
        (lambda p, c: str(p / "gone.nrrd"), "no file"),
        (lambda p, c: str((p / "x.nrrd").write_bytes(b"NRRD0004\n") and p / "x.nrrd"), "the NRRD header lacks"),
        (lambda p, c: str((p / "x.nii").write_bytes(bytes(400)) and p / "x.nii"), "not a NIfTI, or damaged"),
    ],
    ids=["black", "16 bits", "two components", "missing", "damaged", "zeros"],
)
def test_volumes_that_are_no_reference(colored, tmp_path, write, words):
    with pytest.raises(InputError, match=words):
        load_references([write(tmp_path, colored)])


def test_a_volume_too_large_is_refused_before_it_is_read(colored, tmp_path, monkeypatch):
    monkeypatch.setattr("MedColorLib.references.color_sections.MAX_BYTES", 1000)
    path = vector_file(tmp_path / "large.nrrd", colored.rgb, colored.ijk_to_ras)
    monkeypatch.setattr("MedColorLib.io.nrrd.read_voxels", lambda *_, **__: pytest.fail("was read"))
    with pytest.raises(InputError, match=r"large\.nrrd: .* more than the limit"):
        load_references([path])


@pytest.mark.skipif(sys.platform != "linux", reason="names are text here, not bytes")
def test_a_path_that_is_not_utf8(colored, ct, tmp_path):
    path = tmp_path / os.fsdecode(b"F\xe4rbung.nrrd")
    vector_file(tmp_path / "plain.nrrd", colored.rgb, colored.ijk_to_ras)
    (tmp_path / "plain.nrrd").rename(path)
    assert len(load_references([path])) == len(load_references([colored]))
    folder = tmp_path / os.fsdecode(b"F\xe4rbungen")
    folder.mkdir()
    cv2.imwrite(str(tmp_path / "p.png"), ct.reference[..., ::-1])
    (tmp_path / "p.png").rename(folder / os.fsdecode(b"Schl\xe4fe.png"))
    assert len(load_references([folder])) == 1


class TestFolders:
    def test_natural_order_and_different_sizes(self, tmp_path):
        for number in (10, 9, 1):
            picture = cv2.resize(section(-0.4), (100 + 10 * number, 120))
            cv2.imwrite(str(tmp_path / f"s{number}.png"), picture[..., ::-1])
        found = load_references([tmp_path])
        assert [r.name for r in found] == ["s1", "s9", "s10"]
        assert len({r.rgb.shape for r in found}) == 3
        assert "s10 (" in describe_references(found)

    def test_many_are_kept_small_and_told_in_one_line(self, tmp_path):
        picture = cv2.resize(section(-0.4), (1240, 1320))[..., ::-1]
        for number in range(MANY + 1):
            cv2.imwrite(str(tmp_path / f"s{number}.jpg"), picture)
        found = load_references([tmp_path])
        assert {min(r.mask.shape) for r in found} == {SIDE_OF_MANY_PX}
        assert describe_references(found).startswith(f"{MANY + 1} of {tmp_path.name}, s0 to s{MANY} (")

    def test_nothing_there(self, tmp_path):
        with pytest.raises(InputError, match="holds no picture"):
            load_references([tmp_path])
        with pytest.raises(InputError, match="none given"):
            load_references([])


def test_one_reference_for_many_slices_is_fine():
    rng = np.random.default_rng(0)
    array = np.zeros((300, 24, 24), np.float32)
    array[:, 4:20, 4:20] = 500 + rng.normal(0, 20, (300, 16, 16))
    plan = make_plan(Volume(array), [section(0.0)], Settings(preset="draft", features="embedded"))
    assert len(plan.slices) == 300 and "changes" not in plan.steps["coherence"]


def test_a_colour_volume_gives_its_own_luminance_its_colours_back(ct, colored):
    """Grey of the phantom's true colours after these colours, slice by slice in the order of the body."""
    lab = srgb_to_lab(colored.rgb / 255.0)
    grey = Volume(
        np.rint(1000 * lightness_to_gray(lab[..., 0])).astype(np.int16), colored.ijk_to_ras, window=(0.0, 1000.0)
    )
    # as the volume is: its own lightness is given, and its colours are in the light that is meant
    settings = Settings(preset="draft", features="embedded", coherence_mm=0.0, luminance="keep", exposure="off")
    result = colorize(grey, [colored], settings)
    assert result.report["references_assigned"] == "along the series"
    for k, name in result.report["reference_of_slice"].items():
        assert name == f"atlas slice {k}"
    body = binary_erosion(
        ct.labels > 0, np.ones((1, 7, 7))
    )  # its border fades, here for the second time: `coloring.rim`
    errors = ciede2000(srgb_to_lab(result.rgb[body] / 255.0), lab[body])
    one = colorize(grey, [np.pad(colored.rgb[3], ((4, 4), (4, 4), (0, 0)))], settings)
    after_one = ciede2000(srgb_to_lab(one.rgb[body] / 255.0), lab[body])
    assert np.median(errors) < 1 and errors.mean() < 0.3 * after_one.mean()


class TestPicturesOfAFolder:
    @pytest.fixture
    def folder(self, tmp_path):
        folder = tmp_path / "plates"
        folder.mkdir()
        for name in ("b.png", "d.webp", "f.gif"):
            Image.fromarray(section(-0.4)).save(folder / name)
        for name in ("a.jpg", "e.tif"):
            (folder / name).write_bytes(b"no picture")
        (folder / "._b.png").write_bytes(b"no picture")
        return folder

    def test_broken_ones_are_left_out_and_said(self, folder, ct, caplog):
        found = load_references([folder])
        assert [r.name for r in found] == ["b", "d", "f"]
        assert [m for m in caplog.messages if "left out of plates: reference a.jpg: not a picture" in m]
        assert len(caplog.messages) == 2
        settings = Settings(preset="draft", features="embedded", slices=(4, 5))
        text = make_plan(ct.volume, [folder], settings).text()
        assert text.count("left out of plates") == 2 and "reference e.tif: not a picture" in text
        notes = [r["notes"] for r in colorize(ct.volume, [folder], settings).report["references"]]
        assert [len(n) for n in notes] == [2, 0, 0] and "a.jpg" in notes[0][0]

    def test_a_broken_one_by_itself_is_an_error(self, folder):
        with pytest.raises(InputError, match=r"reference a\.jpg: not a picture"):
            load_references([folder / "b.png", folder / "a.jpg"])

    def test_all_broken_is_an_error(self, folder):
        for name in ("b.png", "d.webp", "f.gif"):
            (folder / name).write_bytes(b"")
        with pytest.raises(InputError, match=r"folder plates: none of its 5 pictures can be used; the first: .*a\.jpg"):
            load_references([folder])

    def test_notes_of_single_pictures(self, folder):
        exif = Image.Exif()
        exif[0x0112] = 6
        for number in range(3):
            Image.fromarray(section(-0.4)).save(folder / f"turned{number}.png", exif=exif)
        found = load_references([folder])
        assert sum("turned upright" in note for r in found for note in r.notes) == 3
        assert "left out of plates: reference a.jpg" in describe_references(found)

    def test_two_of_one_name_are_told_apart(self, tmp_path, ct):
        paths = []
        for number, level in enumerate((-0.45, 0.1, 0.55)):
            (tmp_path / str(number)).mkdir()
            paths.append(tmp_path / str(number) / "section.png")
            Image.fromarray(section(level)).save(paths[-1])
        assert [r.name for r in load_references(paths)] == ["section", "section (2)", "section (3)"]
        report = colorize(ct.volume, paths, Settings(preset="draft", features="embedded")).report
        named = set(report["reference_of_slice"].values())
        assert (
            len(named) > 1
            and named == set(report["reference_lies"])
            and named <= {r["name"] for r in report["references"]}
        )


class TestLargePictures:
    """A photograph larger than needed gives what a smaller one gives, and its labels still fit."""

    @pytest.fixture
    def large(self) -> np.ndarray:
        return cv2.resize(section(-0.4), (4000, 3600), interpolation=cv2.INTER_CUBIC)

    def test_kept_at_most_so_long_and_of_the_same_colors(self, large, tmp_path):
        Image.fromarray(large).save(tmp_path / "large.png")
        (one,), (array,) = load_references([tmp_path / "large.png"]), load_references([large])
        small = load_references([cv2.resize(large, (1000, 900), interpolation=cv2.INTER_AREA)])[0]
        for found in (one, array):
            assert max(found.mask.shape) == 1024 and found.frame.shape == (3600, 4000)
            assert found.removed == pytest.approx(small.removed, abs=0.01)
            mean = found.rgb[found.mask].mean(axis=0)
            np.testing.assert_allclose(mean, small.rgb[small.mask].mean(axis=0), atol=1.5)
            sides = [np.diff(ends)[0] / size for ends, size in zip((found.frame.rows, found.frame.cols), (3600, 4000))]
            expected = [np.diff(e)[0] / s for e, s in zip((small.frame.rows, small.frame.cols), small.frame.shape)]
            np.testing.assert_allclose(sides, expected, atol=0.006)

    def test_a_mask_is_drawn_on_the_picture_itself(self, large, tmp_path):
        tissue = np.zeros(large.shape[:2], np.uint8)
        tissue[800:2800, 1000:3000] = 255
        cv2.imwrite(str(tmp_path / "mask.png"), tissue)
        Image.fromarray(large).save(tmp_path / "large.png")
        for item in (tmp_path / "large.png", large):
            (found,) = load_references([item], masks=[str(tmp_path / "mask.png")])
            assert found.mask.all() and min(found.mask.shape) >= 1023
            assert np.abs(np.subtract((found.frame.rows, found.frame.cols), ((800, 2800), (1000, 3000)))).max() <= 2

    def test_transparency_joins_what_is_found(self, tmp_path):
        rgba = np.dstack([section(-0.4), np.full(section(-0.4).shape[:2], 255, np.uint8)])
        rgba[:, : rgba.shape[1] // 2, 3] = 0
        Image.fromarray(rgba).save(tmp_path / "half.png")
        (whole,), (half,) = load_references([section(-0.4)]), load_references([tmp_path / "half.png"])
        assert abs((1 - half.removed) / (1 - whole.removed) - 0.5) < 0.08
        assert half.frame.cols[0] >= rgba.shape[1] // 2 - 1

    def test_labels_are_drawn_on_the_picture_itself(self, large, ct, tmp_path):
        from MedColorLib.matching.tissue_guard import Guard

        Image.fromarray(large).save(tmp_path / "large.png")
        labels = np.zeros(large.shape[:2], np.uint8)
        labels[:, 2000:] = 1
        cv2.imwrite(str(tmp_path / "labels.png"), labels)
        halves = np.zeros(ct.volume.array.shape, np.uint8)
        halves[:, :, 28:] = 1
        guard = Guard(Volume(halves, ct.volume.ijk_to_ras), [str(tmp_path / "labels.png")])
        settings = Settings(preset="draft", features="embedded", slices=(5, 6))
        report = colorize(ct.volume, [tmp_path / "large.png"], settings, guard=guard).report
        assert max(report["guard"]["without_own_match"].values(), default=0) < 0.5
