"""All of VTK: finds a way to draw without a display, and draws a grid seen by a camera."""

from __future__ import annotations

import logging
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from ..errors import DeviceError, MissingPackageError, SettingsError
from . import lights, presets, shaders
from .grid import Grid

_LOG = logging.getLogger("MedColorLib")
_PROBE = Path(__file__).with_name("probe.py")
_PROBE_SECONDS = 120  # a software driver compiles its shaders first, on a machine that may be busy
MAX_PICTURE_SIDE = 8192
_MAX_SAMPLES_PER_RAY = 1500


@dataclass(frozen=True)
class Camera:
    """A parallel camera in millimetres RAS.

    Attributes:
        focal: (3,) point in the middle of the picture.
        towards: (3,) unit vector from the body to the viewer.
        up: (3,) unit vector that points up in the picture.
        half_height_mm: half of the height that the picture shows.
        distance_mm: from the focal point to the viewer, outside the body.
    """

    focal: np.ndarray
    towards: np.ndarray
    up: np.ndarray
    half_height_mm: float
    distance_mm: float


def _window_names() -> list[str]:
    """VTK classes to try, the user's choice first; the two that need no display, where built, before the default."""
    from vtkmodules import vtkRenderingOpenGL2

    names = (os.environ.get("VTK_DEFAULT_OPENGL_WINDOW", ""), "vtkEGLRenderWindow", "vtkOSOpenGLRenderWindow")
    return [*dict.fromkeys(name for name in names if hasattr(vtkRenderingOpenGL2, name)), "vtkRenderWindow"]


def _python() -> str:
    """A Python interpreter for the probe; inside Slicer `sys.executable` may be the application itself."""
    for candidate in (sys.executable, shutil.which("PythonSlicer"), shutil.which("python3")):
        if candidate and Path(candidate).name.lower().startswith("python"):
            return candidate
    raise DeviceError("rendering: no Python interpreter found to try OpenGL with; put python3 on the PATH")


@lru_cache(maxsize=1)
def working_window() -> str:
    """Name of the first VTK render window class that draws a volume on this machine.

    Each is tried in a process of its own: a missing driver ends the process instead of raising an error.

    Raises:
        DeviceError: none works; the message names the Debian packages to install.
        MissingPackageError: VTK is not installed.
    """
    _require_vtk()
    tried = []
    for name in _window_names():
        try:
            probe = subprocess.run(
                [_python(), str(_PROBE), name],
                stdin=subprocess.DEVNULL,
                capture_output=True,
                timeout=_PROBE_SECONDS,
                check=False,
            )
            status = f"status {probe.returncode}"
        except subprocess.TimeoutExpired:
            status = f"no answer in {_PROBE_SECONDS} s"
        if status == "status 0":
            _LOG.debug("rendering: drawing with %s", name)
            return name
        tried.append(f"{name}: {status}")
    raise DeviceError(
        f"rendering: no OpenGL that can draw without a display ({'; '.join(tried)}). On Debian or Ubuntu install "
        "libegl1 libgl1 libgl1-mesa-dri (or libosmesa6); with a VTK that needs an X server, run under xvfb-run"
    )


def _require_vtk() -> None:
    try:
        import vtkmodules.vtkRenderingVolumeOpenGL2  # noqa: F401
    except ModuleNotFoundError as error:
        raise MissingPackageError('rendering: VTK is not installed; run: pip install "vtk>=9.1"') from error
    except ImportError as error:  # libGL or libX11 itself is absent, seen with some builds
        raise DeviceError(
            f"rendering: VTK cannot be loaded ({error}). On Debian or Ubuntu install libegl1 libgl1 libgl1-mesa-dri "
            "libx11-6 libxrender1"
        ) from error


def check_size(size: tuple[int, int]) -> None:
    """Refuse a picture size that no driver can draw.

    Raises:
        SettingsError: not width and height from 1 to 8192 pixels.
    """
    if not (len(size) == 2 and all(1 <= int(n) <= MAX_PICTURE_SIDE for n in size)):
        raise SettingsError(f"picture size: expected width and height from 1 to {MAX_PICTURE_SIDE}, got {size}")


