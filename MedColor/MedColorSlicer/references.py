"""Colour references: files, folders, colour volumes of the scene and arrays become what the library takes."""

from __future__ import annotations

import os

import slicer
import vtk
from slicer.i18n import tr as _

from . import reference_masks


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


def references_from(references, input_node=None, masks=None) -> tuple[list, tuple | None]:
    """What the library takes: paths and arrays, from nodes, paths, folders and arrays; and the masks of the paths.

    A folder stays one, so that the library may leave out a picture of it that cannot be used, and say so.

    Args:
        masks: for each reference what says what is tissue in it, or None; see `MedColorLogic.process`.

    Returns:
        References; (H, W, 4) uint8 where a node has a mask. For each a path or None; None without any.
    """
    from MedColorLib.errors import InputError

    if isinstance(references, (str, os.PathLike)) or not isinstance(references, (list, tuple)):
        references = [references]
    if not references:
        raise InputError(_("There is no reference; choose a colour photograph."))
    if masks is None:
        masks = [None] * len(references)
    elif not isinstance(masks, (list, tuple)):
        masks = [masks]
    if len(masks) != len(references):
        raise InputError(
            _("{masks} masks for {references} references; give one for each, or None.").format(
                masks=len(masks), references=len(references)
            )
        )
    pictures = [_picture(reference, mask, input_node) for reference, mask in zip(references, masks)]
    paths = tuple(os.fspath(mask) if _is_path(mask) else None for mask in masks)
    return pictures, paths if any(paths) else None


def _is_path(value) -> bool:
    return isinstance(value, (str, os.PathLike))


def _picture(reference, mask, input_node):
    """One reference as the library takes it, with the mask in it where that is a node."""
    from MedColorLib.errors import InputError

    if mask is not None and not _is_path(mask) and not hasattr(mask, "IsA"):
        raise InputError(_("The mask of a reference is a volume or segmentation node, or a picture file."))
    if _is_path(reference):
        pictures_in(os.fspath(reference))
        if mask is not None and not _is_path(mask):
            raise InputError(
                _("{name} is a file: its mask is a picture file, too. Load it as a volume to use a node.").format(
                    name=os.path.basename(os.fspath(reference))
                )
            )
        return os.fspath(reference)
    if reference is not None and not hasattr(reference, "IsA"):
        if mask is not None and not _is_path(mask):
            raise InputError(_("A reference that is an array takes its mask as a fourth channel or a picture file."))
        return reference
    picture = picture_from_node(reference, input_node)
    return picture if mask is None or _is_path(mask) else reference_masks.with_mask(picture, mask, reference)
