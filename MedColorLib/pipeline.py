"""The pipeline, stage by stage: volume -> slices -> contrast -> features -> correspondence -> colour -> volume."""

from __future__ import annotations

import hashlib
import logging
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from contextlib import contextmanager

import numpy as np

from .device import memory_errors
from .errors import Cancelled, DeviceError
from .features import CONTEXT_WEIGHTS
from .grid import to_grid
from .intensity import apply_curve, apply_window, spreading_curve
from .parameters import PRESETS, Settings
from .plan import Plan
from .prepare import Prepared, prepare, sample_slices
from .reference import Reference, on_grid
from .volume import ColorVolume, Volume

log = logging.getLogger("MedColor")

Progress = Callable[[float, str], None]


def make_plan(volume: Volume, references: Sequence, settings: Settings | None = None) -> Plan:
    """What `colorize` would do with these arguments, and what it would leave out; takes seconds at most."""
    return prepare(volume, references, settings or Settings()).plan


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
    run = _Run(progress, cancelled)
    with run.timed("prepare"):
        run.step(0.0, "preparing")
        prepared = prepare(volume, references, settings or Settings())
    rgb = np.zeros((*volume.array.shape, 3), np.uint8)
    with run.timed("network"):
        run.step(0.02, f"loading {prepared.plan.features} features")
        engine = _Engine(prepared, run)
    stack = prepared.order.view(rgb)
    painter = _color_slices(prepared, engine, stack, run)
    run.step(1.0, "done")
    report = _report(prepared, engine, run, painter)
    return ColorVolume(rgb, volume.ijk_to_ras, report, f"{volume.name} colored")


class _Run:
    """Progress, cancellation and seconds per stage of one run."""

    def __init__(self, progress: Progress | None, cancelled: Callable[[], bool] | None) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self.started = time.perf_counter()
        self._progress, self._cancelled = progress, cancelled

    def step(self, fraction: float, text: str) -> None:
        if self._cancelled is not None and self._cancelled():
            raise Cancelled
        if self._progress is not None:
            self._progress(fraction, text)

    @contextmanager
    def timed(self, stage: str):
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[stage] += time.perf_counter() - start


class _ReferenceOnGrid:
    """A reference brought to the grid, with its features computed once."""

    def __init__(self, reference: Reference, engine: _Engine) -> None:
        import torch

        self.name = reference.name
        self.grey, lab, self.mask = on_grid(reference, engine.grid)
        self.lab = torch.from_numpy(lab.astype(np.float32)).permute(2, 0, 1)[None].to(engine.device)
        self.luminance = torch.from_numpy(self.grey)[None, None].to(engine.device)
        self.features = engine.extractor.extract(self.luminance, engine.layers)
        self.mask_tensor = torch.from_numpy(self.mask).to(engine.device)
        self.contrast = None


