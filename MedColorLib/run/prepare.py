"""Stage *prepare*: everything that is decided before computing: order, body, window, references, device, plan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..device import choose_device
from ..errors import InputError, SettingsError
from ..features import choose_features
from ..matching.tissue_guard import Groups, Guard, prepare_guard
from ..parameters import PRESETS, Settings
from ..plan import LeftOut, Plan
from ..progress import check
from ..references.loading import describe_references, load_references
from ..references.photograph import Reference
from ..scan.body import Body
from ..scan.grid import Grid, choose_grid
from ..scan.intensity import Window, check_values
from ..scan.planes import PlaneBlocks, planes_of
from ..scan.slices import SliceOrder, sample_slices, slice_order, window_of
from ..volume import Volume
from .patient import choose_body, describe_body

# how the plan speaks of feature networks
NETWORKS = {"embedded": "MedColor's own network (no download)", "vgg19": "VGG-19", "gray-vgg19": "gray VGG-19"}
# by the own features and the regression alone: `elsewhere`
_ASKED = "; where matches tell little, up to 16 of the body's slices are matched all the same, to learn what grey means"


@dataclass(frozen=True)
class Prepared:
    """What `colorize` needs to start; nothing in it is a copy of the volume, but for planes that lie across it (`planes`)."""

    volume: Volume
    settings: Settings
    order: SliceOrder
    view: np.ndarray | PlaneBlocks
    body: Body
    window: Window
    references: tuple[Reference, ...]
    grid: Grid
    repeats: dict[int, int]
    plan: Plan
    groups: Groups | None = None

    @property
    def region(self) -> tuple[tuple[int, int], ...]:
        """(slice, row, column) ranges that are coloured: the user's region or everything."""
        whole = tuple((0, n) for n in self.volume.array.shape)
        return self.order.ranges(self.settings.region or whole, self.volume.array.shape)

    @property
    def slice_spacing_mm(self) -> float:
        """Distance between neighbouring slices of the stack."""
        return float(self.volume.spacing_mm[2 - self.order.axes[0]])


def prepare(
    volume: Volume,
    references: Sequence,
    settings: Settings,
    find_device: bool = True,
    guard: Guard | None = None,
    loaded: tuple[Reference, ...] | None = None,
) -> Prepared:
    """Decide everything; see `Prepared`.

    Args:
        find_device: False leaves "auto" undecided, which needs no torch: enough for a plan.
        guard: labels that matching and colour do not cross.
        loaded: the references as they were prepared for another time point of the same series.

    Raises:
        InputError, SettingsError, WeightsError, DeviceError: with the remedy in the message.
    """
    note = check_values(volume.array, volume.name)
    features = choose_features(settings.features, settings.preset)
    if settings.reconstruction == "lbfgs" and features == "embedded":
        raise SettingsError(
            "reconstruction lbfgs inverts a network of several layers; the own features have one: use warp or vgg19"
        )
    device = choose_device(settings.device) if find_device else settings.device
    prepared_references = loaded or load_references(references, settings.exposure, settings.reference_masks)
    order = slice_order(volume.ijk_to_ras, settings.plane)
    view = planes_of(order.view(volume.array))
    grid = choose_grid(PRESETS[settings.preset].grid_px)
    groups = guard and prepare_guard(guard, volume, prepared_references, settings, order, grid)
    body = choose_body(view, volume, settings, order)
    chosen = _chosen_slices(body, settings, order, volume.array.shape)
    window = _window(view, body, chosen, volume, settings)
    repeats = _repeats([view, groups.view] if groups else [view], chosen)
    plan = _plan(
        volume, settings, order, view, body, chosen, window, prepared_references, grid, repeats, features, device
    )
    if note:
        plan.steps["volume"] += f"; {note}"
    if groups:
        plan.steps["tissue guard"] = groups.describe(prepared_references)
    return Prepared(volume, settings, order, view, body, window, prepared_references, grid, repeats, plan, groups)


def _chosen_slices(body: Body, settings: Settings, order: SliceOrder, shape: tuple[int, int, int]) -> list[int]:
    count = len(body.boxes)
    start, stop = settings.slices or (0, count)
    if start >= count:
        raise SettingsError(f"slices {start}:{stop}: the volume has {count} slices (0:{count})")
    if settings.region is not None:
        (first, last), *_ = ranges = order.ranges(settings.region, shape)
        if any(low >= high for low, high in ranges):
            raise SettingsError(f"region {settings.region}: lies outside the volume of {shape} voxels (k, j, i)")
        start, stop = max(start, first), min(stop, last)
    chosen = [int(k) for k in body.slices if start <= k < stop]
    if not chosen:
        found = f"{body.slices[0]}:{body.slices[-1] + 1}"
        raise InputError(f"slices {start}:{stop}: no body in this range; body was found in {found}")
    return chosen


