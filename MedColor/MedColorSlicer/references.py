"""Colour references: files, folders, colour volumes of the scene and arrays become what the library takes."""

from __future__ import annotations

import os

import slicer
import vtk
from slicer.i18n import tr as _


def pictures_in(path: str) -> list[str]:
    """Picture files that a path stands for: the file itself, or the pictures in a folder in order of their names.

    Raises:
        MedColorLib.errors.InputError: nothing there, not readable, or no pictures in the folder.
    """
    from MedColorLib.errors import InputError
    from MedColorLib.references.pictures import PICTURE_SUFFIXES

    if os.path.isfile(path):
        return [path]
    if not os.path.isdir(path):
        raise InputError(_("There is no file or folder {path}; choose the colour pictures again.").format(path=path))
    try:
        names = sorted(os.listdir(path))
    except OSError as error:
        raise InputError(
            _("The folder {path} cannot be read ({reason}); check its permissions.").format(
                path=path, reason=error.strerror
            )
        ) from error
    pictures = [name for name in names if name.lower().endswith(PICTURE_SUFFIXES) and not name.startswith(".")]
    found = [os.path.join(path, name) for name in pictures]
    if not found:
        raise InputError(
            _("The folder {path} holds no pictures; put PNG, JPEG or TIFF photographs into it.").format(path=path)
        )
    return found


def reference_problem(node, input_node) -> str:
    """Why a volume node cannot serve as reference; empty if it can."""
    if node is None:
        return _("Select a colour volume as reference.")
    if node is input_node:
        return _("The reference is the input itself; select a colour photograph.")
    image = node.GetImageData() if node.IsA("vtkMRMLVolumeNode") else None
    if image is None or not all(image.GetDimensions()):
        return _("The reference {name} has no voxels; load a colour photograph.").format(name=node.GetName())
    if image.GetNumberOfScalarComponents() not in (3, 4) or image.GetScalarType() != vtk.VTK_UNSIGNED_CHAR:
        return _("The reference {name} has no 8-bit colour; load a colour photograph as a vector volume.").format(
            name=node.GetName()
        )
    return ""


def picture_from_node(node, input_node=None):
    """(H, W, 3) uint8 RGB copy of a colour volume node; the middle slice where it has several.

    Raises:
        MedColorLib.errors.InputError: the node holds no 8-bit colour, or is the input itself.
    """
    from MedColorLib.errors import InputError

    problem = reference_problem(node, input_node)
    if problem:
        raise InputError(problem)
    voxels = slicer.util.arrayFromVolume(node)
    return voxels[voxels.shape[0] // 2, :, :, :3].copy()


def references_from(references, input_node=None) -> list:
    """What the library takes: paths and (H, W, 3) arrays, from nodes, node IDs, paths, folders and arrays.

    A folder stays one, so that the library may leave out a picture of it that cannot be used, and say so.
    """
    if isinstance(references, (str, os.PathLike)) or not isinstance(references, (list, tuple)):
        references = [references]
    result: list = []
    for reference in references:
        if isinstance(reference, (str, os.PathLike)):
            path = os.fspath(reference)
            result += [path] if pictures_in(path) else []
        elif reference is None or hasattr(reference, "IsA"):
            result.append(picture_from_node(reference, input_node))
        else:
            result.append(reference)
    if not result:
        from MedColorLib.errors import InputError

        raise InputError(_("There is no reference; choose a colour photograph."))
    return result
