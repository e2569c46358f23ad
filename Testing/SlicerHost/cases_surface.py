"""The surface of a body in Slicer's own rendering: smooth as the scan's, shaded as the formula says, and its light."""

from __future__ import annotations

import os

import mrml
import numpy as np
import pytest
from host_fixtures import color_node

SIZE = 160
DATA = os.environ.get("MEDCOLOR_DATA") or os.path.join(mrml.REPOSITORY, "..", "shared", "data")
COLOUR = np.array((200, 150, 110))


@pytest.fixture(scope="module")
def view(host):
    return mrml.OffscreenView(host, "1", SIZE)


def anti_aliased_ball(size=64, radius=24.0):
    """A scan (k, j, i) of a ball, 0 to 1000, whose edge is two voxels wide, and distance from its surface."""
    centre = (size - 1) / 2
    k, j, i = np.mgrid[:size, :size, :size] - centre
    distance = np.sqrt(k**2 + j**2 + i**2) - radius
    return 1000.0 * np.clip(0.5 - distance / 2, 0, 1), distance


def colored(scan, rim=True):
    """Colours as the pipeline gives them."""
    from MedColorLib.coloring.rim import add_rim

    mask = scan > 500
    rgb = np.rint(COLOUR * (scan / 1000)[..., None] * mask[..., None]).astype(np.uint8)
    if rim:
        add_rim(rgb, mask, scan, 500.0, 0.0)
    return rgb


def shown(view, node, direction, opacity=1.0):
    from MedColorSlicer import rendering_show

    display = rendering_show.show(node, opacity=opacity)
    bounds = [0.0] * 6
    node.GetRASBounds(bounds)
    view.make_plain()
    view.look_at(bounds, np.asarray(direction) / np.linalg.norm(direction))
    return view.render().astype(float), display


def formula(picture, display, radius_px):
    """(H, W, 3) what Phong's formula gives for a ball under a lamp at the viewer; NaN near its outline and outside."""
    y, x = np.mgrid[: picture.shape[0], : picture.shape[1]] - (picture.shape[0] - 1) / 2.0
    facing = np.sqrt(np.clip(1 - (x**2 + y**2) / radius_px**2, 0, 1))
    prop = display.GetVolumePropertyNode().GetVolumeProperty()
    shade = prop.GetAmbient() + prop.GetDiffuse() * facing
    wanted = shade[..., None] * COLOUR + 255 * prop.GetSpecular() * facing[..., None] ** prop.GetSpecularPower()
    wanted[facing < 0.45] = np.nan
    return np.minimum(wanted, 255)


DIRECTIONS = [(0, 1, 0), (1, 1, 0), (0.3, 0.9, 0.4), (-0.7, 0.2, 0.69)]


@pytest.mark.parametrize("direction", DIRECTIONS)
@pytest.mark.parametrize("rim", [True, False], ids=["rim", "cut by a mask"])
def test_ball_is_shaded_as_the_formula_says(view, scene, direction, rim):
    scan, _ = anti_aliased_ball()
    picture, display = shown(view, color_node(colored(scan, rim)), direction)
    radius_px = 24.0 / (64 / 2 * 1.1) * SIZE / 2
    wanted = formula(picture, display, radius_px)
    rms = np.sqrt(np.nanmean((picture - wanted) ** 2))
    if rim:
        assert rms <= 3
    else:
        assert rms > 3, "what the rim is for"
