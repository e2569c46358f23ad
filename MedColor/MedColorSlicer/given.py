"""What a run is given: nodes, paths and arrays of the console and the panel become what the library takes. Copies all."""

from __future__ import annotations

import dataclasses

from slicer.i18n import tr as _

from . import labels as labels_of
from . import references as references_of
from . import scene


@dataclasses.dataclass(frozen=True)
class Given:
    """Arguments of `MedColorLib.colorize`; nothing in it is a node."""

    volume: object
    pictures: list
    settings: object
    guard: object

    def colorize(self, progress=None, cancelled=None):
        """The computation; for a worker thread."""
        import MedColorLib

        return MedColorLib.colorize(self.volume, self.pictures, self.settings, progress, cancelled, guard=self.guard)

    def plan(self):
        """What `colorize` would do."""
        import MedColorLib

        return MedColorLib.make_plan(self.volume, self.pictures, self.settings, guard=self.guard)


def take(  # the keywords are those of `MedColorLogic.process`
    inputVolume,
    references,
    settings,
    roi=None,
    labels=None,
    referenceLabels=None,
    labelGroups=None,
    body=None,
    referenceMasks=None,
) -> Given:
    """See `MedColorLogic.process`.

    Raises:
        MedColorLib.errors.MedColorError: something that cannot be used; the message says what to do.
    """
    volume = scene.volume_from_node(inputVolume)
    settings = scene.with_region(settings, scene.region_from_roi(roi, inputVolume), inputVolume)
    if body is not None:
        settings = dataclasses.replace(settings, body=labels_of.body_from(body, inputVolume))
    pictures, masks = references_of.references_from(references, inputVolume, referenceMasks)
    if masks is not None:
        settings = dataclasses.replace(settings, reference_masks=masks)
    guard = labels_of.guard_from(labels, inputVolume, referenceLabels, labelGroups)
    return Given(volume, pictures, settings, guard)


def take_all(volumes: list, references, settings, nodes: dict, player=None) -> list[Given]:
    """`take` for each of several volumes with the same further nodes; once for all that lie on one grid.

    Args:
        player: volume that shows them one after the other under a transform, of which they know nothing: they lie there.
    """
    first: dict[tuple, Given] = {}
    found = []
    for node in volumes:
        placed = player or node
        grid = (node.GetImageData().GetDimensions(), scene.ijk_to_world(placed).tobytes())
        base = first[grid] if grid in first else first.setdefault(grid, take(placed, references, settings, **nodes))
        own = scene.volume_from_node(node)
        found.append(dataclasses.replace(base, volume=dataclasses.replace(own, ijk_to_ras=base.volume.ijk_to_ras)))
    return found


def colorize_all(work: list[Given], progress=None, cancelled=None) -> list:
    """Colour what `take_all` took: together what lies on one grid, so that matches may serve several time points."""
    import MedColorLib

    grids: dict[tuple, list[int]] = {}
    for n, one in enumerate(work):
        grids.setdefault((one.volume.array.shape, one.volume.ijk_to_ras.tobytes()), []).append(n)
    results, done = {}, 0.0
    for members in grids.values():
        share = len(members) / len(work)

        def report(fraction, text="", done=done, share=share):
            progress(done + fraction * share, text)

        first = work[members[0]]
        volumes = [work[n].volume for n in members]
        arguments = first.pictures, first.settings, progress and report, cancelled, first.guard
        results.update(zip(members, MedColorLib.colorize_time_points(volumes, *arguments)))
        done += share
    return [results[n] for n in range(len(work))]


def settings_of(settings, options):
    """Settings with fields replaced by name.

    Raises:
        MedColorLib.errors.SettingsError: no such field, or a wrong value.
    """
    import MedColorLib
    from MedColorLib.errors import SettingsError

    fields = {field.name for field in dataclasses.fields(MedColorLib.Settings)}
    unknown = sorted(set(options) - fields)
    if unknown:
        raise SettingsError(
            _("There is no setting {unknown}; there are {known}.").format(
                unknown=", ".join(unknown), known=", ".join(sorted(fields))
            )
        )
    return dataclasses.replace(settings, **options) if settings else MedColorLib.Settings(**options)


def draft(settings, slices):
    """Settings at draft quality; options go with their smoother, which another preset may replace."""
    quick = dataclasses.replace(settings, preset="draft", slices=slices, smoother_options=None, confidence=False)
    if quick.resolved_smoother == settings.resolved_smoother:
        quick = dataclasses.replace(quick, smoother_options=settings.smoother_options)
    return quick
