"""The surface of a body in Slicer's own rendering: smooth as the scan's, shaded as the formula says, and its light."""

from __future__ import annotations

import os

import mrml
import numpy as np
import pytest
import slicer
from host_fixtures import color_node, layout_of, view_widget

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
    # The lamp stands where the viewer does: far away, so that its light comes from one direction, as in the formula.
    view.look_at(bounds, np.asarray(direction) / np.linalg.norm(direction), distance_mm=4000.0)
    return view.render().astype(float), display


def formula(picture, display, radius_px):
    """(H, W, 3) what Phong's formula gives for a ball under a lamp at the viewer; NaN near its outline and outside."""
    y, x = np.mgrid[: picture.shape[0], : picture.shape[1]] - (picture.shape[0] - 1) / 2.0
    facing = np.sqrt(np.clip(1 - (x**2 + y**2) / radius_px**2, 0, 1))
    prop = display.GetVolumePropertyNode().GetVolumeProperty()
    shade = prop.GetAmbient() + prop.GetDiffuse() * facing
    wanted = (
        shade[..., None] * COLOUR
        + 255 * prop.GetSpecular() * np.clip(2 * facing[..., None] ** 2 - 1, 0, 1) ** prop.GetSpecularPower()
    )
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
        assert rms <= 3.0
    else:
        assert rms > 4.0, "what the rim is for"


# --- light ----------------------------------------------------------------------------------------------------------------


@pytest.fixture
def in_the_layout(view, monkeypatch):
    """The view as Slicer's layout manager would give it."""

    def manager_named(name):
        managers = [view.group.GetNthDisplayableManager(n) for n in range(view.group.GetDisplayableManagerCount())]
        return next(manager for manager in managers if manager.IsA(name))

    widget = view_widget(displayableManagerByClassName=manager_named, forceRender=view.window.Render)
    monkeypatch.setattr(slicer.app, "layoutManager", layout_of(widget))


def test_realistic_light_has_shadows_and_is_as_bright(view, scene, in_the_layout):
    from MedColorSlicer import light

    scan, _ = anti_aliased_ball()
    hollow = scan.copy()
    hollow[26:38, :30, 26:38] = 0  # a pit that faces the viewer, whose ground lies in shadow
    node = color_node(colored(hollow))
    light.switch(scene, False)
    plain, display = shown(view, node, (0, -1, 0))
    light.switch(scene, True)
    lit, display = shown(view, node, (0, -1, 0))
    mapper = light._mappers(display)[0]
    assert view.node.GetVolumeRenderingSurfaceSmoothing()
    assert view.node.GetShadowsVisibility()
    if not hasattr(mapper, "SetVolumetricScatteringBlending"):
        pytest.skip("this VTK has no shadows within a volume")
    assert mapper.GetVolumetricScatteringBlending() > 0
    seen = plain.max(axis=-1) > 40
    assert lit[seen].mean() == pytest.approx(plain[seen].mean(), rel=0.12)
    assert np.abs(lit - plain).max() > 5
    light.switch(scene, False)
    again, display = shown(view, node, (0, -1, 0))
    assert np.abs(again - plain).max() <= 1


def test_realistic_light_is_chosen_by_the_time_a_frame_takes(view, scene, in_the_layout, monkeypatch):
    from MedColorSlicer import light

    for seconds, wanted in ((0.02, True), (0.5, False)):
        view.node.RemoveAttribute("MedColor.Light")
        monkeypatch.setattr(light, "_seconds_per_frame", lambda seconds=seconds: seconds)
        light.first_time(scene)
        assert light.is_on(scene) is wanted
        monkeypatch.setattr(light, "_seconds_per_frame", lambda seconds=seconds: 0.6 - seconds)
        light.first_time(scene)
        assert light.is_on(scene) is wanted, "a choice is kept"
    light.switch(scene, False)


# --- real heads ---------------------------------------------------------------------------------------------------------

HEADS = {  # file, slices
    "ct": ("vhf_head_ct.nrrd", slice(120, 200)),
    "mr": ("head_mr_t1_3d.nii.gz", slice(0, None)),
}


PATCHES = {  # rows, columns: forehead and temple
    "ct": [(slice(60, 90), slice(70, 100)), (slice(60, 90), slice(30, 55))],
    "mr": [(slice(82, 108), slice(113, 137)), (slice(75, 110), slice(20, 40))],
}


def head(kind):
    """(scan in transverse slices, body mask, threshold, air level, spacing (k, j, i), box) of a real head, cut to the box."""
    from MedColorLib import read_volume
    from MedColorLib.coloring.rim import air_level
    from MedColorLib.scan.body import find_body
    from MedColorLib.scan.slices import slice_order

    name, part = HEADS[kind]
    if not os.path.isfile(os.path.join(DATA, name)):
        pytest.skip(f"{name} is not there")
    volume = read_volume(os.path.join(DATA, name))
    order = slice_order(volume.ijk_to_ras, "transverse")
    scan = np.ascontiguousarray(order.view(volume.array)[part])
    body = find_body(scan)
    mask = np.stack([body.painted(k, scan[k]) for k in range(len(scan))])
    spacing = volume.spacing_mm[::-1][list(order.axes)]
    rows, cols = (np.flatnonzero(mask.any(axis=axes)) for axes in ((0, 2), (0, 1)))
    box = (slice(None), slice(max(rows[0] - 6, 0), rows[-1] + 7), slice(max(cols[0] - 6, 0), cols[-1] + 7))
    scan, mask = np.ascontiguousarray(scan[box]), np.ascontiguousarray(mask[box])
    return scan, mask, body.threshold, air_level(scan, mask, body.threshold), spacing, box