def _window(view, body, chosen, volume, settings) -> Window:
    return window_of(view, body, sample_slices(chosen, 24), settings.window, volume.window)


def _repeats(views: Sequence[np.ndarray], chosen: list[int]) -> dict[int, int]:
    """Slice -> earlier neighbouring slice with exactly the same values in every view."""
    repeats: dict[int, int] = {}
    for before, k in zip(chosen, chosen[1:]):
        check()
        if k == before + 1 and all(np.array_equal(view[k], view[before]) for view in views):
            repeats[k] = repeats.get(before, before)
    return repeats


def _plan(volume, settings, order, view, body, chosen, window, references, grid, repeats, features, device) -> Plan:
    preset, smoother = PRESETS[settings.preset], settings.resolved_smoother
    boxes = body.boxes[chosen]
    cropped = float(((boxes[:, 1] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 2])).sum()) / (len(chosen) * view[0].size)
    layers = "one layer" if features == "embedded" else f"layers 5 to {preset.stop_layer}"
    shape = " x ".join(map(str, volume.array.shape))
    auto = " (auto)" if settings.features == "auto" else ""
    searched = " at layers 5 to 3, in windows below" if preset.stop_layer < 3 and features != "embedded" else ""
    luminance = {
        "natural": f"of the reference's tissues with the scan's detail ({100 * settings.lightness:.0f} % of the way)",
        "keep": "of the scan",
        "paper": "of the reference (paper)",
    }[settings.luminance]
    gamma = "1/2 and 2" if settings.resolved_gamma else "off"
    steps = {
        "volume": f"{volume.name}, {shape} (k, j, i) {volume.array.dtype.name}; {order.describe()}",
        "window": window.describe(),
        "body": describe_body(body, len(chosen)),
        "references": describe_references(references),
        "features": f"{NETWORKS[features]}{auto}, {layers}, raster {grid.height} x {grid.width}, on {device}",
        "matching": f"both directions, exhaustive{searched}",
        "coherence": _coherence(settings, order, volume, len(chosen), len(references) > 1),
        "colour": f"{smoother}, {_smoother_values(settings, features)}; luminance {luminance}; gamma {gamma}",
    }
    left_out = _left_out(settings, preset, smoother, features, view, body, chosen, references, repeats, cropped)
    warnings = tuple(filter(None, [body.left_outside and body.left_outside.warning()]))
    return Plan(steps, left_out, tuple(chosen), features, device, smoother, warnings)


def _smoother_values(settings: Settings, features: str) -> str:
    from ..filters import smoother_parameters
    from ..filters.options import values_text
    from ..matching.usual import MANY_PX

    options = settings.smoother_options or {}
    text = values_text(smoother_parameters(settings.resolved_smoother, options))
    if settings.resolved_smoother == "regression" and features == "embedded" and "support_px" not in options:
        text += f" (support up to {MANY_PX:g} where the matches ask for it)"
    return text


def _coherence(settings: Settings, order: SliceOrder, volume: Volume, count: int, changes: bool) -> str:
    """changes: whether the reference may change from slice to slice."""
    from ..coloring.coherence import MOST_SLICES, sigma_in_slices

    if settings.coherence_mm == 0 and changes and count > 1:
        return "each slice by itself; colours jump where the reference changes"
    if settings.coherence_mm == 0 or count == 1 or not (settings.weighs_matches or changes):
        return "each slice by itself"
    spacing = float(volume.spacing_mm[2 - order.axes[0]])
    narrowed = sigma_in_slices(spacing, settings.coherence_mm) == MOST_SLICES
    reach = f"{MOST_SLICES:g} slices, the most" if narrowed else f"{settings.coherence_mm:g} mm"
    if not settings.weighs_matches:
        return (
            f"each slice by itself; near changes of reference matched colours averaged along the stack, sigma {reach}"
        )
    return f"evidence averaged along the stack, sigma {reach}" + (", across changes of reference" if changes else "")