class Stage:
    """One render window that shows one grid at a time; a context manager that frees the driver's memory at its end.

    Args:
        size: (width, height) of the pictures in pixels.
        background: RGB 0..255 behind the volume.

    Raises:
        SettingsError: a size outside 1..8192 pixels.
        DeviceError: see `working_window`.
    """

    def __init__(self, size: tuple[int, int], background: tuple[int, int, int] = (0, 0, 0)) -> None:
        check_size(size)
        name = working_window()
        from vtkmodules import vtkRenderingOpenGL2
        from vtkmodules.vtkRenderingCore import vtkRenderer, vtkRenderWindow

        self._errors: list[str] = []
        self._shown, self._light, self._gain = None, "plain", None
        self._to_ras = np.eye(4)  # of the image on the stage
        self._window = getattr(vtkRenderingOpenGL2, name, vtkRenderWindow)()
        self._window.SetOffScreenRendering(1)
        self._window.SetShowWindow(False)
        self._window.SetMultiSamples(0)
        self._window.SetSize(int(size[0]), int(size[1]))
        self._renderer = vtkRenderer()
        self._renderer.SetBackground(*(channel / 255.0 for channel in background))
        self._window.AddRenderer(self._renderer)
        self._listen(self._window)

    def __enter__(self) -> Stage:
        return self

    def __exit__(self, *_: object) -> None:
        self._renderer.RemoveAllViewProps()
        self._window.Finalize()

    def _listen(self, source: object) -> None:
        """VTK writes its errors to the terminal and goes on; keep them, to raise them."""

        def remember(_caller: object, _event: str, text: str) -> None:
            self._errors.append(text.strip().splitlines()[-1])

        remember.CallDataType = "string0"
        source.AddObserver("ErrorEvent", remember)

    def show(
        self, grid: Grid, opacity: float = presets.DEFAULT_OPACITY, shade: bool = True, light: str = "plain"
    ) -> None:
        """Put `grid` on the stage instead of what was there; `light` is one of `lights.LIGHTS`."""
        lights.check_light(light)
        self._renderer.RemoveAllViewProps()
        self._shown, self._light, self._gain = self._volume(grid, opacity, shade), light if shade else "plain", None
        self._renderer.AddVolume(self._shown)

    def _volume(self, grid: Grid, opacity: float, shade: bool) -> object:
        from vtkmodules.vtkCommonMath import vtkMatrix4x4
        from vtkmodules.vtkRenderingCore import vtkVolume
        from vtkmodules.vtkRenderingVolume import vtkGPUVolumeRayCastMapper

        rgba, spacing_mm, self._to_ras, own = _placed(grid)
        mapper = vtkGPUVolumeRayCastMapper()
        self._listen(mapper)
        mapper.SetInputData(_image(rgba, spacing_mm))
        mapper.SetBlendModeToComposite()
        mapper.AutoAdjustSampleDistancesOff()
        mapper.SetImageSampleDistance(1.0)
        mapper.SetSampleDistance(max(0.5 * float(spacing_mm.min()), grid.diagonal_mm / _MAX_SAMPLES_PER_RAY))
        mapper.UseJitteringOff()
        volume = vtkVolume()
        volume.SetMapper(mapper)
        volume.SetProperty(_properties(grid, opacity, shade))
        matrix = vtkMatrix4x4()
        matrix.DeepCopy(own.ravel())
        volume.SetUserMatrix(matrix)
        _change_shader(volume.GetShaderProperty())
        return volume

    def draw(self, camera: Camera) -> np.ndarray:
        """The picture that the camera sees, (H, W, 3) uint8, first row on top.

        Raises:
            DeviceError: the driver reported an error while drawing.
        """
        self._aim(camera)
        if self._light == "realistic" and self._gain is None:  # measured once: a turn must not flicker
            plain, lit = (self._picture_in(light) for light in ("plain", "realistic"))
            self._gain = lights.gain(plain, lit)
            return self._brightened(lit)
        return self._brightened(self._picture_in(self._light))

    def _brightened(self, picture: np.ndarray) -> np.ndarray:
        if self._light == "plain":
            return picture
        return np.rint(np.minimum(picture.astype(np.float32) * self._gain, 255)).astype(np.uint8)

    def _picture_in(self, light: str) -> np.ndarray:
        from vtkmodules.util.numpy_support import vtk_to_numpy
        from vtkmodules.vtkRenderingCore import vtkWindowToImageFilter

        lights.set_lamps(self._renderer, light)
        lights.set_shadows(self._shown, light)
        self._window.Render()
        grabber = vtkWindowToImageFilter()
        grabber.SetInput(self._window)
        grabber.SetInputBufferTypeToRGB()
        grabber.ReadFrontBufferOff()
        grabber.ShouldRerenderOff()
        grabber.Update()
        if self._errors:
            raise DeviceError(
                f"rendering: the OpenGL driver failed: {self._errors[0]}. Try a smaller picture or "
                "volume, or set VTK_DEFAULT_OPENGL_WINDOW to another window class"
            )
        image = grabber.GetOutput()
        width, height, _ = image.GetDimensions()
        pixels = vtk_to_numpy(image.GetPointData().GetScalars()).reshape(height, width, 3)
        return np.ascontiguousarray(pixels[::-1])

    def _aim(self, camera: Camera) -> None:
        view = self._renderer.GetActiveCamera()
        view.ParallelProjectionOn()
        view.SetParallelScale(camera.half_height_mm)
        turn = self._to_ras[:3, :3].T
        focal, towards = turn @ (camera.focal - self._to_ras[:3, 3]), turn @ camera.towards
        view.SetFocalPoint(*focal)
        view.SetPosition(*(focal + camera.distance_mm * towards))
        view.SetViewUp(*(turn @ camera.up))
        self._renderer.ResetCameraClippingRange()