class _Engine:
    """The network, the references' features and the contrast curves: everything that slices share."""

    def __init__(self, prepared: Prepared, run: _Run) -> None:
        from .features import make_extractor
        from .reconstruction import make_reconstruction

        self.prepared, self.run = prepared, run
        self.settings, self.grid, self.device = prepared.settings, prepared.grid, prepared.plan.device
        preset = PRESETS[self.settings.preset]
        self.stop_layer, self.uses_context = preset.stop_layer, preset.context
        self.layers = tuple(range(5, self.stop_layer - 1, -1))
        self.extractor = make_extractor(prepared.plan.features, self.device)
        self.reconstruct = make_reconstruction(self.settings.reconstruction, self.extractor)
        self.references = [_ReferenceOnGrid(r, self) for r in prepared.references]
        self.choice = self._choose_references()
        self.guide_curve = self._spread_guide() if prepared.plan.smoother == "regression" else None
        with run.timed("contrast"):
            for index in sorted(set(self.choice.values())):
                self._learn_contrast(index)

    def slice_on_grid(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Display grey and body mask (H, W) of slice k on the grid."""
        grey, cover = self.slice_in_box(k)
        mask = to_grid(cover, self.grid) > 0.5
        return to_grid(grey * (cover > 0.5), self.grid) * mask, mask

    def slice_in_box(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Display grey (rows, cols) and body coverage 0..1 of slice k, cut to the body's box, at full resolution."""
        j0, j1, i0, i1 = self.prepared.body.boxes[k]
        grey = apply_window(self.prepared.view[k, j0:j1, i0:i1], self.prepared.window)
        return grey, self.prepared.body.plane(k)[j0:j1, i0:i1]

    def match(self, ks: Sequence[int], index: int):
        """Match slices `ks` with reference `index`.

        Returns:
            greys and masks (N, H, W) on the grid, matched colours T' (N, H, W, 3) L*a*b*, and the trust in each slice (None
            where nothing reads it).
        """
        import torch

        from .analogy import Context, deep_image_analogy
        from .vote import matched_colors

        reads_trust = self.prepared.plan.smoother == "regression"

        reference = self.references[index]
        greys, masks = (np.stack(parts) for parts in zip(*(self.slice_on_grid(k) for k in ks)))
        matched = apply_curve(greys, reference.contrast.curve) * masks
        luminance = torch.from_numpy(matched)[:, None].to(self.device)
        with self.run.timed("features"):
            features = self.extractor.extract(luminance, self.layers)
        context = None
        if self.uses_context:
            position, grey = CONTEXT_WEIGHTS[self.extractor.name]
            context = Context(position, grey * reference.contrast.trust, luminance, reference.luminance)
        with self.run.timed("matching"):
            found = deep_image_analogy(
                features,
                reference.features,
                torch.from_numpy(masks).to(self.device),
                reference.mask_tensor,
                self.stop_layer,
                context,
                self.reconstruct,
                seed=self.settings.seed,
                keep_reverse=reads_trust,
            )
            self.searched = found.searched
            lab = matched_colors(found.field, found.layer, reference.lab)
        lab = lab.permute(0, 2, 3, 1).float().cpu().numpy()
        trusts = self._trusts(found, reference, matched, masks, lab) if reads_trust else [None] * len(ks)
        return greys, masks, lab, trusts

    def _trusts(self, found, reference, matched, masks, lab) -> list:
        from .color.lab import lightness_to_gray
        from .confidence import consistency, on_full_grid, trust_of

        home = on_full_grid(consistency(found.field, found.reverse), masks.shape[1:]).cpu().numpy() * masks
        seen = np.clip(lightness_to_gray(lab[..., 0].astype(np.float64)), 0, 1)
        inverse = reference.contrast.inverse
        return [trust_of(*planes, inverse) for planes in zip(home, matched, seen)]

    def _spread_guide(self) -> np.ndarray:
        boxes = [self.slice_in_box(k) for k in sample_slices(self.prepared.plan.slices)]
        return spreading_curve(np.concatenate([grey[cover > 0.5] for grey, cover in boxes]))

    def _learn_contrast(self, index: int) -> None:
        import torch

        from .analogy import deep_image_analogy
        from .contrast import match_contrast

        reference = self.references[index]
        own = [k for k, chosen in self.choice.items() if chosen == index]
        greys, masks = (np.stack(parts) for parts in zip(*(self.slice_on_grid(k) for k in sample_slices(own))))
        mask_tensor = torch.from_numpy(masks).to(self.device)

        def coarse_similarity(candidate: np.ndarray) -> float:
            features = self.extractor.extract(torch.from_numpy(candidate)[:, None].to(self.device), (5,))
            found = deep_image_analogy(features, reference.features, mask_tensor, reference.mask_tensor, 5)
            inside = torch.nn.functional.adaptive_avg_pool2d(mask_tensor.float(), found.similarity.shape[1:]) > 0.5
            return float(found.similarity[inside].mean()) if inside.any() else 0.0

        reference.contrast = match_contrast(greys, masks, reference.grey, reference.mask, coarse_similarity)
        log.info("contrast for %s: %s", reference.name, reference.contrast.describe())

    def _choose_references(self) -> dict[int, int]:
        """Slice -> index of its reference: the only one, or the one whose descriptor is nearest (cosine)."""
        slices = self.prepared.plan.slices
        if len(self.references) == 1:
            return dict.fromkeys(slices, 0)
        import torch

        with self.run.timed("recommendation"):
            library = torch.cat([self.extractor.descriptor(r.luminance) for r in self.references]).float()
            library = library / library.norm(dim=1, keepdim=True).clamp_min(1e-12)
            choice = {}
            for k in slices:
                plane = torch.from_numpy(self.slice_on_grid(k)[0])[None, None].to(self.device)
                choice[k] = int((library @ self.extractor.descriptor(plane).float()[0]).argmax())
        return choice


def _color_slices(prepared: Prepared, engine: _Engine, stack: np.ndarray, run: _Run) -> _Painter:
    """Fill `stack` (slice, row, col, 3), in the order of the stack."""
    painter = _Painter(prepared, engine, stack)
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


class _Painter:
    """Colours slices from their matches; with the regression, from the evidence of their neighbours, too."""

    def __init__(self, prepared: Prepared, engine: _Engine, stack: np.ndarray) -> None:
        from .coherence import SliceAverage
        from .transfer import TransferParameters

        settings, plan = prepared.settings, prepared.plan
        self.clipped = 0
        self.trusted: dict[int, float] = {}
        self.agreement: dict[int, float] = {}
        self._engine, self._stack, self._boxes = engine, stack, prepared.body.boxes
        self._parameters = TransferParameters(
            plan.smoother, settings.luminance, settings.resolved_gamma, engine.guide_curve
        )
        self._average = SliceAverage(plan.slices, prepared.slice_spacing_mm, settings.coherence_mm)
        self._last = None

    def add(self, ks: Sequence[int], matches) -> None:
        """Colour what can be coloured now that slices `ks` are matched; None: the same match as the slice before."""
        if matches is not None:
            self._last = [(grey, mask, lab, trust) for grey, mask, lab, trust in zip(*matches)]
        for n, k in enumerate(ks):
            grey, mask, lab, trust = self._last[n] if matches is not None else self._last[-1]
            if self._parameters.smoother == "regression":
                self._add_evidence(k, grey, mask, lab, trust)
            else:
                self._color_alone(k, grey, mask, lab)

    def _add_evidence(self, k, grid_grey, grid_mask, lab, trust) -> None:
        from .transfer import evidence, to_picture, transfer_evidence

        self.trusted[k], self.agreement[k] = round(trust.trusted_fraction, 4), round(trust.agreement, 4)
        sums = evidence(lab, grid_grey, grid_mask, self._parameters, trust)
        for ready, total in self._average.push(k, sums):
            grey, cover = self._engine.slice_in_box(ready)
            mask = cover > 0.5
            self._put(ready, *to_picture(transfer_evidence(grey, mask, total, self._parameters), mask))

    def _color_alone(self, k, grid_grey, grid_mask, lab) -> None:
        from .transfer import transfer

        grey, cover = self._engine.slice_in_box(k)
        self._put(k, *transfer(grey, cover > 0.5, lab, grid_grey, grid_mask, self._parameters))

    def _put(self, k: int, rgb: np.ndarray, clipped: int) -> None:
        j0, j1, i0, i1 = self._boxes[k]
        self._stack[k, j0:j1, i0:i1] = rgb
        self.clipped += clipped


def _report(prepared: Prepared, engine: _Engine, run: _Run, painter: _Painter) -> dict:
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
