"""Tissue is told from surroundings of any colour, from rulers and labels; given masks are taken as they are."""

from __future__ import annotations

import struct
import zlib

import cv2
import numpy as np
import pytest
from pictures_samples import STORED
from PIL import Image, PngImagePlugin
from scipy.ndimage import gaussian_filter

from MedColorLib.errors import InputError, SettingsError
from MedColorLib.parameters import Settings
from MedColorLib.phantom import section
from MedColorLib.references import given_mask
from MedColorLib.references.loading import describe_references, load_references
from MedColorLib.references.photograph import prepare_reference
from MedColorLib.references.pictures import pictures_in
from MedColorLib.references.tissue_mask import FILLS, find_tissue, tissue_mask

SKIN, FAT, MUSCLE, BONE = (196, 150, 118), (226, 196, 124), (122, 52, 44), (232, 218, 184)


def ellipse(shape, centre, radii) -> np.ndarray:
    rows, cols = np.mgrid[: shape[0], : shape[1]]
    return ((rows - centre[0]) / radii[0]) ** 2 + ((cols - centre[1]) / radii[1]) ** 2 < 1


def body(background: np.ndarray, scale: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """A trunk with skin, fat, muscle and bone, and an arm beside it, on a background (h, w, 3); and its tissue."""
    rng, shape = np.random.default_rng(5), background.shape[:2]
    picture, middle = background.astype(np.float64).copy(), (0.45 * shape[0], 0.42 * shape[1])
    for share, color in ((1, SKIN), (0.96, FAT), (0.8, MUSCLE), (0.25, BONE)):
        picture[ellipse(shape, middle, (scale * share * 0.33 * shape[0], scale * share * 0.3 * shape[1]))] = color
    arm = ellipse(shape, (middle[0], 0.85 * shape[1]), (0.17 * shape[0], 0.09 * shape[1]))
    picture[arm] = MUSCLE
    truth = ellipse(shape, middle, (scale * 0.33 * shape[0], scale * 0.3 * shape[1])) | arm
    grain = gaussian_filter(rng.normal(0, 1, shape), 1.2)[..., None]
    picture = np.where(truth[..., None], picture * (1 + 0.04 * grain / grain.std()), picture)
    picture = cv2.GaussianBlur(picture, (0, 0), 0.8) + rng.normal(0, 2, picture.shape)
    return np.rint(np.clip(picture, 0, 255)).astype(np.uint8), truth


def plain(color, shape=(240, 300)) -> np.ndarray:
    return np.full((*shape, 3), color, np.float64)


def mottled(color, amount=0.06, width=4, shape=(240, 300)) -> np.ndarray:
    field = gaussian_filter(np.random.default_rng(2).normal(0, 1, shape), width)[..., None]
    return plain(color, shape) * (1 + amount * field / field.std())


def shaded(color, shape=(240, 300)) -> np.ndarray:
    rows, cols = np.mgrid[-1 : 1 : shape[0] * 1j, -1 : 1 : shape[1] * 1j]
    return plain(color, shape) * (1 - 0.15 * (rows**2 + cols**2) + 0.1 * cols)[..., None]


def wood(shape=(240, 300)) -> np.ndarray:
    rows, cols = np.mgrid[: shape[0], : shape[1]]
    return plain((170, 120, 75), shape) * (1 + 0.1 * np.sin(0.5 * cols + 2 * np.sin(rows / 40)))[..., None]


def cloth(color, shape=(240, 300)) -> np.ndarray:
    rows, cols = np.mgrid[: shape[0], : shape[1]]
    return mottled(color, 0.2, 8, shape) * (1 + 0.3 * np.sin(1.3 * rows) * np.sin(1.3 * cols))[..., None]


BACKGROUNDS = {
    "blue": mottled((30, 110, 170), 0.12),
    "green": mottled((70, 140, 80)),
    "violet": mottled((95, 60, 130)),
    "cream": mottled((222, 205, 170), 0.03),
    "red-brown gelatin": mottled((150, 75, 55), 0.04),
    "white paper": plain((250, 250, 250)),
    "shaded paper": shaded((235, 233, 228)),
    "grey table": shaded((130, 130, 131)),
    "black cloth": cloth((18, 18, 20)),
    "brown cloth": cloth((42, 34, 28)),
    "green towel": cloth((60, 110, 95)),
    "wood": wood(),
}


def overlap(mask, truth) -> float:
    return (mask & truth).sum() / (mask | truth).sum()


@pytest.mark.parametrize("name", BACKGROUNDS)
def test_surroundings_of_any_colour(name):
    picture, truth = body(BACKGROUNDS[name])
    mask, note = find_tissue(picture)
    assert overlap(mask, truth) > 0.94 and (truth & ~mask).sum() < 0.04 * truth.sum() and not note


@pytest.mark.parametrize("name", ["blue", "white paper", "grey table", "wood"])
def test_rulers_labels_and_grey_scales_are_not_tissue(name):
    picture, truth = body(BACKGROUNDS[name])
    picture[222:236, 20:150], picture[222:229, 20:150:6] = (240, 240, 235), 20
    picture[212:236, 160:200] = (235, 225, 90)
    for step in range(8):
        picture[222:236, 205 + 11 * step : 216 + 11 * step] = round(250 * 0.72**step)
    mask = tissue_mask(picture)
    assert overlap(mask, truth) > 0.94 and not mask[212:].any()


@pytest.mark.parametrize("gain", [0.15, 0.4, 1.4])
def test_dark_and_bright_pictures(gain):
    picture, truth = body(BACKGROUNDS["grey table"])
    assert overlap(tissue_mask(np.clip(picture * gain, 0, 255).astype(np.uint8)), truth) > 0.94


def test_a_block_of_gelatin_on_a_tray():
    block = mottled((222, 205, 170), 0.03)
    block[:14] = block[-14:] = block[:, :14] = block[:, -14:] = (90, 92, 95)
    picture, truth = body(block, 0.9)
    assert overlap(tissue_mask(picture), truth) > 0.93


def test_white_paper_seen_through_a_hole_is_removed_and_a_dark_vessel_kept():
    picture, truth = body(BACKGROUNDS["white paper"])
    hole, vessel = ellipse(truth.shape, (80, 110), (11, 11)), ellipse(truth.shape, (150, 130), (8, 8))
    picture[hole], picture[vessel] = (250, 250, 250), (22, 12, 12)
    mask = tissue_mask(picture)
    assert not mask[ellipse(truth.shape, (80, 110), (7, 7))].any() and mask[vessel].all()


def test_a_picture_that_tissue_fills_is_kept_and_said():
    picture = section(0.2)[60:200, 70:170]
    mask, note = find_tissue(np.ascontiguousarray(picture))
    assert mask.mean() > 0.99 and note == FILLS
    assert FILLS in describe_references(load_references([np.ascontiguousarray(picture)]))


class TestGiven:
    def test_an_array_with_a_fourth_channel(self):
        picture, truth = body(BACKGROUNDS["wood"])
        own = np.roll(truth, 9, axis=1)
        (reference,) = load_references([np.dstack([picture, np.where(own, 255, 0).astype(np.uint8)])])
        assert reference.removed == pytest.approx(1 - own.mean())
        np.testing.assert_array_equal(reference.mask, reference.frame.cut(own))

    @pytest.mark.parametrize("kind", ["white", "labels", "colour", "alpha", "palette"])
    def test_masks_of_every_kind(self, kind, tmp_path):
        picture, truth = body(BACKGROUNDS["wood"])
        own, path = np.roll(truth, 9, axis=1), tmp_path / "mask.png"
        if kind == "palette":
            image = Image.frombytes("P", own.shape[::-1], own.astype(np.uint8).tobytes())
            image.putpalette([200, 30, 30, 0, 0, 0])  # the colours say nothing, index 0 is not tissue
            image.save(path)
        else:
            white = np.where(own, 255, 0).astype(np.uint8)
            values = {"white": white, "labels": own.astype(np.uint8) * 3, "colour": np.dstack([white] * 3)}
            values["alpha"] = np.dstack([picture, white])
            cv2.imwrite(str(path), values[kind])
        cv2.imwrite(str(tmp_path / "p.png"), picture[..., ::-1])
        (reference,) = load_references([tmp_path / "p.png"], masks=[str(path)])
        np.testing.assert_array_equal(reference.mask, reference.frame.cut(own))

    def test_a_folder_of_masks_for_a_folder(self, tmp_path):
        picture, truth = body(BACKGROUNDS["wood"])
        for folder in ("photographs", "masks"):
            (tmp_path / folder).mkdir()
        for name in ("a.png", "b.png"):
            cv2.imwrite(str(tmp_path / "photographs" / name), picture[..., ::-1])
        half = truth & (np.arange(truth.shape[1]) < 120)
        cv2.imwrite(str(tmp_path / "masks" / "b.png"), half.astype(np.uint8) * 255)
        first, second = load_references([tmp_path / "photographs"], masks=[str(tmp_path / "masks")])
        assert overlap(first.mask, first.frame.cut(truth)) > 0.94
        np.testing.assert_array_equal(second.mask, second.frame.cut(half))
        assert "no mask of its name in masks: its tissue was found" in first.notes and not second.notes

    def test_a_folder_of_masks_is_looked_through_once(self, tmp_path, monkeypatch):
        picture, truth = body(BACKGROUNDS["wood"])
        for folder in ("photographs", "masks"):
            (tmp_path / folder).mkdir()
        for number in range(4):
            cv2.imwrite(str(tmp_path / "photographs" / f"{number}.png"), picture[..., ::-1])
        for ending in ("bmp", "png"):  # of two of one name the first
            cv2.imwrite(str(tmp_path / "masks" / f"1.{ending}"), truth * np.uint8(255 if ending == "bmp" else 0))
        looked = []
        monkeypatch.setattr(given_mask, "pictures_in", lambda folder: looked.append(folder) or pictures_in(folder))
        found = load_references([tmp_path / "photographs"], masks=[str(tmp_path / "masks")])
        assert len(found) == 4 and looked == [tmp_path / "masks"]
        np.testing.assert_array_equal(found[1].mask, found[1].frame.cut(truth))

    @pytest.mark.parametrize("ending", [".png", ".tif", ".jpg"])
    @pytest.mark.parametrize("number", [2, 3, 6, 8])
    def test_a_mask_is_turned_as_its_header_says(self, number, ending, tmp_path):
        picture, truth = body(BACKGROUNDS["wood"])
        own = np.roll(truth, 9, axis=1)
        stored = np.ascontiguousarray(STORED[number](own[..., None])[..., 0])
        exif = Image.Exif()
        exif[0x112] = number
        Image.fromarray(np.where(stored, 255, 0).astype(np.uint8)).save(tmp_path / f"m{ending}", exif=exif)
        (reference,) = load_references([picture], masks=[str(tmp_path / f"m{ending}")])
        assert overlap(reference.mask, reference.frame.cut(own)) > (0.99 if ending == ".jpg" else 0.9999)

    @pytest.mark.parametrize("size", [(13000, 13000), (60000, 60000), (1 << 30, 1 << 30)])
    def test_a_mask_of_another_size_is_not_decoded(self, size, tmp_path, monkeypatch):
        cv2.imwrite(str(tmp_path / "m.png"), np.ones((24, 30), np.uint8))
        data = bytearray((tmp_path / "m.png").read_bytes())
        data[16:24] = struct.pack(">II", *size)
        data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
        (tmp_path / "m.png").write_bytes(data)
        monkeypatch.setattr(given_mask, "stored_values", None)  # would raise TypeError
        reached: list = []
        monkeypatch.setattr(PngImagePlugin.PngImageFile, "load", lambda _: reached.append(1))
        with pytest.raises(InputError, match=r"reference mask m\.png: .*(the photograph has 300 x 240|megapixels)"):
            load_references([body(BACKGROUNDS["wood"])[0]], masks=[str(tmp_path / "m.png")])
        assert not reached

    @pytest.mark.parametrize(
        ("mask", "message"),
        [
            (np.ones((10, 12), np.uint8) * 255, r"12 x 10 pixels, the photograph has 300 x 240"),
            (np.zeros((240, 300), np.uint8), "marks no pixel as tissue"),
        ],
    )
    def test_masks_that_do_not_fit(self, mask, message, tmp_path):
        cv2.imwrite(str(tmp_path / "mask.png"), mask)
        with pytest.raises(InputError, match=message):
            load_references([body(BACKGROUNDS["wood"])[0]], masks=[str(tmp_path / "mask.png")])

    def test_another_number_of_masks(self, tmp_path):
        with pytest.raises(InputError, match="2 for 1 references; give one for each"):
            load_references([body(BACKGROUNDS["wood"])[0]], masks=["a.png", "b.png"])
        with pytest.raises(InputError, match="no file"):
            load_references([body(BACKGROUNDS["wood"])[0]], masks=["a.png"])

    def test_a_folder_for_one_photograph(self, tmp_path):
        with pytest.raises(InputError, match="a folder, and the reference is one picture"):
            load_references([body(BACKGROUNDS["wood"])[0]], masks=[str(tmp_path)])

    @pytest.mark.parametrize("references", [None, 3, [np.zeros((0, 9, 3), np.uint8)], [b"a.png"]])
    def test_what_can_be_no_reference(self, references):
        with pytest.raises(InputError, match="expected"):
            load_references(references)

    def test_settings(self):
        assert Settings(reference_masks="m.png").reference_masks == ("m.png",)
        assert Settings.from_dict(Settings(reference_masks=["m.png", None]).to_dict()).reference_masks == (
            "m.png",
            None,
        )
        with pytest.raises(SettingsError, match="reference_masks"):
            Settings(reference_masks=(3,))

    def test_another_shape(self):
        with pytest.raises(InputError, match="make them equal"):
            prepare_reference(body(BACKGROUNDS["wood"])[0], "mine", np.ones((3, 3), bool))


@pytest.mark.parametrize("name", ["green", "cream", "wood", "grey table", "black cloth"])
@pytest.mark.parametrize("photograph", ["vhf_head_cryosection.png", "vhf_thorax_cryosection.png"])
def test_real_tissue_on_other_surroundings(photograph, name, shared_data):
    """The photograph's tissue, as it is found in its own blue gelatin, set on another background."""
    from MedColorLib.references.pictures import read_picture

    picture = read_picture(str(shared_data / photograph))
    scale = 400 / max(picture.shape)
    picture = cv2.resize(
        picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    )
    truth = np.pad(cv2.erode(tissue_mask(picture).astype(np.uint8), np.ones((3, 3))) > 0, 20)
    picture = np.pad(picture, ((20, 20), (20, 20), (0, 0)), mode="edge")
    backgrounds = {
        "green": mottled((70, 140, 80), shape=truth.shape),
        "cream": mottled((225, 205, 160), 0.03, shape=truth.shape),
        "wood": wood(truth.shape),
        "grey table": shaded((130, 130, 131), truth.shape),
        "black cloth": cloth((18, 18, 20), truth.shape),
    }
    cover = gaussian_filter(truth.astype(float), 0.7)[..., None]
    composed = np.rint(np.clip(picture * cover + backgrounds[name] * (1 - cover), 0, 255)).astype(np.uint8)
    from scipy.ndimage import binary_fill_holes

    pockets = binary_fill_holes(truth) & ~truth
    assert overlap(tissue_mask(composed) & ~pockets, truth) > 0.93