def _left_out(settings, preset, smoother, features, view, body, chosen, references, repeats, cropped) -> list[LeftOut]:
    entries = []
    empty = len(view) - len(body.slices)
    if empty:
        entries.append(LeftOut("empty slices", "no body in them; they stay black", f"{empty} of {len(view)} slices"))
    told = _ASKED if features == "embedded" and smoother == "regression" else ""
    if settings.region is not None:
        text = f"not asked for; voxels beyond stay black{told or ', slices beyond are not matched'}"
        entries.append(LeftOut("outside the region of interest", text, f"{len(body.slices) - len(chosen)} slices"))
    outside = len(body.slices) - len(chosen)
    if outside and settings.region is None:
        entries.append(
            LeftOut("slices outside the range", f"not asked for; they stay black{told}", f"{outside} slices")
        )
    entries.append(
        LeftOut(
            "air around the body", "each slice is cut to its body's box", f"{100 * (1 - cropped):.0f} % of the pixels"
        )
    )
    if repeats:
        entries.append(
            LeftOut(
                "repeated slices",
                "same values as their neighbour; its matches are used again",
                f"{len(repeats)} slices",
            )
        )
    if features == "embedded":
        text = (
            "MedColor's own features see no contrast; there is nothing for latent pictures and finer layers to bridge"
        )
        entries.append(
            LeftOut("latent pictures, contrast curve, layers 5, 4, 2, 1", text, "all but one search a slice")
        )
    elif preset.stop_layer > 1:
        below = ", ".join(str(layer) for layer in range(preset.stop_layer - 1, 0, -1))
        entries.append(
            LeftOut(
                f"layers {below}",
                "going on to layer 1 (full) brought the thorax pair of the benchmark no nearer to the truth",
                "over nine tenths of the matching",
                "at most 0.3 CIEDE2000 there, in favour of leaving them out",
            )
        )
    if not (settings.weighs_matches or settings.confidence):
        entries.append(LeftOut("reverse map of the last layer", "nothing reads it", "one of two searches"))
    if settings.components and features != "embedded":
        entries.append(
            LeftOut(
                f"all but {settings.components} components of the features of layers 4 and finer",
                "the photograph's features hardly have the others",
                "two thirds to four fifths of each product",
                "none on the mean of the benchmark's 15 pairs, at most 0.08 CIEDE2000 on one",
            )
        )
    if settings.reconstruction == "warp" and features != "embedded":
        entries.append(
            LeftOut(
                "L-BFGS deconvolution",
                "the reference's own finer features are warped instead; --reconstruction lbfgs brings it back",
                "an optimisation per layer and direction",
                "below 0.01 CIEDE2000 on two thorax pairs at layer 3",
            )
        )
    if len(references) == 1:
        entries.append(
            LeftOut(
                "recommendation (fc6)",
                "the reference was given",
                "411 MB of weights" if features == "vgg19" else "one descriptor per slice",
            )
        )
    if len(chosen) > 1 and len(references) == 1:
        entries.append(
            LeftOut(
                "reference features for every slice",
                _once(features),
                f"{len(chosen) - 1} of {len(chosen)} extractions",
            )
        )
    if len(references) > 1 and len(chosen) > 1 and settings.coherence_mm > 0:
        entries.append(
            LeftOut(
                "a second match where the reference changes",
                "the average along the stack passes from one reference to the next",
                "up to as many matches again",
                "a jump at a change is 1.0 to 1.6 times that elsewhere, with it 0.9 to 1.1 times",
            )
        )
    entries += _left_out_of_colour(settings, smoother)
    entries.append(LeftOut("alpha volume", "renderers derive opacity from luminance", "a third of the output"))
    return entries


def _once(features: str) -> str:
    return "computed once for all slices" + (
        "" if features == "embedded" else " and kept on disk by content for the next run"
    )


def _left_out_of_colour(settings, smoother) -> list[LeftOut]:
    entries = []
    if settings.luminance == "keep":
        entries.append(LeftOut("smoothing of L*", "the scan's own luminance is kept", "a third of the smoothing"))
    entries.append(
        LeftOut("second smoothing solve", "S(T') - S(X) = S(T' - X), the smoother is linear", "half of the smoothing")
    )
    if smoother == "regression":
        entries.append(
            LeftOut(
                "smoothing at full resolution",
                "what the regression leaves is as coarse as the matches: half the raster will do",
                "three quarters or more of the smoothing",
                "0.01 CIEDE2000 on the pairs of the benchmark",
            )
        )
    if not settings.confidence:
        entries.append(LeftOut("confidence volume", "not asked for", "a quarter of the output"))
    return entries
