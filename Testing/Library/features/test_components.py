"""Principal components of features: what they keep, and that matching by them is matching by all where nothing is lost."""

import numpy as np
import pytest
import torch

from MedColorLib.features.components import PROJECTED_LAYERS, kept_energy, principal_components, project
from MedColorLib.matching import analogy
from MedColorLib.parameters import PRESETS, Settings
from MedColorLib.run.prepare import prepare
from MedColorLib.volume import Volume


def low_rank(count, channels, rank, side=9, seed=0):
    """(count, channels, side, side) features of `rank` dimensions, all in the same subspace for one seed."""
    generator = torch.Generator().manual_seed(7)
    mixing = torch.randn(channels, rank, generator=generator)
    values = torch.randn(count, rank, side, side, generator=torch.Generator().manual_seed(seed))
    return torch.einsum("ck,nkhw->nchw", mixing, values)


class TestBasis:
    def test_rows_are_orthonormal_and_the_first_holds_most(self):
        features = low_rank(1, 20, 20)
        basis = principal_components(features, 6)
        torch.testing.assert_close(basis @ basis.T, torch.eye(6), atol=1e-5, rtol=0)
        held = project(features / features.norm(dim=1, keepdim=True), basis).square().mean((0, 2, 3))
        assert (held.diff() <= 1e-6).all()

    def test_inner_products_are_kept_where_the_reference_has_no_more_dimensions(self):
        """Whatever the target is: what the reference lacks adds nothing to an inner product with it."""
        reference, target = low_rank(1, 32, 5), torch.randn(2, 32, 9, 9)
        basis = principal_components(reference, 5)
        whole = torch.einsum("nchw,mchw->nmhw", target, reference)
        held = torch.einsum("nchw,mchw->nmhw", project(target, basis), project(reference, basis))
        torch.testing.assert_close(held, whole, atol=1e-4, rtol=1e-4)
        assert kept_energy(reference, basis) == pytest.approx(1, abs=1e-5)

    def test_best_subspace_by_an_independent_decomposition(self):
        """NumPy's singular values of the unit features tell how much the first K can hold."""
        features = low_rank(1, 24, 24, side=7)
        unit = features[0].flatten(1).double().numpy()
        unit /= np.linalg.norm(unit, axis=0)
        squared = np.linalg.svd(unit, compute_uv=False) ** 2
        energy = kept_energy(features, principal_components(features, 8))
        assert energy == pytest.approx(squared[:8].sum() / squared.sum(), abs=1e-5)

    def test_features_of_zeros(self):
        basis = principal_components(torch.zeros(1, 8, 4, 4), 3)
        assert torch.isfinite(basis).all() and kept_energy(torch.zeros(1, 8, 4, 4), basis) == 1
        assert not project(torch.zeros(2, 8, 4, 4), basis).any()

    def test_large_values_do_not_outweigh_small_ones(self):
        """Features are compared by direction: scaling a pixel does not change the basis' space."""
        features = low_rank(1, 16, 16)
        scaled = features.clone()
        scaled[..., :3, :] *= 1e4
        first, second = (principal_components(values, 4) for values in (features, scaled))
        torch.testing.assert_close(first.T @ first, second.T @ second, atol=1e-4, rtol=0)


class TestMatching:
    def test_same_field_where_nothing_is_lost(self):
        sides = {5: 3, 4: 6, 3: 12}
        reference = {layer: low_rank(1, 32, 6, side, seed=layer) for layer, side in sides.items()}
        target = {layer: values.flip(-1) + 0.01 for layer, values in reference.items()}
        masks = torch.ones(1, 48, 48, dtype=torch.bool), torch.ones(48, 48, dtype=torch.bool)
        whole = analogy.deep_image_analogy(target, reference, *masks, 3)
        bases = {layer: principal_components(reference[layer], 32) for layer in PROJECTED_LAYERS if layer in sides}
        held = [{n: project(v, bases[n]) if n in bases else v for n, v in side.items()} for side in (target, reference)]
        assert (analogy.deep_image_analogy(*held, *masks, 3).field == whole.field).float().mean() > 0.95  # bfloat16


class TestSettings:
    def test_the_paper_and_its_deconvolution_compare_whole_features(self):
        assert PRESETS["full"].components is None and Settings(preset="full").components is None
        assert Settings(reconstruction="lbfgs").components is None
        assert Settings().components == PRESETS["balanced"].components > 0

    def test_own_features_have_fewer_channels_and_stay_as_they_are(self):
        from MedColorLib.phantom import section

        volume = Volume(np.random.default_rng(0).normal(100, 20, (2, 40, 40)).astype(np.float32), np.eye(4))
        plan = prepare(volume, [section()], Settings(preset="draft", features="embedded")).plan
        assert not any("components" in entry.what for entry in plan.left_out)
