"""Stage *rendering*, its numbers: how an RGB volume with luminance as alpha has to be shown. No VTK here.

The command line and the Slicer module take the same numbers from this file, so that both give the same picture.
"""

from __future__ import annotations

import numpy as np

from ..errors import SettingsError

# Weights of red, green and blue in vtkImageLuminance, which Slicer applies to a three-component volume.
LUMINANCE_WEIGHTS = (0.30, 0.59, 0.11)

# Phong terms. VTK's own ambient of 0.1 leaves the folds of the surface black. A body shows its surface at all angles: with
# these a colour is, in the mean over a ball, about as bright as it is in a slice.
AMBIENT = 0.35
DIFFUSE = 0.85
SPECULAR = 0.1
SPECULAR_POWER = 10.0

# One value at any gradient: interfaces between soft tissues have small gradients, and a curve would hide them.
GRADIENT_OPACITY = 1.0

# Where skin begins to be a surface and the skull still shows through it: at 0.5 a head without a bright skull, as in MR, is fog.
DEFAULT_OPACITY = 0.7
PICTURE_OPACITY = 0.9  # of pictures to keep: skin and cut faces, not a haze

# Alpha (0..255) up to which a voxel counts as air, and from which a surface counts as tissue. Noise in air stays below
# the first; partial volume between air and skin lies between the two.
ALPHA_AIR = 12.0
ALPHA_TISSUE = 48.0

# Flesh and fat in the lightness of a photograph stay below this, bone lies above.
ALPHA_FLESH = 160.0

# The opacity of the curve is reached over this fraction of the body's diagonal (about 1 mm in a human head).
UNIT_DISTANCE_FRACTION = 1.0 / 400.0


def opacity_curve(opacity: float = DEFAULT_OPACITY) -> list[tuple[float, float]]:
    """Points (alpha in 0..255, opacity per unit distance in 0..1) of the curve for one slider.

    At 1 all tissue is solid. Below that dim tissue fades faster than bright tissue, so that bone shows through flesh.
    The powers make equal steps of the slider look like equal steps: bone alone up to about 0.3, muscle around 0.5, skin
    from 0.8.

    Args:
        opacity: 0 (nothing is seen) to 1 (solid).

    Raises:
        SettingsError: `opacity` outside 0..1.
    """
    if not 0.0 <= opacity <= 1.0:
        raise SettingsError(f"opacity: expected a number from 0 to 1, got {opacity}")
    o = float(opacity)
    return [(0.0, 0.0), (ALPHA_AIR, 0.0), (ALPHA_TISSUE, o**7), (ALPHA_FLESH, o**6), (255.0, o**3.5)]


def opacity_points(alpha_min: float, alpha_max: float, opacity: float = DEFAULT_OPACITY) -> list[tuple[float, float]]:
    """Points (x, opacity) to put into the scalar opacity function of a volume whose alpha spans alpha_min..alpha_max.

    VTK reads the opacity table of a volume with dependent RGB(A) components at alpha / 255, but fills the table from
    the function's values between the smallest and the largest alpha of the volume. A voxel of alpha a therefore gets
    the function's value at alpha_min + a / 255 * (alpha_max - alpha_min). Each point is moved there, so that alpha a
    gets what `opacity_curve` says for a. Where all voxels have one alpha the table is constant, and so is the result.
    To be called again whenever the voxels change.

    Args:
        alpha_min, alpha_max: range of the alpha channel (0..255); for three components in Slicer, of the truncated
            luminance (`surface.luminance_alpha`).
        opacity: 0 to 1, see `opacity_curve`.

    Returns:
        Points in ascending x, at least two.

    Raises:
        SettingsError: a range outside 0..255 or reversed, or `opacity` outside 0..1.
    """
    if not 0.0 <= alpha_min <= alpha_max <= 255.0:
        raise SettingsError(f"opacity points: expected 0 <= minimum <= maximum <= 255, got {alpha_min}, {alpha_max}")
    curve = opacity_curve(opacity)
    if alpha_max == alpha_min:
        value = float(np.interp(alpha_min, [x for x, _ in curve], [y for _, y in curve]))
        return [(float(alpha_min), value), (float(alpha_min) + 1.0, value)]
    scale = (alpha_max - alpha_min) / 255.0
    return [(alpha_min + x * scale, y) for x, y in curve]


def unit_distance_mm(diagonal_mm: float) -> float:
    """Scalar opacity unit distance: the length over which the curve's opacity is reached.

    Tied to the body's size and not to the voxel size, so that a body looks the same at any resolution, and a hand as
    solid as a head.

    Args:
        diagonal_mm: diagonal of the bounding box of all voxels that are not black.

    Raises:
        SettingsError: not a positive number.
    """
    if not diagonal_mm > 0.0:
        raise SettingsError(f"unit distance: expected a positive diagonal in millimetres, got {diagonal_mm}")
    return float(diagonal_mm) * UNIT_DISTANCE_FRACTION