def placed(rgb, spacing):
    """A colour node with the face towards RAS +y."""
    node = color_node(rgb)
    node.SetSpacing(*[float(n) for n in spacing[::-1]])
    node.SetIJKToRASDirections(-1, 0, 0, 0, -1, 0, 0, 0, 1)
    return node


def second_difference(picture, rows, cols):
    """Energy of the second difference of a patch, of mean brightness 1."""
    patch = picture[rows, cols].mean(axis=-1)
    patch = patch / patch.mean()
    across, down = np.diff(patch, 2, axis=1)[1:-1], np.diff(patch, 2, axis=0)[:, 1:-1]
    return float((across**2 + down**2).mean())


def grey_picture(scan, mask, air):
    """(k, j, i, 3) uint8: what Slicer would show of the scan, from air to its brightest tissue."""
    high = np.percentile(scan[mask], 99.5)
    grey = np.clip((scan.astype(np.float32) - air) / (high - air), 0, 1)
    return np.rint(255 * grey)[..., None].repeat(3, axis=-1).astype(np.uint8)


@pytest.mark.parametrize("kind", HEADS)
def test_real_skin_is_as_smooth_as_in_the_grey_rendering(view, scene, kind):
    """In the lightness that a photograph gives: skin is not near black, as it is in a scan whose window shows bone."""
    from MedColorLib.coloring.rim import add_rim

    scan, mask, threshold, air, spacing, _box = head(kind)
    plain = grey_picture(scan, mask, air)
    grey = plain[..., 0] / 255
    cut = np.rint(COLOUR * (0.5 + 0.5 * grey[..., None]) * mask[..., None]).astype(np.uint8)
    rimmed = cut.copy()
    add_rim(rimmed, mask, scan, threshold, air, tuple(spacing))
    energies = {}
    for name, rgb in {"grey": plain, "cut": cut, "rim": rimmed}.items():
        node = placed(rgb, spacing)
        picture, _display = shown(view, node, (0.35, 1, 0.1), opacity=0.97)
        scene.RemoveNode(node)
        energies[name] = [second_difference(picture, *patch) for patch in PATCHES[kind]]
        if os.environ.get("MEDCOLOR_PICTURES"):
            import cv2

            target = os.path.join(os.environ["MEDCOLOR_PICTURES"], f"skin_{kind}_{name}.png")
            cv2.imwrite(target, picture[..., ::-1].astype(np.uint8))
    print(energies)
    for rim, plain_grey in zip(energies["rim"], energies["grey"]):
        assert rim <= 1.2 * plain_grey
    assert sum(energies["cut"]) > 4 * sum(energies["rim"]), "what the rim is for"


def test_real_skin_in_real_colours_is_as_smooth_as_in_the_grey_rendering(view, scene):
    """The colours of a photograph have grain of their own, and the ramp of the rim lies upon it."""
    from MedColorLib import Settings, colorize, read_volume

    scan, mask, _threshold, air, spacing, box = head("ct")
    name, part = HEADS["ct"]
    volume = read_volume(os.path.join(DATA, name))
    reference = os.path.join(DATA, "vhf_head_cryosection.png")
    rgb = colorize(volume, [reference], Settings(slices=(part.start, part.stop))).rgb[part][box]
    energies = []
    for colours in (np.ascontiguousarray(rgb), grey_picture(scan, mask, air)):
        node = placed(colours, spacing)
        picture, _display = shown(view, node, (0.35, 1, 0.1), opacity=0.97)
        scene.RemoveNode(node)
        energies.append([second_difference(picture, *patch) for patch in PATCHES["ct"]])
    print(energies)
    assert all(real <= 1.2 * grey for real, grey in zip(*energies))


def test_normals_are_smoother_than_vtks_own(view, scene):
    """Control: without the shader's change the ball shows the steps of its voxels."""
    from MedColorLib.rendering import shaders

    scan, _ = anti_aliased_ball()
    node = color_node(colored(scan))
    errors = []
    for replaced in (True, False):
        picture, display = shown(view, node, DIRECTIONS[0])
        if not replaced:
            shader = display.GetShaderPropertyNode().GetShaderProperty()
            shader.ClearFragmentShaderReplacement(shaders.SMOOTH_NORMALS[0], False)
            picture = view.render().astype(float)
        wanted = formula(picture, display, 24.0 / (64 / 2 * 1.1) * SIZE / 2)
        errors.append(float(np.sqrt(np.nanmean((picture - wanted) ** 2))))
    assert errors[0] < 0.85 * errors[1]


def test_without_shading_nothing_is_missing_in_the_shader(view, scene):
    """VTK leaves out what it computes gradients with where nobody needs them."""
    node = color_node(colored(anti_aliased_ball()[0]))
    _picture, display = shown(view, node, DIRECTIONS[0])
    prop = display.GetVolumePropertyNode().GetVolumeProperty()
    for switch in (prop.ShadeOff, lambda: prop.SetDisableGradientOpacity(1)):
        switch()
        assert view.render()[SIZE // 2, SIZE // 2] == pytest.approx(COLOUR, abs=2)
