"""Packages MedColor needs and Slicer lacks: asked for at Apply, installed by Slicer's own mechanisms, never silently.

torch comes from the PyTorch extension, which knows the graphics driver. OpenCV exists under four names that overwrite
one another, so it is asked for only where `cv2` cannot be imported at all. NumPy stays as it is: Slicer has loaded it, and
the newest OpenCV would replace it (Slicer 5.8 brings NumPy 1.26, OpenCV after 4.11 wants 2); pip is made to take an OpenCV
that goes with it.
"""

from __future__ import annotations

import contextlib
import functools
import importlib.metadata
import importlib.util
import os
import re
import subprocess
import sys
import tempfile

import slicer
from slicer.i18n import tr as _

from MedColorLib.errors import MissingPackageError

REQUESTER = "MedColor"
_REQUIREMENTS = os.path.join(os.path.dirname(os.path.dirname(__file__)), "Resources", "requirements.txt")
_MODULE_OF = {"opencv-contrib-python-headless": "cv2", "pillow": "PIL"}  # elsewhere package and module have one name


class NotInstalled(MissingPackageError):  # a user's decision as often as an error
    """A package is missing; the message says which, and how to get it."""


def absent(error: ModuleNotFoundError) -> NotInstalled:
    """The error to raise where an import failed."""
    return NotInstalled(
        _(
            "The Python package {name} is missing. Press Apply in the module MedColor, or call installPackages() of its "
            "logic; both ask before anything is installed."
        ).format(name=(error.name or str(error)).split(".")[0])
    )


def needs_packages(method):
    """For what the console calls: a package that is missing is a MedColorError with its remedy, whatever imports it."""

    @functools.wraps(method)
    def checked(*arguments, **options):
        try:
            return method(*arguments, **options)
        except ModuleNotFoundError as error:
            raise absent(error) from error

    return checked


def requirements() -> list[str]:
    """Lines of requirements.txt without comments."""
    with open(_REQUIREMENTS, encoding="utf-8") as stream:
        lines = [line.split("#")[0].strip() for line in stream]
    return [line for line in lines if line]


def missing() -> list[str]:
    """Requirements whose module cannot be imported; finds modules without importing them."""
    return [line for line in requirements() if not _is_there(_module_name(line))]


def torch_missing() -> bool:
    """Whether torch is not there, found without importing it."""
    return not _is_there("torch")


def _is_there(module: str) -> bool:
    """Whether a module can be imported; one that a worker is just importing (OpenCV drops its spec meanwhile) is there."""
    return sys.modules.get(module) is not None or importlib.util.find_spec(module) is not None


def ensure() -> None:
    """Everything a run needs is there after this, or NotInstalled is raised; declining leaves Slicer as it was."""
    if torch_missing():
        _install_torch()
    packages = missing()
    if packages:
        _install(packages)


def _module_name(requirement: str) -> str:
    name = re.split(r"[<>=!~\[; ]", requirement, maxsplit=1)[0]
    return _MODULE_OF.get(name, name.replace("-", "_"))


def _install_torch() -> None:
    try:
        import PyTorchUtils
    except ModuleNotFoundError as error:
        raise NotInstalled(
            _(
                "PyTorch is missing. Install the extension PyTorch in the Extensions Manager, restart Slicer, and apply again."
            )
        ) from error
    if slicer.app.testingEnabled():
        raise NotInstalled(_("PyTorch is missing, and nothing is installed while testing."))
    if PyTorchUtils.PyTorchUtilsLogic().installTorch(askConfirmation=True, torchVersionRequirement=">=2.2") is None:
        raise NotInstalled(_("PyTorch was not installed. MedColor needs it; apply again to be asked again."))


def _install(packages: list[str]) -> None:
    names = ", ".join(packages)
    if slicer.app.testingEnabled():
        raise NotInstalled(_("Missing packages: {names}. Nothing is installed while testing.").format(names=names))
    try:
        _ask_and_install(packages, names)
    except subprocess.CalledProcessError as error:
        raise NotInstalled(_failed(names)) from error
    importlib.invalidate_caches()
    still = missing()
    if still:
        raise NotInstalled(_failed(", ".join(still)))


def _ask_and_install(packages: list[str], names: str) -> None:
    if importlib.util.find_spec("slicer.packaging"):  # Slicer 5.12 and later; asks by itself
        from slicer.packaging import pip_ensure

        try:
            with _constraints() as path:
                pip_ensure(packages, constraints=path, requester=REQUESTER)
        except RuntimeError as error:
            raise NotInstalled(_declined(names)) from error
        return
    question = _("MedColor needs Python packages that are not installed: {names}. Install them now?")
    if not slicer.util.confirmOkCancelDisplay(question.format(names=names)):
        raise NotInstalled(_declined(names))
    message = _("Installing {names}. This may take some minutes.").format(names=names)
    with _constraints() as path, slicer.util.MessageDialog(message), slicer.util.WaitCursor():
        slicer.util.pip_install([*packages, "--constraint", path])


@contextlib.contextmanager
def _constraints():
    """Path of a file that holds pip to the NumPy that is there."""
    with tempfile.TemporaryDirectory() as folder:
        path = os.path.join(folder, "constraints.txt")
        with open(path, "w", encoding="utf-8") as stream:
            stream.write(f"numpy=={importlib.metadata.version('numpy')}\n")
        yield path


def _failed(names: str) -> str:
    return _("Not installed: {names}. The log says why; check the network and apply again.").format(names=names)


def _declined(names: str) -> str:
    return _("Nothing was installed. MedColor needs {names}; apply again to be asked again.").format(names=names)
