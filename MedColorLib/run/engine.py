"""The engine of a run: network, references on the grid, contrast curves; matches batches of slices."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from ..device import one_thread
from ..features import CONTEXT_WEIGHTS, unit_descriptors
from ..features.components import PROJECTED_LAYERS, kept_energy, principal_components, project
from ..features.kept import reference_features
from ..matching.analogy import joined
from ..matching.assignment import assign
from ..parameters import PRESETS
from ..progress import Run
from ..scan.intensity import apply_curve, spreading_curve
from ..scan.slices import sample_slices, slice_in_box, slice_on_grid
from .doubts import reference_warnings
from .on_grid import ReferenceFeatures, ReferenceOnGrid, WithinGroups
from .orient import turn_references
from .prepare import Prepared

if TYPE_CHECKING:
    from torch import Tensor

    from ..coloring.transfer import TransferParameters
    from ..device import Each
    from ..matching.analogy import Match
    from .resume import RunStore

log = logging.getLogger("MedColorLib")

UNVOTED_TRUST = 1e-3  # of a group's mean colour, where the guard left no match: a fiftieth of the least trusted match
OWN_LAYER = 3  # whose raster is that of MedColor's own features: positions of 4 x 4 pixels
TELLING_SLICES, TELLING_PX = 24, 64  # of the whole scan, of a side: in them grey is asked how far it tells tissue
TINTING_REFERENCES = 24  # of many, so many are asked how hue goes with lightness


class Engine:
    """The network, the references' features and the contrast curves: everything that slices share."""

    def __init__(self, prepared: Prepared, run: Run, store: RunStore | None = None, each: Each = map) -> None:
        """Args:
        each: how slices are matched that do not depend on each other; see `device.side_by_side`.
        """
        from ..features import make_extractor
        from ..matching.reconstruction import make_reconstruction

        self.prepared, self.run, self.store = prepared, run, store
        self.each = each
        self.settings, self.grid, self.device = prepared.settings, prepared.grid, prepared.plan.device
        preset = PRESETS[self.settings.preset]
        self.stop_layer, self.uses_context = preset.stop_layer, preset.context
        self.components = self.settings.components
        self.own_features = prepared.plan.features == "embedded"
        # each slice on a thread of its own; a large network takes them together
        self.apart = self.own_features and self.device == "cpu"
        self.layers = (OWN_LAYER,) if self.own_features else tuple(range(5, self.stop_layer - 1, -1))
        self.extractor = make_extractor(prepared.plan.features, self.device)
        self.reconstruct = make_reconstruction(self.settings.reconstruction, self.extractor)
        pictures = prepared.groups.pictures if prepared.groups else (None,) * len(prepared.references)
        self.references = [ReferenceOnGrid(r, self.grid, own) for r, own in zip(prepared.references, pictures)]
        self.unmatched: dict[int, float] = {}
        self._features: dict[int, ReferenceFeatures] = {}
        self.kept: dict[int, bool] = {}
        # (slice, reference) -> its match, made before its turn; where the contrast was learned, without its colours
        self._ahead: dict[tuple[int, int], tuple] = {}
        self._found: dict[tuple[int, int], Match] = {}
        self.elsewhere: np.ndarray | None = None
        self.asked = 0  # slices, for `elsewhere`
        self.energy: dict[int, dict[int, float]] = {}  # reference -> layer -> share of the features in their components
        with run.timed("orientation"), one_thread():  # small arrays: what can go side by side goes through `each`
            self._turn_references()
        self.choice = self._choose_references()
        self.reference_warnings = reference_warnings(prepared, self.references, self.choice)
        self.guide_curve = self._spread_guide() if prepared.plan.smoother == "regression" else None
        with run.timed("contrast"):
            for index in sorted(set(self.choice.values())):
                self._learn_contrast(index)

    def slice_on_grid(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Display grey and body mask (H, W) of slice k on the grid."""
        prepared = self.prepared
        return slice_on_grid(prepared.view, prepared.body, prepared.window, self.grid, k)

    def groups_on_grid(self, ks: Sequence[int]) -> np.ndarray:
        """(N, H, W) uint8 tissue groups of slices on the grid; only with a guard."""
        boxes = self.prepared.body.boxes
        return np.stack([self.prepared.groups.on_grid(k, boxes[k], self.grid) for k in ks])

    def slice_in_box(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Display grey (rows, cols) and body coverage 0..1 of slice k, cut to the body's box, at full resolution."""
        return slice_in_box(self.prepared.view, self.prepared.body, self.prepared.window, k)

    def features_of(self, index: int) -> ReferenceFeatures:
        """Features of a reference, computed once for all slices; of several references the last two are kept."""
        import torch

        if index not in self._features:
            while len(self._features) >= 2:
                del self._features[next(iter(self._features))]
            reference = self.references[index]
            luminance = torch.from_numpy(reference.grey)[None, None].to(self.device)
            layers, self.kept[index] = reference_features(self.extractor, luminance, self.layers)
            bases = self._bases(layers)
            self.energy[index] = {layer: kept_energy(layers[layer], basis) for layer, basis in bases.items()}
            layers = {layer: project(values, bases.get(layer)) for layer, values in layers.items()}
            mask = torch.from_numpy(reference.mask).to(self.device)
            self._features[index] = ReferenceFeatures(layers, bases, luminance, mask)
        return self._features[index]

    def _bases(self, layers: dict) -> dict:
        """Layer -> basis on which its features are compared, for layers that have more channels."""
        if self.components is None:
            return {}
        wanted = [n for n in layers if n in PROJECTED_LAYERS and layers[n].shape[1] > self.components]
        return {layer: principal_components(layers[layer], self.components) for layer in wanted}

    def painted_in_box(self, k: int) -> np.ndarray:
        """(rows, cols) bool: where slice k is coloured, cut to the body's box."""
        j0, j1, i0, i1 = self.prepared.body.boxes[k]
        return self.prepared.body.painted(k, self.prepared.view[k])[j0:j1, i0:i1]

    def forget_features(self) -> None:
        """Make the references' features anew at the next match, for example after `layers` has been changed."""
        self._features.clear()

    def slices_on_grid(self, ks: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """`slice_on_grid` of several slices: greys, masks (N, H, W)."""
        greys, masks = zip(*(self.slice_on_grid(k) for k in ks))
        return np.stack(greys), np.stack(masks)

    def match(self, ks: Sequence[int], index: int):
        """Match slices `ks` with reference `index`, or take up what an interrupted run kept in `store`.

        Returns:
            greys and masks (N, H, W) on the grid, matched colours T' (N, H, W, 3) L*a*b*, and the trust in each slice (None
            where nothing reads it).
        """
        self.features_of(index)  # before slices are matched side by side
        store = self.store
        stored = store.load(ks, index, self.device) if store else None
        parts = [[k] for k in ks] if self.apart else [ks]
        known = [None] * len(parts) if stored is None else stored.parts() if self.apart else [stored]
        with self.run.shared_out():
            done = (self.each if self.apart else map)(self._match_part, parts, [index] * len(parts), known)
            found, greys, masks, labs, trusts = zip(*done)
        if store and not stored:
            store.save(ks, index, joined(found))
        self.searched = found[0].searched
        return np.concatenate(greys), np.concatenate(masks), np.concatenate(labs), [t for part in trusts for t in part]

    def match_ahead(self, ks: Sequence[int], index: int) -> list[tuple]:
        """`match` of each of these slices alone, before its turn; in its turn those that are to be coloured come from here."""
        self.features_of(index)
        store = None if self.store is None or self.store.by_batch else self.store
        stored = [store.load([k], index, self.device) if store else None for k in ks]
        with self.run.shared_out():
            each = self.each if self.apart else map
            done = list(each(self._match_part, [[k] for k in ks], [index] * len(ks), stored))
        for k, (found, *_) in zip(ks, done):
            if store:
                store.save([k], index, found)
        if self.apart:
            self._ahead |= {(k, index): one for k, one in zip(ks, done) if self.choice.get(k) == index}
        return [rest for _, *rest in done]

    @property
    def reads_trust(self) -> bool:
        """Whether anything reads how far matches can be trusted."""
        return self.settings.weighs_matches or self.settings.confidence

    def _match_part(self, ks: Sequence[int], index: int, stored: Match | None) -> tuple:
        """The match of some slices, and what `match` returns; on a thread of its own where slices are matched side by side."""
        from ..matching.vote import matched_colors

        if len(ks) == 1 and (ahead := self._ahead.pop((ks[0], index), None)):
            return ahead  # once: a slice has one turn
        reference = self.references[index]
        with self.run.timed("matching"):
            greys, masks = self.slices_on_grid(ks)
            matched = apply_curve(greys, reference.contrast.curve) * masks
        within = None if reference.groups is None else self._within(ks, index, masks)
        known = self._found.pop((ks[0], index), None)
        found = stored or self._correspondence(index, greys * masks, matched, masks, within, known)
        with self.run.timed("matching"):
            own_lab = self._on_device(reference.lab)
            if within is None:
                lab = matched_colors(found.field, found.layer, own_lab)
            else:
                lab, voted = within.colors(found, own_lab)
            lab = lab.permute(0, 2, 3, 1).float().cpu().numpy()
            unvoted = None
            if within is not None:
                unvoted = masks & ~voted.cpu().numpy()
                lab = within.completed(lab, unvoted)
                for k, mask, without in zip(ks, masks, unvoted):
                    self.unmatched[k] = max(self.unmatched.get(k, 0.0), float(without.sum() / max(mask.sum(), 1)))
            trusts = [None] * len(ks)
            if self.reads_trust:
                trusts = self._trusts(found, reference, matched, masks, greys, lab, unvoted)
        return found, greys, masks, lab, trusts

    def _on_device(self, lab: np.ndarray) -> Tensor:
        """(H, W, 3) -> (1, 3, H, W) float32."""
        import torch

        return torch.from_numpy(lab.astype(np.float32)).permute(2, 0, 1)[None].to(self.device)

    def _within(self, ks: Sequence[int], index: int, masks: np.ndarray) -> WithinGroups:
        """How slices and reference `index` are kept inside the groups of the guard."""
        groups, reference = self.prepared.groups, self.references[index]
        own = self.groups_on_grid(ks)
        return WithinGroups(own, masks, reference, groups.missing[index], len(groups), self.device)

    def _correspondence(self, index: int, greys, matched, masks, within: WithinGroups | None, known=None) -> Match:
        """The correspondence of slices (N, H, W), in the photograph's contrast where the features see contrast, unless known."""
        if self.own_features:
            return known or self._own_match(index, greys, masks, within and within.channels())
        return self._analogy(index, matched, masks, within)

    def _own_match(self, index: int, greys: np.ndarray, masks: np.ndarray, groups=None) -> Match:
        """By MedColor's own features: one exhaustive search, both ways."""
        import torch

        from ..matching.analogy import Match
        from ..matching.contrast_match import match

        own = self.features_of(index)
        with self.run.timed("features"):
            features = self.extractor.extract(torch.from_numpy(greys)[:, None].to(self.device), (OWN_LAYER,))[OWN_LAYER]
        with self.run.timed("matching"):
            inside = torch.from_numpy(masks).to(self.device), own.mask
            found = match(features, own.layers[OWN_LAYER], *inside, keep_reverse=self.reads_trust, groups=groups)
        return Match(OWN_LAYER, found.field, found.similarity, found.reverse, {OWN_LAYER: "exact"}, found.likeness)

    def _analogy(self, index: int, matched: np.ndarray, masks: np.ndarray, within: WithinGroups | None = None) -> Match:
        """The correspondence of slices (N, H, W) in the photograph's contrast with reference `index`."""
        import torch

        from ..matching.analogy import Context, deep_image_analogy

        reference, own = self.references[index], self.features_of(index)
        luminance = torch.from_numpy(matched)[:, None].to(self.device)
        with self.run.timed("features"):
            features = self.extractor.extract(luminance, self.layers)
            features = {layer: project(values, own.bases.get(layer)) for layer, values in features.items()}
        context = None
        if self.uses_context:
            position, grey = CONTEXT_WEIGHTS[self.extractor.name]
            context = Context(position, grey * reference.contrast.trust, luminance, own.luminance)
        if within is not None:
            context = replace(context or Context(0.0, 0.0, None, None), groups=within.channels())
        with self.run.timed("matching"):
            return deep_image_analogy(
                features,
                own.layers,
                torch.from_numpy(masks).to(self.device),
                own.mask,
                self.stop_layer,
                context,
                self.reconstruct,
                seed=self.settings.seed,
                keep_reverse=self.reads_trust,
            )

    def _trusts(self, found, reference, matched, masks, greys, lab, unvoted=None) -> list:
        from ..color.lab import lightness_to_gray
        from ..matching.confidence import LEAST_TRUST, LIKENESS_RANGE, consistency, in_range, on_full_grid, trust_of

        home = on_full_grid(consistency(found.field, found.reverse), masks.shape[1:])
        alike = on_full_grid(in_range(found.likeness, *LIKENESS_RANGE[self.extractor.name]), masks.shape[1:])
        confidence = (home * alike + LEAST_TRUST).cpu().numpy() * masks
        if reference.usual is not None:
            confidence *= reference.usual.share(greys, lab)
        if unvoted is not None:
            confidence[unvoted] = UNVOTED_TRUST
        seen = np.clip(lightness_to_gray(lab[..., 0].astype(np.float64)), 0, 1)
        relation = reference.contrast.inverse, reference.contrast.monotone
        return [trust_of(*planes, *relation) for planes in zip(confidence, matched, seen)]

    def _turn_references(self) -> None:
        turn_references(self.prepared, self.references, self.slices_on_grid, self.each)

    @cached_property
    def grey_tells(self) -> float:
        """0..1, how far grey tells tissue in this scan, whichever slices are asked for; see `usual.grey_tells_tissue`."""
        from ..matching.usual import grey_tells_tissue

        inside = []
        for k in sample_slices([int(k) for k in self.prepared.body.slices], TELLING_SLICES):
            grey, cover = self.slice_in_box(k)
            few = np.s_[:: max(1, len(grey) // TELLING_PX), :: max(1, grey.shape[1] // TELLING_PX)]
            inside.append(grey[few][cover[few] > 0.5])
        return grey_tells_tissue(np.concatenate(inside))

    def transfer_parameters(self, lightness: float | None = None, trusted_fraction: float = 1.0) -> TransferParameters:
        """How colours are brought onto slices of this scan.

        Args:
            lightness: instead of the settings'. trusted_fraction: of the slice's matches, 0..1.
        """
        from ..coloring.transfer import TransferParameters

        settings = self.settings
        return TransferParameters(
            self.prepared.plan.smoother,
            settings.luminance,
            settings.resolved_gamma,
            self.guide_curve,
            self.smoother_options,
            settings.lightness if lightness is None else lightness,
            self.one_tissue(trusted_fraction),
            self._own_relation,
            self.tints if settings.luminance == "natural" and not settings.resolved_gamma else None,
            self.elsewhere,
            self.prepared.window,
        )

    def learn_elsewhere(self, count: int | None = None) -> None:
        """Ask slices all over the scan, at most so many, how colour goes with grey; see `elsewhere`."""
        from .elsewhere import SLICES, relation_elsewhere

        with self.run.timed("contrast"):
            self.elsewhere = None  # what is asked is asked without it
            self.elsewhere, self.asked = relation_elsewhere(self, count or SLICES)
        if self.asked:
            log.info("what grey means was asked of %d slices all over the scan", self.asked)

    def forget_colors(self) -> None:
        """After another exposure: what was learned of the references' colours is not true any more."""
        self._ahead.clear()
        self.__dict__.pop("tints", None)

    @cached_property
    def tints(self) -> np.ndarray:
        """Of the references in use together, so that they do not change along the stack."""
        from ..coloring.tints import tints_of

        used = sample_slices(sorted(set(self.choice.values())), TINTING_REFERENCES)
        return tints_of([self.references[index].lab[self.references[index].mask] for index in used])

    @property
    def smoother_options(self) -> dict | None:
        """The settings' options, and for the regression of own matches the support that they ask for."""
        from ..matching.usual import support_px

        options = self.settings.smoother_options or {}
        if not self._own_relation or "support_px" in options:
            return self.settings.smoother_options
        return {**options, "support_px": round(support_px(self.grey_tells, self._contrast_trust), 1)}

    def one_tissue(self, trusted_fraction: float, told: bool | None = None) -> float:
        """How far a grey is taken for one tissue; measured for the own features alone.

        Args:
            told: as of `usual.one_tissue_share`; None: whether `elsewhere` is known.
        """
        from ..matching.usual import one_tissue_share

        if not self._own_relation:
            return 0.0
        told = self.elsewhere is not None if told is None else told
        return one_tissue_share(self.grey_tells, self._contrast_trust, trusted_fraction, told)

    @property
    def _own_relation(self) -> bool:
        """Whether colour is a function of place and grey that is learned from matches of the own features."""
        return self.own_features and self.prepared.plan.smoother == "regression"

    @property
    def _contrast_trust(self) -> float:
        return float(np.mean([self.references[i].contrast.trust for i in set(self.choice.values())]))

    def _spread_guide(self) -> np.ndarray:
        boxes = [self.slice_in_box(k) for k in sample_slices(self.prepared.plan.slices)]
        return spreading_curve(np.concatenate([grey[cover > 0.5] for grey, cover in boxes]))

    def _learn_contrast(self, index: int) -> None:
        import torch

        from ..matching.analogy import deep_image_analogy
        from ..matching.coarse import mean_inside
        from ..matching.contrast import match_contrast

        reference, needed = self.references[index], self.features_of(index)
        own = [k for k, chosen in self.choice.items() if chosen == index]
        ks = sample_slices(own)
        greys, masks = self.slices_on_grid(ks)
        if self.own_features:
            self._learn_from_own_matches(index, ks, greys, masks)
            log.info("contrast for %s: %s", reference.name, reference.contrast.describe())
            return
        mask_tensor = torch.from_numpy(masks).to(self.device)

        def coarse_similarity(candidate: np.ndarray) -> float:
            features = self.extractor.extract(torch.from_numpy(candidate)[:, None].to(self.device), (5,))
            found = deep_image_analogy(features, needed.layers, mask_tensor, needed.mask, 5)
            return mean_inside(found.similarity, mask_tensor)

        reference.contrast = match_contrast(greys, masks, reference.grey, reference.mask, coarse_similarity)
        log.info("contrast for %s: %s", reference.name, reference.contrast.describe())

    def _learn_from_own_matches(self, index: int, ks: Sequence[int], greys: np.ndarray, masks: np.ndarray) -> None:
        """What grey means, and its usual colours, from matches of slices ks (S, H, W); one at a time, for the memory's sake."""
        from ..matching.contrast import seen_contrast, seen_luminance
        from ..matching.usual import usual_colors
        from ..matching.vote import matched_colors

        reference = self.references[index]
        own_lab = self._on_device(reference.lab)

        def matched(k: int, grey: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            found = self._own_match(index, (grey * mask)[None], mask[None])
            if self.apart and reference.groups is None:  # a guard's match is another one
                self._found[k, index] = found
            colors = matched_colors(found.field, OWN_LAYER, own_lab).permute(0, 2, 3, 1).float().cpu().numpy()
            return seen_luminance(reference.grey, found.field, OWN_LAYER)[0], colors[0]

        each = self.each if self.apart else map
        seen, colors = (np.stack(values) for values in zip(*each(matched, ks, greys, masks)))
        reference.contrast = seen_contrast(greys, masks, seen)
        if self.reads_trust:
            reference.usual = usual_colors(greys[masks], colors[masks], self.grey_tells)

    def _choose_references(self) -> dict[int, int]:
        """Slice -> index of its reference: the only one, or by likeness (cosine of descriptors) and order."""
        slices = self.prepared.plan.slices
        self.assigned = "freely"
        if len(self.references) == 1:
            return dict.fromkeys(slices, 0)
        with self.run.timed("recommendation"):
            library = unit_descriptors(self.extractor, (r.grey for r in self.references), self.device)
            queries = unit_descriptors(self.extractor, (self.slice_on_grid(k)[0] for k in slices), self.device)
            choice, self.assigned = assign(queries @ library.T)
        return dict(zip(slices, choice.tolist()))
