"""The border of the body: the scan's own ramp from air to tissue, in the colour of the tissue behind it."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from MedColorLib.coloring.rim import INSIDE, OUTSIDE, add_rim, air_level

COLOUR = np.array((180, 120, 90))
AIR, TISSUE = -1000.0, 50.0
HALF = (AIR + TISSUE) / 2


def ball(size=40, radius=14.0, noise=0.0, seed=0):
    """(distance from the surface in voxels, scan with anti-aliased edge), both (k, j, i)."""
    centre = (size - 1) / 2
    k, j, i = np.mgrid[:size, :size, :size] - centre
    distance = np.sqrt(k**2 + j**2 + i**2) - radius
    share = np.clip(0.5 - distance / 2, 0, 1)  # an edge two voxels wide, as a scanner's
    scan = AIR + (TISSUE - AIR) * share
    return distance, scan + np.random.default_rng(seed).normal(0, noise, scan.shape)


def painted(mask, scan):
    """Colours as the pipeline gives them: the scan's brightness inside the mask, cut off where it ends."""
    share = np.clip((scan - AIR) / (TISSUE - AIR), 0, 1)
    return np.rint(COLOUR * share[..., None] * mask[..., None]).astype(np.uint8)


def test_border_is_the_colour_of_the_inside_times_the_ramp():
    distance, scan = ball()
    mask = scan > HALF
    rgb = painted(mask, scan)
    changed = add_rim(rgb, mask, scan, HALF, AIR)
    wanted = COLOUR * np.clip((scan - AIR) / (TISSUE - AIR), 0, 1)[..., None]
    near = np.abs(distance) < 1.0
    assert np.abs(rgb[near] - wanted[near]).max() <= 5
    assert changed > near.sum() / 2
    assert rgb[(distance > 0) & (distance < 0.7)].all(), "it goes on outside the mask"


def test_only_the_border_changes():
    distance, scan = ball()
    mask = scan > HALF
    before = painted(mask, scan)
    rgb = before.copy()
    add_rim(rgb, mask, scan, HALF, AIR)
    diagonal = np.sqrt(3)
    deep, far = distance < -(INSIDE + 1) * diagonal, distance > (OUTSIDE + 1) * diagonal
    assert (rgb[deep] == before[deep]).all()
    assert not rgb[far].any()


def test_where_the_mask_ends_does_not_matter():
    """A mask half a voxel too tight, or two voxels too wide: the same border."""
    _, scan = ball()
    results = []
    for level in (0.8, 0.5, 0.02):
        mask = scan > AIR + level * (TISSUE - AIR)
        rgb = painted(mask, scan)
        add_rim(rgb, mask, scan, HALF, AIR)
        results.append(rgb.astype(int))
    for other in results[1:]:
        assert np.abs(other - results[0]).max() <= 12


def test_noise_outside_fades():
    distance, scan = ball(noise=60.0)
    mask = scan > HALF
    rgb = painted(mask, scan)
    air = air_level(scan, mask, HALF)
    assert AIR < air < AIR + 200
    add_rim(rgb, mask, scan, HALF, air)
    bright = rgb.max(axis=-1)
    assert bright[distance > 2.6].mean() < 2
    assert bright[distance > (OUTSIDE + 1) * np.sqrt(3)].max() == 0


def test_air_inside_stays_as_painted():
    """A sinus is not cut out by the mask: its luminance follows the scan by itself."""
    distance, scan = ball()
    hole = np.linalg.norm(np.mgrid[:40, :40, :40] - np.array([20, 20, 26]).reshape(3, 1, 1, 1), axis=0) < 3
    scan = np.where(hole, AIR, scan)
    mask = distance < 0
    before = painted(mask, scan)
    rgb = before.copy()
    add_rim(rgb, mask, scan, HALF, AIR)
    assert (rgb[hole] == before[hole]).all()


def test_bright_skin_is_not_darkened_by_what_lies_below():
    """A skin of one voxel over darker tissue keeps its colour."""
    distance, scan = ball()
    scan = np.where((distance < -2) & (distance > -8), AIR + 0.6 * (TISSUE - AIR), scan)
    mask = scan > AIR + 0.3 * (TISSUE - AIR)
    rgb = painted(mask, scan)
    skin = (distance < -1.0) & (distance > -1.9)
    before = rgb[skin].mean()
    add_rim(rgb, mask, scan, AIR + 0.3 * (TISSUE - AIR), AIR)
    assert rgb[skin].mean() > 0.93 * before


@pytest.mark.parametrize("at_once", [1, 2, 3])
@pytest.mark.parametrize("slab", [1, 6, 9, 40])
def test_slabs_do_not_show(monkeypatch, slab, at_once):
    """Of any height, and side by side."""
    from MedColorLib.coloring import rim

    _, scan = ball()
    mask = scan > HALF
    whole, parts = painted(mask, scan), painted(mask, scan)
    monkeypatch.setattr(rim, "_SLAB_SLICES", 100)
    add_rim(whole, mask, scan, HALF, AIR)
    monkeypatch.setattr(rim, "_SLAB_VOXELS", (slab + 2 * (INSIDE + OUTSIDE + 1)) * rim._box_area(mask))
    monkeypatch.setattr(rim, "_AT_ONCE", at_once)
    with ThreadPoolExecutor(3) as pool:
        add_rim(parts, mask, scan, HALF, AIR, each=pool.map)
    np.testing.assert_array_equal(parts, whole)


def test_thick_slices_are_no_neighbours():
    _, scan = ball()
    mask = scan > HALF
    rgb = painted(mask, scan)
    add_rim(rgb, mask, scan, HALF, AIR, (5.0, 1.0, 1.0))
    top = np.flatnonzero(mask.any(axis=(1, 2)))[0]
    assert not rgb[:top].any(), "nothing above the first slice of the body"
    for k in (top, 20):
        alone = painted(mask[k : k + 1], scan[k : k + 1])
        add_rim(alone, mask[k : k + 1], scan[k : k + 1], HALF, AIR)
        np.testing.assert_array_equal(rgb[k], alone[0])


def test_slices_that_were_not_coloured_stay_black():
    _, scan = ball()
    mask = scan > HALF
    mask[20:] = False
    rgb = painted(mask, scan)
    add_rim(rgb, mask, scan, HALF, AIR, slices=np.arange(40) < 20)
    assert not rgb[20:].any()


@pytest.mark.parametrize("factor", [1e-30, 1.0, 1e300])
def test_units_do_not_matter_and_nan_is_air(factor):
    _, scan = ball()
    mask = scan > HALF
    plain, scaled = painted(mask, scan), painted(mask, scan)
    add_rim(plain, mask, scan, HALF, AIR)
    other = (scan - AIR) * factor
    other[0, 0, 0] = np.nan
    add_rim(scaled, mask, other, (HALF - AIR) * factor, 0.0)
    np.testing.assert_array_equal(scaled, plain)


def test_can_be_stopped():
    class Stop(Exception):
        pass

    def stop():
        raise Stop

    _, scan = ball()
    mask = scan > HALF
    with pytest.raises(Stop):
        add_rim(painted(mask, scan), mask, scan, HALF, AIR, check=stop)
