"""Reference: tissue is told from gelatin, tray, labels and paper; what is no colour photograph is refused."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.ndimage import binary_erosion, binary_fill_holes

from MedColorLib.errors import InputError
from MedColorLib.phantom import section
from MedColorLib.references.photograph import on_grid, prepare_reference
from MedColorLib.references.pictures import read_picture
from MedColorLib.references.tissue_mask import tissue_mask
from MedColorLib.scan.grid import MARGIN, choose_grid

GELATIN, DARK_GELATIN, WHITE, BLACK = (28, 74, 120), (16, 30, 52), (255, 255, 255), (0, 0, 0)
SKIN, FAT, MUSCLE, LUMEN = (205, 160, 128), (226, 196, 124), (122, 52, 44), (30, 14, 12)
SHAPE = (200, 240)


def ellipse(centre, radii, shape=SHAPE) -> np.ndarray:
    rows, cols = np.mgrid[: shape[0], : shape[1]]
    return ((rows - centre[0]) / radii[0]) ** 2 + ((cols - centre[1]) / radii[1]) ** 2 < 1


def drawing(background, hole=None) -> tuple[np.ndarray, np.ndarray]:
    """A section with skin, fat, muscle, a dark vessel and, where given, a hole of another colour; and its tissue."""
    rng = np.random.default_rng(3)
    picture = np.empty((*SHAPE, 3))
    picture[:] = background
    for radius, color in ((75, SKIN), (70, FAT), (60, MUSCLE)):
        picture[ellipse((100, 120), (radius, radius * 1.2))] = color
    picture[ellipse((120, 90), (9, 9))] = LUMEN
    truth = ellipse((100, 120), (75, 90))
    if hole is not None:
        sinus = ellipse((80, 140), (14, 12))
        picture[sinus], truth = hole, truth & ~sinus
    picture = cv2.GaussianBlur(picture, (0, 0), 0.8) + rng.normal(0, 3, picture.shape)
    return np.rint(np.clip(picture, 0, 255)).astype(np.uint8), truth


def dice(mask, truth) -> float:
    return 2 * (mask & truth).sum() / (mask.sum() + truth.sum())


def bluish(rgb: np.ndarray) -> np.ndarray:
    """More blue than red, beyond a photograph's noise in the dark."""
    return rgb[..., 2].astype(int) > rgb[..., 0].astype(int) + 8


class TestTissue:
    @pytest.mark.parametrize("background", [GELATIN, DARK_GELATIN, WHITE, BLACK, (128, 128, 128), (250, 245, 230)])
    def test_plain_backgrounds(self, background):
        picture, truth = drawing(background)
        assert dice(tissue_mask(picture), truth) > 0.98

    def test_gelatin_in_a_sinus_is_removed_and_a_dark_vessel_kept(self):
        picture, truth = drawing(GELATIN, hole=GELATIN)
        mask = tissue_mask(picture)
        assert dice(mask, truth) > 0.98
        assert not mask[ellipse((80, 140), (12, 10))].any()
        assert mask[ellipse((120, 90), (9, 9))].all()
        assert not bluish(picture[mask]).any()

    def test_tray_grey_scale_and_label_are_removed(self):
        picture, truth = drawing(GELATIN)
        picture[:, :12] = picture[:, -14:] = (8, 9, 7)
        picture[182:196, 40:140] = np.linspace(0, 255, 100, dtype=np.uint8)[None, :, None]
        picture[180:198, 150:175] = (228, 226, 90)
        picture[:, 26:28] = (120, 130, 150)
        assert dice(tissue_mask(picture), truth) > 0.98

    def test_two_arms_beside_the_trunk_are_kept(self):
        picture, truth = drawing(GELATIN)
        for col in (14, 226):
            arm = ellipse((100, col), (30, 11))
            picture[arm], truth = MUSCLE, truth | arm
        assert dice(tissue_mask(picture), truth) > 0.97

    def test_tissue_that_touches_the_frame(self):
        picture, truth = drawing(GELATIN)
        cut = np.s_[40:, 60:200]
        assert dice(tissue_mask(np.ascontiguousarray(picture[cut])), truth[cut]) > 0.97

    def test_size_does_not_matter(self):
        picture, truth = drawing(GELATIN, hole=GELATIN)
        large = cv2.resize(picture, (1440, 1200), interpolation=cv2.INTER_CUBIC)
        assert dice(tissue_mask(large), cv2.resize(truth.astype(np.uint8), (1440, 1200)) > 0) > 0.98
        small = cv2.resize(picture, (60, 50), interpolation=cv2.INTER_AREA)
        assert dice(tissue_mask(small), cv2.resize(truth.astype(np.float32), (60, 50)) > 0.5) > 0.93

    def test_phantom(self):
        picture = section()
        reference = prepare_reference(picture, "phantom")
        assert 0.4 < reference.removed < 0.6
        assert not bluish(reference.rgb[reference.mask]).any()
        holes = binary_fill_holes(reference.mask) & ~reference.mask
        assert holes.sum() > 500  # the sinuses, with the thin walls between them, which their blue has tinged
        assert bluish(reference.rgb[binary_erosion(holes, iterations=4)]).mean() > 0.6


