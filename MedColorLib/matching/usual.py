"""Stage *usual colours*: a match that gives a grey a colour which that grey hardly ever has counts less.

Features know the place in the body as well as the tissue. Where a scan shows another level than its photograph, the front of a
brain may be matched with the orbits that the photograph has there. In MR grey tells brain from orbit: all over the volume
this grey is matched with brain. In CT it does not, nearly all soft tissue has one grey; there this stage says nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

FEW_PX, MANY_PX = 4.0, 64.0  # evidence at which a neighbourhood of the regression counts as much as the ones around it
RARE = 0.25  # share of the usual colour's frequency from which a colour counts in full
_LEVELS = (16, 14, 10)  # of grey 0..1, L* 0..100, chroma 0..50
_TOP = (1.0, 100.0, 50.0)
# Share of a slice's matches that can be trusted (`confidence.Trust.trusted_fraction`): up to the first they say nothing of
# place, from the second they know better than grey. CT head after a photograph of one of its levels: 0.45 to 0.52 within
# 8 mm of it, where one tissue a grey would double the error, 0.21 to 0.32 elsewhere, where its orbits were found in the brain.
_KNOWS_PLACE = 0.3, 0.45
# Likewise, with a relation of grey to colour: chest CT after a section of the chest 0.30 to 0.35, its shoulders 0.21 to 0.25.
_LOST = 0.22, 0.28
# Share of the body in two neighbouring levels of grey: up to the first grey tells tissue; from the second, nothing.
_TELLS_TISSUE = 0.45, 0.65


@dataclass(frozen=True)
class UsualColors:
    """How often a grey is matched with a colour.

    Attributes:
        table: _LEVELS float32, 0 (never) to 1 (as usual).
    """

    table: np.ndarray

    def share(self, grey: np.ndarray, lab: np.ndarray) -> np.ndarray:
        """float32 0..1, how far each match counts. grey: (...) display grey 0..1; lab: (..., 3) its matched colour."""
        return self.table[tuple(_levels(grey, lab))]


def usual_colors(grey: np.ndarray, lab: np.ndarray, grey_tells: float) -> UsualColors | None:
    """From pixels of several slices; None where grey tells no tissue.

    Args:
        grey: (n,) display grey 0..1 inside the body. lab: (n, 3) L* a* b* of their matches.
        grey_tells: 0..1, `grey_tells_tissue` of the whole scan.
    """
    from scipy.ndimage import gaussian_filter

    rare = RARE * grey_tells
    if rare == 0:
        return None
    counts = np.zeros(_LEVELS)
    np.add.at(counts, tuple(_levels(grey, lab)), 1)
    counts = gaussian_filter(counts, 1.0, mode="nearest")
    most = np.maximum(counts.max((1, 2), keepdims=True), 1e-9)
    return UsualColors(np.clip(counts / (rare * most), 0, 1).astype(np.float32))


def grey_tells_tissue(grey: np.ndarray) -> float:
    """0..1: 0 where two of sixteen levels of grey hold most of the body, as in CT, 1 where it is spread, as in MR."""
    counts, _ = np.histogram(grey, _LEVELS[0], (0, 1))
    share = (counts[1:] + counts[:-1]).max() / max(grey.size, 1)
    low, high = _TELLS_TISSUE
    return float(np.clip((high - share) / (high - low), 0, 1))


def support_px(grey_tells: float, contrast_trust: float) -> float:
    """How much evidence a neighbourhood needs before its colours of a grey count beside those of the whole slice.

    MANY_PX where grey tells tissue but the matches show no relation of grey to colour, as for MR of brains: what single
    neighbourhoods say then is chance, and hue would follow place. Front against back of two brains at equal L*, CIEDE2000,
    without `one_tissue`: 3.4 and 5.5 with FEW_PX, 1.8 and 3.1 with MANY_PX.

    Args:
        grey_tells: 0..1, `grey_tells_tissue` of the whole scan. contrast_trust: `contrast.Contrast.trust`.
    """
    return FEW_PX + (MANY_PX - FEW_PX) * grey_tells * (1 - contrast_trust)


def one_tissue_share(grey_tells: float, contrast_trust: float, trusted_fraction: float, told: bool = False) -> float:
    """0..1, how far a grey at one depth is taken for one tissue all over a slice; see `coloring.one_tissue`.

    As far as grey tells tissue, or as far as matches cannot be trusted; but not where matches show a relation of grey to
    colour, as in the chest: they know better. Where they are lost, all of the scan knows better yet.

    Args:
        grey_tells, contrast_trust: as for `support_px`. trusted_fraction: of the slice and its neighbours, 0..1.
        told: whether slices all over the scan say what grey means (`run.elsewhere`).
    """
    low, high = _KNOWS_PLACE
    unknown = float(np.clip((high - trusted_fraction) / (high - low), 0, 1))
    lost, known = _LOST
    beyond = float(np.clip((known - trusted_fraction) / (known - lost), 0, 1)) if told else 0.0
    return max((1 - contrast_trust) * max(grey_tells**2, unknown), beyond)


def _levels(grey: np.ndarray, lab: np.ndarray) -> list[np.ndarray]:
    chroma = np.hypot(lab[..., 1], lab[..., 2])
    values = zip((grey, lab[..., 0], chroma), _TOP, _LEVELS)
    return [np.clip(v * (count / top), 0, count - 1).astype(np.int64) for v, top, count in values]
