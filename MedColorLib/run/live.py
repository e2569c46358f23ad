"""Slices coloured as they are looked at: what takes time is kept, so that only the last stage is done again.

At draft quality, with MedColor's own features and the regression, each slice by itself. A transverse slice is matched and
painted as in a run. Slices across the stack have no photograph of their own: their colour is read, pixel by pixel, from what
the nearest transverse slices said of place and grey (`filters.regression`). After another lightness only the painting is new;
after another exposure the matches stay, since the own features see no contrast.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple, cast

import numpy as np

from ..parameters import Settings
from ..progress import Run
from ..volume import Volume
from .engine import Engine, ReferenceOnGrid
from .prepare import prepare
from .timepoints import KeptMatches

if TYPE_CHECKING:
    from ..coloring.transfer import SliceMatch
    from ..matching.tissue_guard import Guard
    from .resume import RunStore

STEP_MM = 4.0  # between the transverse slices that slices across the stack are coloured from
MOST_SLICES = 96  # of those
ASKED = 4  # slices that are asked what grey means, anew after a change of exposure; a run asks sixteen


@dataclass(frozen=True)
class Look:
    """What may change from picture to picture. lightness, exposure: as in `Settings`."""

    lightness: float = Settings.lightness
    exposure: str | float = Settings.exposure


class Evidence(NamedTuple):
    """What one transverse slice says of colour; see `coloring.transfer`.

    Attributes:
        relation, rest: by tissue group that the slice has, or of None, all of it, without a guard.
        kept: 0..1, the share of its colour that it keeps. trusted: 0..1, the share of its matches that can be trusted.
    """

    relation: dict[int | None, np.ndarray]
    rest: dict[int | None, np.ndarray]
    kept: float
    trusted: float


class LiveSlices:
    """Colours of single slices of a volume, along any axis of its array.

    >>> from MedColorLib.phantom import sample
    >>> volume, picture = sample()
    >>> live = LiveSlices(volume, [picture])
    >>> live.plane(0, 24).shape, live.plane(2, 50, Look(lightness=0.5)).shape
    ((128, 112, 3), (48, 128, 3))
    """

    def __init__(
        self,
        volume: Volume,
        references: Sequence,
        settings: Settings | None = None,
        cancelled: Callable[[], bool] | None = None,
        guard: Guard | None = None,
    ) -> None:
        """Args as for `pipeline.colorize`; what `live_settings` changes in the settings is not used.

        Raises:
            As `colorize`.
        """
        self.cancelled = cancelled  # may be exchanged between two slices
        self._run = Run(None, lambda: bool(self.cancelled and self.cancelled()))
        self._sources = references
        self._settings = live_settings(settings or Settings())
        self._run.step(0.0, "preparing")
        with self._run.timed("prepare"):
            self._prepared = prepare(volume, references, self._settings, guard=guard)
        self._groups = self._prepared.groups
        self._view = self._prepared.order.view(volume.array)
        self._run.step(0.0, "features")
        self._engine = Engine(self._prepared, self._run, cast("RunStore", KeptMatches()))
        self._engine.learn_elsewhere()
        self._plain: Sequence | None = None  # the references as they are, once an exposure was changed
        self._exposure: str | float | None = self._settings.exposure
        self._evidence: dict[int, Evidence] = {}
        self._smooth: dict[int | None, tuple[list[int], np.ndarray]] | None = None

    def plane(self, axis: int, index: int, look: Look | None = None) -> np.ndarray:
        """One slice in colour.

        Args:
            axis: of the volume's array (k, j, i), 0, 1 or 2, along which the slice is the index-th.

        Returns:
            uint8 sRGB with the other two axes of the array, in their order, and (red, green, blue); black outside the body.

        Raises:
            Cancelled
        """
        look = look or Look()
        self._expose(look.exposure)
        order = self._prepared.order
        seen = order.axes.index(axis)
        number = self._view.shape[seen] - 1 - index if order.flips[seen] else index
        rgb = self._transverse(number, look) if seen == 0 else self._across(seen, number, look)
        left = [n for n in range(3) if n != seen]
        rgb = rgb[tuple(slice(None, None, -1 if order.flips[n] else 1) for n in left)]
        return rgb if order.axes[left[0]] < order.axes[left[1]] else rgb.swapaxes(0, 1)

    def _expose(self, exposure: str | float) -> None:
        """Bring the references into another exposure, and learn anew what their grey means."""
        if exposure == self._exposure:
            return
        from ..references.exposure import expose
        from ..references.loading import load_references

        if self._plain is None:
            self._plain = load_references(self._sources, "off", self._settings.reference_masks)
        self._evidence.clear()
        self._smooth = None
        self._exposure = None  # should it be cancelled half way
        for n, reference in enumerate(expose(self._plain, exposure)):
            self._run.step(0.0, "exposure")
            self._exchange(n, reference)
        self._engine.forget_colors()
        self._engine.learn_elsewhere(None if exposure == self._settings.exposure else ASKED)
        self._exposure = exposure

    def _exchange(self, n: int, reference) -> None:
        """The same photograph in another exposure: it lies as before, and its features stay."""
        engine = self._engine
        new = ReferenceOnGrid(reference, engine.grid, self._groups.pictures[n] if self._groups else None)
        new.turn(engine.references[n].lie)
        engine.references[n] = new
        if n in engine.choice.values():
            engine._learn_contrast(n)

    def _of_slice(self, k: int) -> Evidence:
        """Match a transverse slice, or take what is known of it."""
        if k not in self._evidence:
            from ..coloring.transfer import SliceMatch, relation_sums, remainder, solve_relation
            from ..matching.confidence import saturation

            self._run.step(0.0, "matching")
            greys, masks, lab, trusts = self._engine.match([k], self._engine.choice[k])
            match, trusted = SliceMatch(lab[0], greys[0], masks[0], trusts[0]), trusts[0].trusted_fraction
            parameters = self._engine.transfer_parameters(trusted_fraction=trusted)
            own = Evidence({}, {}, saturation(float(trusts[0].mean)), trusted)
            for name, part in self._by_group(k, match).items():
                own.relation[name] = solve_relation(relation_sums(part, parameters), parameters)
                own.rest[name] = remainder(part, own.relation[name], parameters)
            self._evidence[k] = own
        return self._evidence[k]

    def _by_group(self, k: int, match: SliceMatch) -> dict[int | None, SliceMatch]:
        """A slice's match for each group that it has, with nothing outside it."""
        if self._groups is None:
            return {None: match}
        there = np.unique(self._groups.in_box(k, self._prepared.body.boxes[k]))
        on_grid = self._engine.groups_on_grid([k])[0]
        return {int(name): replace(match, mask=match.mask & (on_grid == name)) for name in there}

    def _transverse(self, k: int, look: Look) -> np.ndarray:
        from ..coloring.transfer import combine, to_picture

        out = np.zeros((*self._view.shape[1:], 3), np.uint8)
        if k not in self._engine.choice:
            return out
        own = self._of_slice(k)
        grey, mask = self._engine.slice_in_box(k)[0], self._engine.painted_in_box(k)
        parameters = self._engine.transfer_parameters(look.lightness, own.trusted)
        box = self._prepared.body.boxes[k]
        groups = None if self._groups is None else self._groups.in_box(k, box)
        lab = np.zeros((np.count_nonzero(mask), 3))
        for name, relation in own.relation.items():
            inside = mask if groups is None else mask & (groups == name)
            if inside.any():
                lab[inside[mask]] = combine(grey, inside, relation, own.rest[name], parameters, saturation=own.kept)
        j0, j1, i0, i1 = box
        out[j0:j1, i0:i1] = to_picture(lab, mask)[0]
        return self._in_region(out, 0)

    def _across(self, seen: int, number: int, look: Look) -> np.ndarray:
        """(slice, column or row, 3): a slice at a row (seen 1) or a column (seen 2) of the stack."""
        from ..coloring.natural import without_noise
        from ..coloring.transfer import colors_of, to_picture
        from ..scan.intensity import apply_window

        parameters = self._engine.transfer_parameters(look.lightness)
        values = np.take(self._view, number, axis=seen)
        window = self._prepared.window
        grey, mask = window.tone(apply_window(values, window)), self._body_across(seen, number, values)
        out = np.zeros((*values.shape, 3), np.uint8)
        if not mask.any():
            return out
        read = without_noise(grey) if parameters.luminance == "natural" else grey
        groups, left = self._groups_across(seen, number), mask.copy()
        kept = float(np.mean([self._of_slice(k).kept for k in self._witnesses()]))
        lab = np.zeros((*read.shape, 3), np.float32)
        for name, (witnesses, relations) in self._relations().items():
            inside = mask if groups is None else mask & (groups == name)
            if inside.any():  # a group's detail is its own, as in a run
                guess = self._guess(seen, number, read, parameters, witnesses, relations, inside.any(axis=1))
                lab[inside] = colors_of(grey, inside, guess, parameters, kept)
                left &= ~inside
        if left.any():
            nothing = np.zeros((*read.shape, 3 if parameters.luminance == "natural" else 2), np.float32)
            lab[left] = colors_of(grey, left, nothing, parameters, kept)
        out[mask] = to_picture(lab[mask], mask)[0][mask]
        return self._in_region(out, seen)

    def _groups_across(self, seen: int, number: int) -> np.ndarray | None:
        """Tissue groups of the pixels of a slice across the stack."""
        if self._groups is None:
            return None
        labels = self._prepared.order.view(self._groups.guard.labels.array)
        return self._groups.table[np.take(labels, number, axis=seen).astype(np.intp)]

    def _guess(
        self, seen: int, number: int, read: np.ndarray, parameters, witnesses, relations, wanted: np.ndarray
    ) -> np.ndarray:
        """What the transverse slices around, or those of them that have a group, say of each pixel of the wanted lines."""
        from ..coloring.transfer import spread_guide
        from ..filters.regression import predict_at

        boxes = self._prepared.body.boxes
        guide = spread_guide(read, parameters)
        change = np.zeros((*read.shape, relations.shape[-1]), np.float32)
        for n in range(len(witnesses)):
            share = _shares(witnesses, n, len(read)) * (boxes[:, 1] > boxes[:, 0]) * wanted
            lines = np.flatnonzero(share)
            if not lines.size:
                continue
            low, high = boxes[lines][:, [0, 2]].T, boxes[lines][:, [1, 3]].T
            fixed = ((number + 0.5 - low[seen - 1]) / (high[seen - 1] - low[seen - 1]))[:, None]
            other = 2 - seen
            moving = (np.arange(read.shape[1]) + 0.5 - low[other][:, None]) / (high[other] - low[other])[:, None]
            place = (fixed, moving) if seen == 1 else (moving, fixed)
            change[lines] += predict_at(relations[n], *place, guide[lines]) * share[lines, None, None]
        return change

    def _relations(self) -> dict[int | None, tuple[list[int], np.ndarray]]:
        """Of each group the witnesses that have it, and (witness, ...) what they say, averaged along the stack as in a run."""
        if self._smooth is None:
            from scipy.ndimage import gaussian_filter1d

            found: dict[int | None, dict[int, np.ndarray]] = {}
            for k in self._witnesses():
                for name, relation in self._of_slice(k).relation.items():
                    found.setdefault(name, {})[k] = relation
            smooth = {}
            for name, of in found.items():
                apart = np.diff(list(of)).mean() if len(of) > 1 else 1.0
                sigma = self._settings.coherence_mm / max(apart * self._prepared.slice_spacing_mm, 1e-6)
                own = np.stack(list(of.values()))
                smooth[name] = list(of), gaussian_filter1d(own, sigma, axis=0, mode="nearest") if sigma > 0 else own
            self._smooth = smooth
        return self._smooth

    def _witnesses(self) -> list[int]:
        """Transverse slices spread along the stack."""
        chosen = sorted(self._engine.choice)
        step = max(1, round(STEP_MM / max(self._prepared.slice_spacing_mm, 1e-6)), -(-len(chosen) // MOST_SLICES))
        return chosen[step // 2 :: step] or chosen[:1]

    def _body_across(self, seen: int, number: int, values: np.ndarray) -> np.ndarray:
        """`Body.painted` of a slice across the stack; only the slices that a run would colour."""
        import cv2

        body, chosen = self._prepared.body, np.zeros((len(values), 1), bool)
        chosen[list(self._engine.choice)] = True
        if body.given is not None:
            return (np.take(body.given, number, axis=seen) != 0) & chosen
        size = body.coarse.shape[seen]
        at = min(int((number + 0.5) * size / self._view.shape[seen]), size - 1)
        own = np.take(body.coarse, at, axis=seen).astype(np.uint8)
        beside = np.take(body.coarse, range(max(at - 1, 0), min(at + 2, size)), axis=seen)
        wide = cv2.dilate(np.asarray(beside.any(axis=seen), np.uint8), np.ones((3, 3), np.uint8))
        cover, rim = (
            cv2.resize(plane.astype(np.float32), values.shape[::-1], interpolation=cv2.INTER_LINEAR) > 0.5
            for plane in (own, wide)
        )
        return (cover | (rim & (values > body.threshold))) & chosen

    def _in_region(self, rgb: np.ndarray, seen: int) -> np.ndarray:
        """Black outside the region that was asked for."""
        ranges = [ends for n, ends in enumerate(self._prepared.region) if n != seen]
        inside = np.zeros(rgb.shape[:2], bool)
        inside[tuple(slice(*ends) for ends in ranges)] = True
        rgb[~inside] = 0
        return rgb


def live_settings(settings: Settings) -> Settings:
    """What live slices use of settings: the same for all that differ only in what they leave aside."""
    own = settings.resolved_smoother == "regression"
    return replace(
        settings,
        preset="draft",
        features="embedded",
        smoother="regression",
        smoother_options=settings.smoother_options if own else None,
        slices=None,
        confidence=False,
        reconstruction="warp",
    )


def _shares(witnesses: Sequence[int], n: int, count: int) -> np.ndarray:
    """(count,) float32: how much witness n says of each slice: linear between two of them, the ends continued."""
    one = np.zeros(len(witnesses), np.float32)
    one[n] = 1.0
    return np.interp(np.arange(count), witnesses, one).astype(np.float32)