class TestPrepare:
    def test_cut_to_the_tissue(self):
        picture, truth = drawing(GELATIN)
        reference = prepare_reference(picture, "drawing")
        rows, cols = np.flatnonzero(truth.any(1)), np.flatnonzero(truth.any(0))
        assert np.abs(np.array(reference.mask.shape) - (np.ptp(rows) + 1, np.ptp(cols) + 1)).max() <= 4
        assert reference.mask[0].any() and reference.mask[-1].any()
        assert reference.rgb.shape == (*reference.mask.shape, 3)
        assert reference.removed == pytest.approx(1 - tissue_mask(picture).mean())

    def test_picture_is_not_altered(self):
        picture, _ = drawing(GELATIN, hole=GELATIN)
        before = picture.copy()
        prepare_reference(picture)
        np.testing.assert_array_equal(picture, before)

    @pytest.mark.parametrize(
        ("picture", "message"),
        [
            (np.zeros((9, 9), np.uint8), r"expected an RGB picture \(h, w, 3\) of uint8, got uint8 \(9, 9\)"),
            (np.zeros((9, 9, 4), np.uint8), "expected an RGB picture"),
            (np.zeros((9, 9, 3), np.float32), "expected an RGB picture .* got float32"),
            (np.full((9, 9, 3), 77, np.uint8), "has no colour; use a colour photograph"),
        ],
    )
    def test_what_is_no_colour_picture(self, picture, message):
        with pytest.raises(InputError, match=f"reference mine: .*{message}"):
            prepare_reference(picture, "mine")

    def test_grey_ramp_in_three_planes_has_no_colour(self):
        ramp = np.repeat(np.arange(256, dtype=np.uint8)[None, :, None], 3, 2).repeat(64, 0)
        with pytest.raises(InputError, match="no colour"):
            prepare_reference(ramp)

    def test_nothing_but_gelatin(self, rng):
        picture = np.rint(np.array(GELATIN) * (1 + 0.05 * rng.normal(0, 1, (80, 90, 1)))).astype(np.uint8)
        with pytest.raises(InputError, match=r"no tissue found \(0\.0 % of the picture\); use a section"):
            prepare_reference(picture, "mine")


class TestOnGrid:
    def test_no_background_colour_at_the_outline(self):
        picture, _ = drawing(GELATIN, hole=GELATIN)
        grid = choose_grid(96)
        grey, lab, mask = on_grid(prepare_reference(picture), grid)
        assert grey.shape == mask.shape == (96, 96) and lab.shape == (96, 96, 3)
        assert lab[..., 2].min() > 0  # every tissue of the drawing is on the yellow side, everywhere
        assert not mask[:MARGIN].any() and not mask[:, -MARGIN:].any()
        assert not grey[~mask].any() and grey[mask].min() > 0 and grey.max() <= 1

    def test_constant_tissue_keeps_its_colour(self):
        picture = np.full((60, 70, 3), GELATIN, np.uint8)
        picture[10:50, 10:60] = (200, 100, 80)
        _, lab, _ = on_grid(prepare_reference(picture), choose_grid(64))
        np.testing.assert_allclose(np.ptp(lab, axis=(0, 1)), 0, atol=1e-3)


