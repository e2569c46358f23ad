"""The pipeline, stage by stage: volume -> slices -> contrast -> features -> correspondence -> colour -> volume."""

from __future__ import annotations

import hashlib
import logging
import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from . import device
from .device import memory_errors
from .errors import MemoryTooSmall
from .parameters import Settings
from .plan import LeftOut, Plan
from .progress import Progress, Run, check
from .run.patient import report_body
from .run.prepare import Prepared, prepare
from .volume import ColorVolume, Volume

if TYPE_CHECKING:
    from .matching.tissue_guard import Guard
    from .run.engine import Engine
    from .run.paint import Painter
    from .run.resume import Resume, RunStore
    from .run.timepoints import KeptMatches

log = logging.getLogger("MedColorLib")


def make_plan(
    volume: Volume,
    references: Sequence,
    settings: Settings | None = None,
    resume: bool | str | os.PathLike | Resume = False,
    guard: Guard | None = None,
) -> Plan:
    """What `colorize` would do with these arguments, and what it would leave out; takes seconds at most."""
    from .run.resume import open_store

    prepared = prepare(volume, references, settings or Settings(), find_device=bool(resume), guard=guard)
    store = open_store(prepared, resume)
    if store:
        _leave_out(prepared.plan, store.stored_slices())
    return prepared.plan


def plan_time_points(
    volumes: Sequence[Volume], references: Sequence, settings: Settings | None = None, guard: Guard | None = None
) -> list[Plan]:
    """What `colorize_time_points` would do with each time point, whose matches it takes, and what it would leave out."""
    from .run.timepoints import Series

    series = Series(volumes, references, settings or Settings(), guard, Run(None, None))
    for n in range(len(series)):
        series.say(n)
    return [prepared.plan for prepared in series.prepared]


def colorize(
    volume: Volume,
    references: Sequence,
    settings: Settings | None = None,
    progress: Progress | None = None,
    cancelled: Callable[[], bool] | None = None,
    resume: bool | str | os.PathLike | Resume = False,
    guard: Guard | None = None,
) -> ColorVolume:
    """Colour a grey volume after colour references.

    Args:
        volume: scalars (k, j, i); never altered.
        references: paths of colour pictures, folders or colour volumes, names of libraries, (h, w, 3) uint8 RGB arrays or
            `ColorVolume`s. With several, each slice takes the one most like it.
        settings: see `Settings`.
        progress: called with the fraction done (0..1) and a short text.
        cancelled: asked between batches of slices; True raises `Cancelled`.
        resume: True, a folder or `resume.Resume` keeps on disk what has been matched and takes up what an interrupted run
            with the same arguments left; the result has the same bytes. It is kept until `resume.forget_run(report,
            resume)`, to be called once the result is written, or until newer runs need the room.
        guard: labels of tissue that matching and colour do not cross; see `guard.Guard`.

    Returns:
        RGB volume on the same grid, with a report; outside the body black, but for three voxels in which its colour fades.
        The colours are an illustration, not a measurement.

    Raises:
        InputError, SettingsError, WeightsError, DeviceError (MemoryTooSmall is one): with the remedy in the message.
        Cancelled: nothing was written.
    """
    with memory_errors("cpu"):  # outside of the batches, which are made smaller
        return _colorize(volume, references, settings or Settings(), Run(progress, cancelled), resume, guard)


