"""What the tests of tissue guard share: samples and small helpers."""

from __future__ import annotations

import cv2
import numpy as np

from MedColorLib import Guard, Settings, Volume, colorize
from MedColorLib.color.difference import ciede2000
from MedColorLib.color.lab import gray_to_lightness, lab_to_srgb, srgb_to_lab

GREY = 0.55  # of both tissues


BROWN, PINK, YELLOW = (20.0, 30.0), (55.0, 5.0), (2.0, 65.0)  # a*, b*; a photograph's tissue could have each


HOST, INSERT, STRANGE = 1, 2, 3  # labels


MATRIX = np.diag([-2.0, -2.0, 4.0, 1.0])


def settings(**changes) -> Settings:
    """The photograph's colours as they are: those that the tests look for."""
    return Settings(
        **{
            "preset": "draft",
            "features": "embedded",
            "device": "cpu",
            "window": (0, 1000),
            "exposure": "off",
            **changes,
        }
    )


def ellipse(shape, centre, radii) -> np.ndarray:
    """(h, w) bool; centre and radii in shares of the height and width."""
    rows, cols = ((np.arange(n) + 0.5) / n for n in shape)
    return ((rows[:, None] - centre[0]) / radii[0]) ** 2 + ((cols - centre[1]) / radii[1]) ** 2 < 1


def plane_of_labels(shape, inserts) -> np.ndarray:
    """(h, w) uint8: a body of HOST with inserts of other labels, 0 outside."""
    labels = np.where(ellipse(shape, (0.5, 0.5), (0.44, 0.42)), HOST, 0).astype(np.uint8)
    for label, centre in inserts:
        labels[ellipse(shape, centre, (0.12, 0.12))] = label
    return labels


def grey_of(labels, rng) -> np.ndarray:
    """Display grey 0..1 in which HOST and INSERT look the same; a dark rim of fixed place gives the eye something."""
    grey = np.where(labels > 0, GREY, 0.0) + 0.02 * rng.normal(size=labels.shape) * (labels > 0)
    inner = ellipse(labels.shape[-2:], (0.5, 0.5), (0.38, 0.36))
    return np.where((labels > 0) & ~inner, 0.35, grey)


def picture_of(labels, rng) -> np.ndarray:
    """(h, w, 3) uint8 photograph: one grey, a colour of its own for each label."""
    colors = np.array([(0, 0), BROWN, PINK, YELLOW], np.float64)[labels]
    lab = np.concatenate([gray_to_lightness(np.clip(grey_of(labels, rng), 0, 1))[..., None], colors], -1)
    return np.rint(255 * np.clip(lab_to_srgb(lab), 0, 1)).astype(np.uint8)


class Scene:
    """A scan and a photograph of one body whose inserts lie elsewhere in each."""

    def __init__(self, strange: bool = False, slices: int = 4) -> None:
        rng = np.random.default_rng(7)
        self.labels = np.stack([plane_of_labels((96, 80), [(INSERT, (0.35 + 0.01 * k, 0.4))]) for k in range(slices)])
        grey = np.stack([grey_of(plane, rng) for plane in self.labels])
        self.volume = Volume(np.rint(1000 * grey).astype(np.int16), MATRIX, name="scan")
        extra = [(STRANGE, (0.38, 0.4))] if strange else []  # where the scan has its insert
        self.reference_labels = plane_of_labels((192, 160), [*extra, (INSERT, (0.62, 0.62))])
        self.picture = picture_of(self.reference_labels, rng)

    def guard(self, **changes) -> Guard:
        given = {"labels": Volume(self.labels, MATRIX, name="seg"), "reference_labels": [self.reference_labels]}
        return Guard(**{**given, **changes})

    def color(self, guard=None, given=None, **options):
        return colorize(self.volume, [self.picture], given or settings(), guard=guard, **options)


def errors(result, labels) -> dict[int, float]:
    """Mean CIEDE2000 of each tissue from its own colour, at the result's luminance; two pixels from its border on.

    Six from the border of the body, where colour fades (`coloring.rim`).
    """
    lab = srgb_to_lab(result.rgb)
    found = {}
    for label, chroma in ((HOST, BROWN), (INSERT, PINK)):
        own = np.stack([cv2.erode((plane == label).astype(np.uint8), np.ones((3, 3))) for plane in labels]) > 0
        own &= np.stack([cv2.erode((plane > 0).astype(np.uint8), np.ones((13, 13))) for plane in labels]) > 0
        truth = lab.copy()
        truth[..., 1:] = chroma
        found[label] = float(ciede2000(lab[own], truth[own]).mean())
    return found
