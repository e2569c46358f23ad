"""The pipeline, stage by stage: volume -> slices -> contrast -> features -> correspondence -> colour -> volume."""

from __future__ import annotations

import hashlib
import logging
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from .device import memory_errors
from .errors import DeviceError
from .parameters import Settings
from .plan import Plan
from .prepare import Prepared, prepare
from .progress import Progress, Run
from .volume import ColorVolume, Volume

if TYPE_CHECKING:
    from .engine import Engine
    from .paint import Painter

log = logging.getLogger("MedColor")


def make_plan(volume: Volume, references: Sequence, settings: Settings | None = None) -> Plan:
    """What `colorize` would do with these arguments, and what it would leave out; takes seconds at most."""
    return prepare(volume, references, settings or Settings(), find_device=False).plan


def colorize(
    volume: Volume,
    references: Sequence,
    settings: Settings | None = None,
    progress: Progress | None = None,
    cancelled: Callable[[], bool] | None = None,
) -> ColorVolume:
    """Colour a grey volume after colour references.

    Args:
        volume: scalars (k, j, i); never altered.
        references: paths of colour pictures or folders, or (h, w, 3) uint8 RGB arrays. With several, each slice takes
            the one most like it.
        settings: see `Settings`.
        progress: called with the fraction done (0..1) and a short text.
        cancelled: asked between batches of slices; True raises `Cancelled`.

    Returns:
        RGB volume on the same grid, black outside the body, with a report. The colours are an illustration, not a
        measurement.

    Raises:
        InputError, SettingsError, WeightsError, DeviceError: with the remedy in the message.
        Cancelled: nothing was written.
    """
    from .engine import Engine

    run = Run(progress, cancelled)
    with run.timed("prepare"):
        run.step(0.0, "preparing")
        prepared = prepare(volume, references, settings or Settings())
    rgb = np.zeros((*volume.array.shape, 3), np.uint8)
    with run.timed("network"):
        run.step(0.02, f"loading {prepared.plan.features} features")
        engine = Engine(prepared, run)
    stack = prepared.order.view(rgb)
    painter = _color_slices(prepared, engine, stack, run)
    run.step(1.0, "done")
    report = _report(prepared, engine, run, painter)
    return ColorVolume(rgb, volume.ijk_to_ras, report, f"{volume.name} colored")


def _color_slices(prepared: Prepared, engine: Engine, stack: np.ndarray, run: Run) -> Painter:
    """Fill `stack` (slice, row, col, 3), in the order of the stack."""
    from .paint import Painter

    painter = Painter(prepared, engine, stack)
    batch = prepared.settings.batch
    waiting = list(prepared.plan.slices)
    while waiting:
        ks = _next_batch(waiting, engine.choice, prepared.repeats, batch)
        done = len(prepared.plan.slices) - len(waiting)
        run.step(0.05 + 0.94 * done / len(prepared.plan.slices), f"slice {done + 1} of {len(prepared.plan.slices)}")
        try:
            with memory_errors(engine.device):
                matches = engine.match(ks, engine.choice[ks[0]]) if ks[0] not in prepared.repeats else None
        except DeviceError:
            if batch == 1:
                raise
            batch = max(1, batch // 2)
            log.warning("device memory is short: batches of %d slices from here on", batch)
            continue
        with run.timed("colour"):
            painter.add(ks, matches)
        waiting = waiting[len(ks) :]
    return painter


def _next_batch(waiting: list[int], choice: dict[int, int], repeats: dict[int, int], batch: int) -> list[int]:
    """The next slices that go through the network together: one reference, no repeats; or one repeat by itself."""
    if waiting[0] in repeats:
        return waiting[:1]
    ks = []
    for k in waiting[:batch]:
        if k in repeats or choice[k] != choice[waiting[0]]:
            break
        ks.append(k)
    return ks


def _report(prepared: Prepared, engine: Engine, run: Run, painter: Painter) -> dict:
    from .report import environment, peak_memory_mb

    volume = prepared.volume
    used = sorted(set(engine.choice.values()))
    return {
        "notice": "Illustration: the colours are not a measurement.",
        "input": {
            "name": volume.name,
            "sha256": hashlib.sha256(np.ascontiguousarray(volume.array).data).hexdigest(),
            "shape_kji": list(volume.array.shape),
            "dtype": str(volume.array.dtype),
            "ijk_to_ras": volume.ijk_to_ras.tolist(),
            "notes": list(volume.notes),
        },
        "references": [
            {"name": r.name, "sha256": hashlib.sha256(r.rgb.tobytes()).hexdigest(), "removed_fraction": r.removed}
            for r in prepared.references
        ],
        "reference_of_slice": {str(k): prepared.references[i].name for k, i in engine.choice.items()},
        "references_assigned": engine.assigned,
        "reference_lies": {engine.references[i].name: engine.references[i].way for i in used},
        "contrast": {engine.references[i].name: engine.references[i].contrast.describe() for i in used},
        "settings": prepared.settings.to_dict(),
        "plan": prepared.plan.to_dict(),
        "searched": {str(k): v for k, v in engine.searched.items()},
        "seconds": {
            **{k: round(v, 4) for k, v in run.seconds.items()},
            "total": round(time.perf_counter() - run.started, 4),
        },
        "peak_memory_mb": peak_memory_mb(),
        "out_of_gamut_pixels": painter.clipped,
        "trusted_fraction": {str(k): v for k, v in painter.trusted.items()},
        "contrast_agreement": {str(k): v for k, v in painter.agreement.items()},
        "environment": environment(prepared.plan.device),
    }