def colorize_time_points(
    volumes: Sequence[Volume],
    references: Sequence,
    settings: Settings | None = None,
    progress: Progress | None = None,
    cancelled: Callable[[], bool] | None = None,
    guard: Guard | None = None,
) -> Iterator[ColorVolume]:
    """Colour the volumes of a series (a beating heart, phases of contrast), one after the other.

    Where a time point shows nearly the same as an earlier one, it takes the matches of that one, and only its colour is made
    anew, from its own grey; see `run.timepoints`. The plan and the report ("time_point") of each say what was done.

    Args:
        volumes: of one grid (shape and geometry), in the order of time.
        The others: as for `colorize`, the same for all.

    Yields:
        What `colorize` returns, for each time point as soon as it is coloured: it may be written and forgotten.

    Raises:
        As `colorize`, when the first or next result is asked for. InputError, too: no volume, or several grids.
    """
    from .run.timepoints import Series, share_of

    settings = settings or Settings()
    run = Run(progress, cancelled)
    with memory_errors("cpu"), run.timed("prepare"):
        run.step(0.0, "preparing")
        series = Series(volumes, references, settings, guard, run)
    for n, prepared in enumerate(series.prepared):
        own, said = Run(share_of(progress, n, len(series)), cancelled), series.say(n)
        with memory_errors("cpu"):
            colored, engine = _color_prepared(prepared, own, *series.matches_for(n))
        series.keep(n, engine)
        colored.report["time_point"] = said
        yield colored


def _colorize(
    volume: Volume, references: Sequence, settings: Settings, run: Run, resume: bool | str | Resume, guard: Guard | None
) -> ColorVolume:
    run.step(0.0, "preparing")  # before torch is imported, which takes seconds on a cold disk and cannot be broken off
    from .run.resume import open_store

    with run.timed("prepare"):
        prepared = prepare(volume, references, settings, guard=guard)
        store = open_store(prepared, resume)
    if store and store.stored_slices():
        log.info("resume: an interrupted run left %d slices matched; going on from there", store.stored_slices())
    return _color_prepared(prepared, run, store)[0]


def _color_prepared(
    prepared: Prepared, run: Run, store: RunStore | KeptMatches | None, like: Engine | None = None
) -> tuple[ColorVolume, Engine]:
    """Everything after the stage *prepare*.

    Args:
        like: engine of a time point that shows nearly the same.

    Returns:
        The result, and the engine that made it.
    """
    from .run.engine import Engine
    from .run.timepoints import taken_over

    volume = prepared.volume
    for text in prepared.groups.unguarded(prepared.references) if prepared.groups else ():
        log.warning("tissue guard: %s", text)
    for text in prepared.plan.warnings:
        log.warning("%s", text)
    rgb = np.zeros((*volume.array.shape, 3), np.uint8)
    confidence = np.zeros(volume.array.shape, np.uint8) if prepared.settings.confidence else None
    with device.side_by_side() as each:
        with run.timed("network"):
            run.step(0.02, f"loading {prepared.plan.features} features")
            engine = taken_over(like, prepared, run, each) if like else Engine(prepared, run, store, each)
        if not like:
            engine.learn_elsewhere()
        painter = _color_slices(prepared, engine, rgb, confidence, run, each)
        with run.timed("rim"):
            run.step(0.99, "border of the body")
            rim_voxels = _add_rim(prepared, rgb, each)
    run.step(1.0, "done")
    _leave_out(prepared.plan, store.resumed_slices if store else 0)
    report = {**_report(prepared, engine, run, painter), "rim_voxels": rim_voxels, **_resumed(store)}
    return ColorVolume(rgb, volume.ijk_to_ras, report, f"{volume.name} coloured", confidence), engine


def _leave_out(plan: Plan, resumed: int) -> None:
    """Say in the plan that slices need no matching because an interrupted run left it."""
    if resumed:
        why = "an interrupted run with the same volume, references and settings left it (--resume)"
        plan.left_out.append(LeftOut("matching done before", why, f"{resumed} of {len(plan.slices)} slices"))


def _resumed(store: RunStore | KeptMatches | None) -> dict:
    """What the report says of an interrupted run."""
    if store is None:
        return {"resumed_slices": 0, "resume_run": None, "resume_problem": None}
    return {"resumed_slices": store.resumed_slices, "resume_run": store.key, "resume_problem": store.problem}


def _color_slices(
    prepared: Prepared, engine: Engine, rgb: np.ndarray, confidence: np.ndarray | None, run: Run, each: device.Each
) -> Painter:
    """Fill `rgb` (k, j, i, 3) and, where it is wanted, `confidence` (k, j, i)."""
    from .run.paint import Painter

    view = prepared.order.view
    painter = Painter(prepared, engine, view(rgb), None if confidence is None else view(confidence), each)
    _color_batches(prepared, engine, painter, run)
    return painter


