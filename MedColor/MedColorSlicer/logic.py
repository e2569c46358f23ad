"""MedColor without widgets: what the panel, the Python console and a script without any view all call."""

from __future__ import annotations

import logging
import time

import slicer
from slicer.i18n import tr as _
from slicer.ScriptedLoadableModule import ScriptedLoadableModuleLogic

from . import comparison, cut, dependencies, given, light, rendering, rendering_show, scene, sequences
from .dependencies import needs_packages
from .parameters import MedColorParameterNode

_LOG = logging.getLogger("MedColorLib")


class MedColorLogic(ScriptedLoadableModuleLogic):
    """Colours volumes of the scene and shows the result.

    Example, for Slicer's Python console::

        logic = slicer.util.getModuleLogic("MedColor")
        head = slicer.util.getNode("head")
        colored = logic.process(head, "/pictures/cryosection.png", preset="draft")
        logic.showVolumeRendering(colored)

    No method opens a message box. Errors are raised: `MedColorLib.errors.MedColorError` with a sentence that says what
    to do, `MedColorLib.errors.Cancelled` when `cancelled()` said so. In both cases the scene is as it was.
    """

    @staticmethod
    def installPackages() -> None:
        """Install the Python packages that a run needs and Slicer lacks; asks first.

        Raises:
            MedColorLib.errors.MissingPackageError: declined, or it did not work; the message says what to do.
        """
        dependencies.ensure()

    def getParameterNode(self) -> MedColorParameterNode:
        """The choices of the panel, kept in the scene."""
        return MedColorParameterNode(super().getParameterNode())

    @needs_packages
    def process(  # the console's one call; everything but the first two has a default
        self,
        inputVolume,
        references,
        outputVolume=None,
        settings=None,
        progress=None,
        cancelled=None,
        roi=None,
        run=None,
        labels=None,
        referenceLabels=None,
        labelGroups=None,
        body=None,
        referenceMasks=None,
        **options,
    ):
        """Colour a volume.

        Args:
            inputVolume: scalar volume node.
            references: colour pictures: a path, a folder, a colour volume node, an (H, W, 3) uint8 array, or a list.
            outputVolume: vector volume node to fill again, with its display kept; None: a new node.
            settings: MedColorLib.Settings; or give its fields as options, for example preset="draft", seed=1. With
                confidence=True the result's node reference "MedColorConfidence" is a volume of per cents.
            progress: called with (fraction 0..1, text).
            cancelled: called often; True stops and leaves the scene as it was.
            roi: markups ROI node; only the voxels in its box are coloured.
            run: called with the computation, a function without arguments that touches no node, and returns what it
                returns; the panel passes one that uses a worker thread.
            labels: label map or segmentation node; matching and colour do not cross from one label into another.
            referenceLabels: the same labels drawn on the references: for each, in order, a PNG, an (H, W) array of whole
                numbers, a label map node, or None. Without them only colour is kept apart.
            labelGroups: {label: group}; labels of one group count as one. Those of a segmentation are 1, 2, ... in the
                order of its segments. "tissue": by what segments are called. At most 16 groups. Without groups
                more than 15 segments are grouped by what they are called.
            body: what is coloured: "auto", "all", or a label map or segmentation node, not 0 where the body is.
            referenceMasks: what is tissue in the references, for each, in order, or None where it is found: for a path
                that of a picture, for a node a label map, segmentation or picture node of the same size; for an array
                the path of a picture, or a fourth channel of its own.

        Returns:
            vtkMRMLVectorVolumeNode with the colours, under the input's transform and subject-hierarchy folder.

        Raises:
            MedColorLib.errors.MedColorError, MedColorLib.errors.Cancelled
        """
        start = time.monotonic()
        settings = given.settings_of(settings, options)
        self._check_output(outputVolume, inputVolume)
        work = given.take(
            inputVolume,
            references,
            settings,
            roi=roi,
            labels=labels,
            referenceLabels=referenceLabels,
            labelGroups=labelGroups,
            body=body,
            referenceMasks=referenceMasks,
        )
        voxels = scene.voxel_state(inputVolume)

        spacing = inputVolume.GetSpacing()

        def compute():
            colored = work.colorize(progress, cancelled)
            return colored, rendering.axis_of(colored.rgb, spacing)

        result, axis = compute() if run is None else run(compute)
        self._check_still_there(inputVolume, outputVolume, voxels)
        node = scene.publish(result, inputVolume, outputVolume, work.settings.to_dict())
        rendering.know_axis(node, axis)
        rendering.refresh(node)
        _LOG.info("coloured in %.1f s", time.monotonic() - start)
        return node

    @needs_packages
    def processSequence(
        self, sequence, references, settings=None, progress=None, cancelled=None, run=None, nodes=None, **options
    ):
        """Colour every time point of a sequence.

        Time points that show nearly the same are matched once (`MedColorLib.colorize_time_points`); the log says which.

        Args:
            sequence: vtkMRMLSequenceNode of scalar volumes.
            references, settings, progress, cancelled, run, options: as for `process`.
            nodes: {name: value} of further arguments of `process`: roi, labels, labelGroups, body, referenceLabels,
                referenceMasks; the same for every time point. Nodes of roi, labels and body lie where the volume that
                plays the time points shows them, under its transform, too.

        Returns:
            vtkMRMLSequenceNode of vector volumes, in step with the sequence in the browsers that play it. All time points
            or none: cancelled, or after an error, the scene is as it was.

        Raises:
            MedColorLib.errors.MedColorError, MedColorLib.errors.Cancelled
        """
        from MedColorLib.errors import InputError

        settings = given.settings_of(settings, options)
        volumes = sequences.volumes_of(sequence)
        player = sequences.moved_player(sequence, nodes or {})
        work = given.take_all(volumes, references, settings, nodes or {}, player)

        def compute():
            return given.colorize_all(work, progress, cancelled)

        results = compute() if run is None else run(compute)
        if sequence.GetScene() is None or sequence.GetNumberOfDataNodes() != len(volumes):
            raise InputError(_("The sequence was changed while it was being coloured. Call again."))
        return sequences.publish(sequence, results)

    @needs_packages
    def preview(
        self, inputVolume, references, sliceIndex, settings=None, cancelled=None, run=None, previous=None, **nodes
    ):
        """Colour one slice in seconds.

        Args:
            sliceIndex: number of the transverse slice, counted from the feet up (`scene.slice_index_at`).
            previous: node of an earlier preview, filled again.
            nodes: roi, labels, referenceLabels, labelGroups, body, referenceMasks as for `process`.

        Returns:
            A vector volume node of one slice (three voxels thick), at its place in space; not saved with the scene.

        Raises:
            MedColorLib.errors.MedColorError: as for `process`, or the slice lies outside the region.
        """
        import MedColorLib
        from MedColorLib.volume import ColorVolume

        settings = given.draft(settings or MedColorLib.Settings(), (sliceIndex, sliceIndex + 1))
        self._check_in_region(nodes.get("roi"), inputVolume, sliceIndex, settings.plane)
        work = given.take(inputVolume, references, settings, **nodes)
        voxels = scene.voxel_state(inputVolume)

        def compute():
            return work.colorize(None, cancelled)

        result = compute() if run is None else run(compute)
        self._check_still_there(inputVolume, previous, voxels)
        slab, offset = scene.slab_at(inputVolume, sliceIndex)
        # three times the same: linear interpolation between slice and black outside it would darken its faces
        axis = scene.stack_of(inputVolume)[0].axes[0]
        plane = ColorVolume(result.rgb[slab].repeat(3, axis=axis), result.ijk_to_ras, result.report)
        offset = tuple(first - (2 - n == axis) for n, first in enumerate(offset))
        name = f"{inputVolume.GetName()} preview"
        node = scene.publish(plane, inputVolume, previous, settings.to_dict(), name)
        node.SetSaveWithScene(False)
        scene.place_part(node, inputVolume, offset)
        return node

    @needs_packages
    def plan(self, inputVolume, references, settings=None, **nodes):
        """What a run would do, what it leaves out and why; takes seconds at most.

        Args:
            nodes: roi, labels, referenceLabels, labelGroups, body, referenceMasks as for `process`.

        Returns:
            MedColorLib's plan: `.text()` for people, `.to_dict()` for programs.
        """
        return self.planner(inputVolume, references, settings, **nodes)()

    @needs_packages
    def planner(self, inputVolume, references, settings=None, **nodes):
        """The computation behind `plan`: a function without arguments that touches no node, for a worker thread."""
        import MedColorLib

        return given.take(inputVolume, references, settings or MedColorLib.Settings(), **nodes).plan

    @needs_packages
    def recommend(  # everything after the second has a default
        self, inputVolume, libraryFolder, top=3, sliceIndex=None, features="auto", device="auto", job=None, run=None
    ):
        """The pictures of a folder, its subfolders included, that suit a volume best.

        Args:
            sliceIndex: number of a transverse slice, counted from the feet up; None: the whole volume.
            job: an object with `progress(fraction, text)` and `cancelled()`, for a panel.
            run: as for `process`.

        Returns:
            List of (path, score), best first; a score of 1 is a perfect match.
        """
        from MedColorLib.matching.recommend import recommend

        volume = scene.volume_from_node(inputVolume)
        options = {"progress": job.progress, "cancelled": job.cancelled} if job else {}

        def compute():
            return recommend(volume, str(libraryFolder), top, sliceIndex, features, device, **options)

        return compute() if run is None else run(compute)

    @needs_packages
    def showVolumeRendering(self, volumeNode, viewNodes=None, opacity=None):
        """Show a result in 3-D (in every view, or in the given view nodes); the display is created the first time.

        Settings the user changed are kept; a preset that was applied by hand is replaced. Works without any view.

        Returns:
            vtkMRMLVolumeRenderingDisplayNode.
        """
        from MedColorLib.errors import InputError

        image = volumeNode.GetImageData() if volumeNode else None
        if image is None or image.GetNumberOfScalarComponents() != 3 or image.GetScalarSize() != 1:
            raise InputError(_("Only an RGB volume made by MedColor can be shown this way; colour a volume first."))
        return rendering_show.show(volumeNode, viewNodes, opacity)

    def hideVolumeRendering(self, volumeNode) -> None:
        """Hide the 3-D display of a volume; its settings stay."""
        rendering.hide(volumeNode)

    @needs_packages
    def resetVolumeRendering(self, volumeNode) -> None:
        """MedColor's own opacity curve, lighting and interpolation, whatever was changed."""
        rendering.reset(volumeNode)

    def setOpacity(self, volumeNode, opacity: float) -> None:
        """0 (nothing is seen) to 1 (solid)."""
        rendering.set_opacity(volumeNode, opacity)
        comparison.set_opacity(volumeNode, opacity)

    @needs_packages
    def showComparison(self, greyVolume, colorVolume, fade: float = 1.0):
        """Two 3-D views, grey and colour, with linked cameras; slice views with colour over grey.

        Returns:
            (view node of colour, view node of grey), or None where there are no two 3-D views (no main window).
        """
        return comparison.show(greyVolume, colorVolume, fade)

    def hideComparison(self, greyVolume, colorVolume) -> None:
        """Back to the earlier layout; colour in every 3-D view, grey in none."""
        comparison.hide(greyVolume, colorVolume)

    def setLight(self, realistic: bool) -> None:
        """Realistic light in all 3-D views (see `light`), or the plain lamp at the camera."""
        light.switch(slicer.mrmlScene, realistic)

    def setCut(self, volumeNode, kind: str) -> None:
        """What is cut away in 3-D: "none", "slice" (beyond the red slice, which it follows), "box"."""
        from MedColorLib.errors import SettingsError

        if kind not in cut.CUTS:
            raise SettingsError(
                _("There is no cut {kind}; there are {known}.").format(kind=kind, known=", ".join(cut.CUTS))
            )
        cut.set_cut(volumeNode, kind)

    def setFade(self, fade: float) -> None:
        """0: slice views show grey alone; 1: colour alone."""
        comparison.set_fade(slicer.mrmlScene, fade)

    @staticmethod
    def _check_output(output_node, input_node) -> None:
        from MedColorLib.errors import InputError

        if output_node is None:
            return
        if output_node is input_node or not output_node.IsA("vtkMRMLVectorVolumeNode"):
            raise InputError(
                _("{name} cannot take colours; select a vector volume or none.").format(name=output_node.GetName())
            )

    @staticmethod
    def _check_in_region(roi, input_node, index: int, plane: str) -> None:
        from MedColorLib.errors import InputError

        if roi is None or scene.input_problem(input_node):  # which is said when the volume is taken
            return
        start, stop = scene.slices_of_region(scene.region_from_roi(roi, input_node), input_node, plane)
        if not start <= index < stop:
            raise InputError(
                _(
                    "The red view shows slice {index}, outside the region {name}; scroll into it or select no region."
                ).format(index=index, name=roi.GetName())
            )

    @staticmethod
    def _check_still_there(input_node, output_node, voxels) -> None:
        from MedColorLib.errors import InputError

        for node in (input_node, output_node):
            if node is not None and (node.GetScene() is None or not node.GetScene().IsNodePresent(node)):
                raise InputError(_("A volume was removed while it was being coloured; nothing was changed."))
        if scene.voxel_state(input_node) != voxels:
            raise InputError(_("The volume was changed while it was being coloured; nothing was changed. Apply again."))