def _change_shader(shader: object) -> None:
    """Give VTK's ray caster the texts of `shaders`."""
    place, function = shaders.CUBE_NORMALS_NEED
    shader.AddFragmentShaderReplacement(place, True, function, True)
    for text, instead in (shaders.CUBE_NORMALS, shaders.SKIP_AIR, *shaders.END_SOONER, *shaders.SHADOWS):
        shader.AddFragmentShaderReplacement(text, False, instead, True)


def _placed(grid: Grid) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Voxels (k, j, i, 4), their spacing (i, j, k), the image's millimetres to RAS (4, 4), and a matrix of the volume's own.

    It is the camera that is placed to the image, since VTK turns the directions of surfaces wrongly where a volume has a
    matrix and more than one lamp shines. Only a sheared grid has one. Spacing goes into the image: the mapper measures its
    steps in the image's own millimetres, so that with spacing in a matrix opacity would depend on the direction of view.
    """
    spacing_mm = np.linalg.norm(grid.ijk_to_ras[:3, :3], axis=0)
    rgba, directions = grid.rgba, np.array(grid.ijk_to_ras)
    directions[:3, :3] /= spacing_mm
    if np.linalg.det(directions[:3, :3]) < 0:  # a camera cannot look through a mirror
        mirror = np.diag([-1.0, 1.0, 1.0, 1.0])
        mirror[0, 3] = (rgba.shape[2] - 1) * spacing_mm[0]
        rgba, directions = np.ascontiguousarray(rgba[:, :, ::-1]), directions @ mirror
    if np.allclose(directions[:3, :3].T @ directions[:3, :3], np.eye(3), atol=1e-3):
        return rgba, spacing_mm, directions, np.eye(4)
    return rgba, spacing_mm, np.eye(4), directions


def _image(rgba: np.ndarray, spacing_mm: np.ndarray) -> object:
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonDataModel import vtkImageData

    image = vtkImageData()
    image.SetDimensions(*rgba.shape[2::-1])
    image.SetSpacing(*spacing_mm)
    # Shares memory; VTK keeps a reference to the array.
    image.GetPointData().SetScalars(numpy_to_vtk(rgba.reshape(-1, 4), deep=False))
    return image


def _properties(grid: Grid, opacity: float, shade: bool) -> object:
    from vtkmodules.vtkCommonDataModel import vtkPiecewiseFunction
    from vtkmodules.vtkRenderingCore import vtkVolumeProperty

    alpha = grid.rgba[..., 3]
    curve = vtkPiecewiseFunction()
    for x, y in presets.opacity_points(float(alpha.min()), float(alpha.max()), opacity):
        curve.AddPoint(x, y)
    gradient = vtkPiecewiseFunction()
    gradient.AddPoint(0.0, presets.GRADIENT_OPACITY)
    gradient.AddPoint(255.0, presets.GRADIENT_OPACITY)
    properties = vtkVolumeProperty()
    properties.IndependentComponentsOff()
    properties.SetInterpolationTypeToLinear()
    properties.SetScalarOpacity(curve)
    properties.SetGradientOpacity(gradient)
    properties.DisableGradientOpacityOn()  # a constant 1 need not be computed
    for component in range(4):  # the curve is taken from component 0, but its unit distance from alpha's own, 3
        properties.SetScalarOpacityUnitDistance(component, presets.unit_distance_mm(grid.diagonal_mm))
    properties.SetShade(1 if shade else 0)
    properties.SetAmbient(presets.AMBIENT)
    properties.SetDiffuse(presets.DIFFUSE)
    properties.SetSpecular(presets.SPECULAR)
    properties.SetSpecularPower(presets.SPECULAR_POWER)
    return properties