def _add_rim(prepared: Prepared, rgb: np.ndarray, each: device.Each) -> int:
    """Give the border of the body in `rgb` (k, j, i, 3) the scan's own ramp; returns the number of voxels."""
    from .coloring.rim import add_rim, air_level
    from .run.paint import PaintedMasks

    if prepared.body.given is not None:
        return 0  # a mask is coloured as it is, to its very edge; no threshold says where the scan's ramp would end
    chosen, threshold = sorted(prepared.plan.slices), prepared.body.threshold
    may_change = _slices_of_rim(prepared)
    planes = range(int(may_change[0]), int(may_change[-1]) + 1)
    rows, cols = (slice(*ends) for ends in prepared.region[1:])
    few = chosen[:: max(1, len(chosen) // 16)]
    air = air_level([prepared.view[k] for k in few], PaintedMasks(prepared, few), threshold)
    # only what was asked for: cropped, so that a face of the part is no border of the body
    return add_rim(
        prepared.order.view(rgb)[planes.start : planes.stop, rows, cols],
        PaintedMasks(prepared, planes, (rows, cols)),
        prepared.view[planes.start : planes.stop, rows, cols],
        threshold,
        air,
        tuple(prepared.volume.spacing_mm[::-1][list(prepared.order.axes)]),
        np.isin(planes, may_change),
        check,
        each,
    )


def _slices_of_rim(prepared: Prepared) -> np.ndarray:
    """The slices that are coloured, and those without body next to them that the user did not exclude."""
    from .coloring.rim import OUTSIDE

    first, stop = prepared.region[0]
    if prepared.settings.slices:
        first, stop = max(first, prepared.settings.slices[0]), min(stop, prepared.settings.slices[1])
    wanted = np.zeros(len(prepared.view), bool)
    wanted[list(prepared.plan.slices)] = True
    near = np.convolve(wanted, np.ones(2 * OUTSIDE + 1), "same")[: len(wanted)] > 0
    near[:first] = near[stop:] = False
    near[prepared.body.slices] = False
    return np.flatnonzero(wanted | near)


def _color_batches(prepared: Prepared, engine: Engine, painter: Painter, run: Run) -> None:
    """Match and paint slices, as many together as the settings and the device's memory allow."""
    batch = prepared.settings.batch
    waiting = list(prepared.plan.slices)
    while waiting:
        ks = _next_batch(waiting, engine, prepared.repeats, batch)
        done = len(prepared.plan.slices) - len(waiting)
        run.step(0.05 + 0.94 * done / len(prepared.plan.slices), f"slice {done + 1} of {len(prepared.plan.slices)}")
        try:
            with memory_errors(engine.device):
                matches = engine.match(ks, engine.choice[ks[0]]) if ks[0] not in prepared.repeats else None
        except MemoryTooSmall:
            if batch == 1:
                raise
            batch = max(1, batch // 2)
            log.warning("device memory is short: batches of %d slices from here on", batch)
            continue
        with run.timed("colour"):
            painter.add(ks, matches)
        waiting = waiting[len(ks) :]


def _next_batch(waiting: list[int], engine: Engine, repeats: dict[int, int], batch: int) -> list[int]:
    """The next slices that go through the network together: the same reference, no repeats; or one repeat by itself."""
    if waiting[0] in repeats:
        return waiting[:1]
    ks = []
    for k in waiting[:batch]:
        if k in repeats or engine.choice[k] != engine.choice[waiting[0]]:
            break
        ks.append(k)
    return ks


def _guard(prepared: Prepared, engine: Engine, painter: Painter) -> dict | None:
    """What the report says of the tissue guard; voxels without any colour of their own group are said in the log, too."""
    if prepared.groups is None:
        return None
    if painter.uncolored:
        log.warning("tissue guard: %d voxels stay grey, their group has no match in these slices", painter.uncolored)
    return {
        **prepared.groups.report(prepared.references),
        "without_own_match": {str(k): round(share, 4) for k, share in engine.unmatched.items()},
        "grey_voxels": painter.uncolored,
    }


def _greyed(painter: Painter) -> dict[str, float]:
    """Slice -> share of its colour that was kept, for the slices where too little could be trusted; said in the log."""
    greyed = {str(k): round(share, 4) for k, share in painter.saturation.items() if share < 1}
    if greyed:
        log.warning(
            "%d of %d slices look so unlike the reference that they stay grey or nearly so: choose a reference of the "
            "same part of the body",
            len(greyed),
            len(painter.saturation),
        )
    return greyed


def _reported_settings(settings: Settings) -> dict:
    """Plain data; of paths only the file's name: folders may name patients."""
    data, masks = settings.to_dict(), settings.reference_masks
    shown = masks and [mask and os.path.basename(mask) for mask in masks]
    return {**data, "body": os.path.basename(data["body"]), "reference_masks": shown}


def _told(plan: Plan, reference_warnings: list[dict]) -> Plan:
    """The plan with what was found out since."""
    from .run.doubts import warning_text

    return replace(plan, warnings=(*plan.warnings, *map(warning_text, reference_warnings)))


def _report(prepared: Prepared, engine: Engine, run: Run, painter: Painter) -> dict:
    from .report import environment, peak_memory_mb, voxels_sha256

    volume = prepared.volume
    used = sorted(set(engine.choice.values()))
    return {
        "notice": "Illustration: the colours are not a measurement.",
        "input": {
            "name": volume.name,
            "sha256": voxels_sha256(volume.array),
            "shape_kji": list(volume.array.shape),
            "dtype": volume.array.dtype.name,
            "ijk_to_ras": volume.ijk_to_ras.tolist(),
            "notes": list(volume.notes),
        },
        "references": [
            {
                "name": r.name,
                "sha256": hashlib.sha256(r.rgb.tobytes()).hexdigest(),
                "removed_fraction": r.removed,
                "credit": r.credit,
                "notes": list(r.notes),
                "exposure": {"gain": round(r.exposure.gain, 4), "white": [round(f, 4) for f in r.exposure.white]},
            }
            for r in prepared.references
        ],
        "reference_of_slice": {str(k): prepared.references[i].name for k, i in engine.choice.items()},
        "references_assigned": engine.assigned,
        "reference_lies": {engine.references[i].name: engine.references[i].way for i in used},
        "reference_warnings": engine.reference_warnings,
        "reference_lies_guessed": [engine.references[i].name for i in used if engine.references[i].lie.guess],
        "reference_features": {engine.references[i].name: "read" if engine.kept.get(i) else "made" for i in used},
        "components": {
            engine.references[i].name: {str(n): round(share, 4) for n, share in engine.energy.get(i, {}).items()}
            for i in used
        },
        "contrast": {engine.references[i].name: engine.references[i].contrast.describe() for i in used},
        "settings": _reported_settings(prepared.settings),
        "smoother_options": engine.smoother_options,
        "plan": _told(prepared.plan, engine.reference_warnings).to_dict(),
        "searched": {str(k): v for k, v in engine.searched.items()},
        "deconvolution": engine.reconstruct.report() if engine.reconstruct else None,
        "seconds": {
            **{k: round(v, 4) for k, v in run.seconds.items()},
            "total": round(time.perf_counter() - run.started, 4),
        },
        "peak_memory_mb": peak_memory_mb(),
        "out_of_gamut_pixels": painter.clipped,
        "lightness_bent_pixels": painter.bent,
        "trusted_fraction": {str(k): v for k, v in painter.trusted.items()},
        # how far a grey was taken for one tissue, and how many slices were asked all over the scan what it means
        "one_tissue_fraction": {str(k): v for k, v in painter.one_tissue.items()},
        "slices_asked_of_grey": engine.asked,
        "greyed_slices": _greyed(painter),
        "body": report_body(prepared.body),
        "guard": _guard(prepared, engine, painter),
        "contrast_agreement": {str(k): v for k, v in painter.agreement.items()},
        "environment": environment(prepared.plan.device),
    }