class TestFiles:
    @pytest.mark.parametrize("ending", [".png", ".tif", ".bmp"])
    def test_order_is_rgb(self, ending, tmp_path):
        picture, _ = drawing(GELATIN)
        path = tmp_path / f"picture{ending}"
        cv2.imwrite(str(path), picture[..., ::-1])
        np.testing.assert_array_equal(read_picture(str(path)), picture)

    def test_jpeg(self, tmp_path):
        picture, truth = drawing(GELATIN)
        cv2.imwrite(str(tmp_path / "p.jpg"), picture[..., ::-1])
        assert dice(tissue_mask(read_picture(str(tmp_path / "p.jpg"))), truth) > 0.97

    def test_sixteen_bits_are_rounded(self, tmp_path):
        picture, _ = drawing(GELATIN)
        cv2.imwrite(str(tmp_path / "p.png"), picture[..., ::-1].astype(np.uint16) * 257 + 100)
        np.testing.assert_array_equal(read_picture(str(tmp_path / "p.png")), picture)

    def test_transparent_is_not_tissue(self, tmp_path):
        picture, truth = drawing(WHITE)
        alpha = np.where(truth, 255, 0).astype(np.uint8)
        cv2.imwrite(str(tmp_path / "p.png"), np.dstack([picture[..., ::-1], alpha]))
        got = read_picture(str(tmp_path / "p.png"))
        np.testing.assert_array_equal(got[truth], picture[truth])
        assert not got[~truth].any() and dice(tissue_mask(got), truth) > 0.98

    def test_name_with_letters_of_other_scripts(self, tmp_path):
        path = tmp_path / "Präparat 切片.png"
        path.write_bytes(cv2.imencode(".png", drawing(GELATIN)[0])[1].tobytes())
        assert read_picture(str(path)).shape == (*SHAPE, 3)

    @pytest.mark.parametrize("depth", [np.uint8, np.uint16])
    def test_grey_picture(self, depth, tmp_path):
        cv2.imwrite(str(tmp_path / "grey.png"), (np.arange(400) % 256).astype(depth).reshape(20, 20))
        with pytest.raises(InputError, match=r"reference grey.png: a grey picture; the reference must be a colour"):
            read_picture(str(tmp_path / "grey.png"))

    @pytest.mark.parametrize("content", [b"not a picture", b"\x89PNG\r\n\x1a\n" + bytes(40)])
    def test_unreadable(self, content, tmp_path, capfd):
        (tmp_path / "bad.png").write_bytes(content)
        with pytest.raises(InputError, match=r"reference bad.png: not a picture that can be read; use PNG"):
            read_picture(str(tmp_path / "bad.png"))

    def test_missing(self, tmp_path):
        with pytest.raises(InputError, match=r"no file .*gone.png"):
            read_picture(str(tmp_path / "gone.png"))

    def test_truncated_png(self, tmp_path, capfd):
        content = cv2.imencode(".png", drawing(GELATIN)[0])[1].tobytes()
        (tmp_path / "half.png").write_bytes(content[: len(content) // 2])
        with pytest.raises(InputError, match=r"half\.png"):
            read_picture(str(tmp_path / "half.png"))


@pytest.mark.parametrize(
    ("name", "share"), [("vhf_head_cryosection.png", (0.5, 0.68)), ("vhf_thorax_cryosection.png", (0.3, 0.42))]
)
def test_real_photographs(name, share, shared_data):
    picture = read_picture(str(shared_data / name))
    mask = tissue_mask(picture)
    assert share[0] < mask.mean() < share[1]
    hue, saturation, value = np.moveaxis(cv2.cvtColor(cv2.GaussianBlur(picture, (0, 0), 1), cv2.COLOR_RGB2HSV), 2, 0)
    blue = (hue > 90) & (hue < 130) & (saturation > 80) & (value > 40)
    assert (blue & mask).sum() < 2e-4 * mask.sum() and blue.mean() > 0.25
    if "thorax" in name:  # grey scale and label lie in the lowest sixth, the tray at the left
        assert not mask[1000:].any() and not mask[:, :200].any()
