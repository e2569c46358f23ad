"""Slices coloured as they are looked at: as a run colours them, along any axis, and again in another look."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from MedColorLib import Guard, Settings, Volume, colorize
from MedColorLib.color.difference import ciede2000
from MedColorLib.color.lab import srgb_to_lab
from MedColorLib.errors import Cancelled
from MedColorLib.phantom.tissues import NUMBER, TISSUES
from MedColorLib.run.live import LiveSlices, Look

DRAFT = Settings(preset="draft", features="embedded")


@pytest.fixture(scope="module")
def live(ct):
    return LiveSlices(ct.volume, [ct.reference])


@pytest.fixture(scope="module")
def whole(ct):
    """A run that colours each slice by itself, as the live preview does."""
    return colorize(ct.volume, [ct.reference], replace(DRAFT, coherence_mm=0.0)).rgb


def difference(first, second, inside) -> float:
    """Mean CIEDE2000 inside."""
    first, second = (srgb_to_lab(picture[inside] / 255.0) for picture in (first, second))
    return float(ciede2000(first, second).mean())


def core(inside):
    """Without the border, which a run fades into the air."""
    from scipy.ndimage import binary_erosion

    return binary_erosion(inside, iterations=4)


def test_transverse_slices_are_those_of_a_run(ct, live, whole):
    for k in (3, 6):
        inner = core(ct.inside[k])
        np.testing.assert_array_equal(live.plane(0, k)[inner], whole[k][inner])


@pytest.mark.parametrize(("axis", "index"), [(1, 30), (2, 25)])
def test_slices_across_the_stack_are_near_those_of_a_run(ct, live, whole, axis, index):
    run, inside = np.take(whole, index, axis=axis), core(np.take(ct.inside, index, axis=axis))
    plane = live.plane(axis, index)
    assert plane.shape == run.shape
    assert difference(plane, run, inside) < 3.5
    grey = np.repeat(run.mean(axis=-1, keepdims=True), 3, axis=-1)
    assert difference(plane, grey, inside) > 8


@pytest.mark.parametrize("axes", [(1, 0, 2), (2, 1, 0), (1, 2, 0)])
def test_any_order_of_axes_and_direction(ct, live, axes):
    """The same head, its array transposed and turned about: the same pictures."""
    array = np.ascontiguousarray(ct.volume.array.transpose(axes)[::-1, :, ::-1])
    to_old = np.zeros((4, 4))  # index (i, j, k) of the new array -> of the old one
    to_old[3, 3] = 1
    for new, old in enumerate(axes):
        flip = new in (0, 2)
        to_old[2 - old, 2 - new] = -1 if flip else 1
        to_old[2 - old, 3] = array.shape[new] - 1 if flip else 0
    turned = LiveSlices(Volume(array, ct.volume.ijk_to_ras @ to_old), [ct.reference])
    for new, old in enumerate(axes):
        at = array.shape[new] // 2
        mine = turned.plane(new, at)
        theirs = live.plane(old, array.shape[new] - 1 - at if new in (0, 2) else at)
        left = [n for n in range(3) if n != new]
        mine = mine[tuple(slice(None, None, -1 if n in (0, 2) else 1) for n in left)]
        theirs = theirs if axes[left[0]] < axes[left[1]] else theirs.swapaxes(0, 1)
        np.testing.assert_allclose(mine.astype(int), theirs.astype(int), atol=3)


def test_another_lightness_is_that_of_a_run(ct, live):
    run = colorize(ct.volume, [ct.reference], replace(DRAFT, coherence_mm=0.0, lightness=0.3)).rgb
    inner = core(ct.inside[6])
    np.testing.assert_array_equal(live.plane(0, 6, Look(lightness=0.3))[inner], run[6][inner])


def test_another_exposure_is_near_that_of_a_run_and_can_be_taken_back(ct):
    live = LiveSlices(ct.volume, [ct.reference])
    before = live.plane(0, 6)
    inner = core(ct.inside[6])
    run = colorize(ct.volume, [ct.reference], replace(DRAFT, coherence_mm=0.0, exposure=0.4)).rgb
    darker = live.plane(0, 6, Look(exposure=0.4))
    assert difference(darker, run[6], inner) < 1.5
    assert difference(darker, before, inner) > 8
    np.testing.assert_allclose(live.plane(0, 6).astype(int), before.astype(int), atol=2)


@pytest.mark.parametrize("drawn", [False, True], ids=["labels of the scan", "and of the photograph"])
def test_tissue_guard(ct, live, drawn):
    """Bone and brain apart from the rest: as in a run with the same guard, and not as without it."""
    painted = np.array([color for _, _, color in TISSUES.values()])
    nearest = np.argmin(((ct.reference[..., None, :] - painted.astype(float)) ** 2).sum(-1), axis=-1)
    groups = np.zeros(len(TISSUES), np.uint8)
    groups[NUMBER["bone"]], groups[[NUMBER["grey matter"], NUMBER["white matter"]]] = 1, 2
    guard = Guard(Volume(groups[ct.labels], ct.volume.ijk_to_ras), [groups[nearest]] if drawn else None)
    guarded = LiveSlices(ct.volume, [ct.reference], guard=guard)
    settings = replace(DRAFT, coherence_mm=0.0)
    whole = colorize(ct.volume, [ct.reference], settings, guard=guard).rgb
    inner = core(ct.inside[6])
    np.testing.assert_array_equal(guarded.plane(0, 6)[inner], whole[6][inner])
    assert difference(guarded.plane(0, 6), live.plane(0, 6), inner) > 0.3
    for axis, index in ((1, 30), (2, 25)):
        run, inside = np.take(whole, index, axis=axis), core(np.take(ct.inside, index, axis=axis))
        assert difference(guarded.plane(axis, index), run, inside) < 3.5
        assert difference(guarded.plane(axis, index), run, inside) < difference(live.plane(axis, index), run, inside)
    if drawn:
        light = guarded.plane(0, 6, Look(exposure=0.6))
        assert difference(light, guarded.plane(0, 6, Look(exposure=0.6, lightness=0.3)), inner) > 1


def test_only_the_region_and_nothing_where_there_is_no_body(ct):
    region = ((2, 9), (10, 40), (20, 50))
    live = LiveSlices(ct.volume, [ct.reference], Settings(region=region))
    for axis in range(3):
        plane = live.plane(axis, 30 if axis else 6)
        outside = np.ones(ct.volume.array.shape, bool)
        outside[tuple(slice(*ends) for ends in region)] = False
        assert plane.any()
        assert not plane[np.take(outside, 30 if axis else 6, axis=axis)].any()
    assert not live.plane(0, 0).any(), "not asked for"
    assert not live.plane(2, 2).any(), "not asked for"


def test_can_be_cancelled(ct):
    asked = []
    with pytest.raises(Cancelled):
        LiveSlices(ct.volume, [ct.reference], cancelled=lambda: len(asked) > 0 or asked.append(1))
    stop = []
    live = LiveSlices(ct.volume, [ct.reference], cancelled=lambda: bool(stop))
    stop.append(1)
    with pytest.raises(Cancelled):
        live.plane(1, 30)
    stop.clear()
    assert live.plane(1, 30).any(), "and goes on from there"
