"""Correspondence: every search and every use of a field against slow loops that follow the definitions."""

from __future__ import annotations

from itertools import product

import pytest
import torch

from MedColorLib.matching.fields import exact, patches, patchmatch, windowed
from MedColorLib.matching.fields.field import average_vote, identity, upsample, warp
from MedColorLib.matching.fields.patchmatch import patch_similarity
from MedColorLib.matching.vote import matched_colors


def features(count, height, width, channels=5, seed=0):
    """Random unit features (count, channels, height, width)."""
    values = torch.randn(count, channels, height, width, generator=torch.Generator().manual_seed(seed))
    return values / values.norm(dim=1, keepdim=True)


def random_mask(height, width, seed=0, share=0.6):
    mask = torch.rand(height, width, generator=torch.Generator().manual_seed(seed)) < share
    mask[height // 2, width // 2] = True
    return mask


def random_field(count, shape, shape2, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(0, shape2[0] * shape2[1], (count, *shape), generator=generator)


def everywhere(*shape):
    return torch.ones(*shape, dtype=torch.bool)


def at(image, row, col):
    """image[:, row, col], or nothing beyond the edge."""
    inside = 0 <= row < image.shape[1] and 0 <= col < image.shape[2]
    return image[:, row, col] if inside else torch.zeros(image.shape[0])


def naive_similarity(target, reference, p, q, radius):
    offsets = list(product(range(-radius, radius + 1), repeat=2))
    total = sum(float(at(target, p[0] + y, p[1] + x) @ at(reference, q[0] + y, q[1] + x)) for y, x in offsets)
    return total / len(offsets)


def positions(shape):
    return list(product(range(shape[0]), range(shape[1])))


def naive_table(target, reference, radius):
    """(h * w, h2 * w2) of every pair of positions."""
    rows = [
        [naive_similarity(target, reference, p, q, radius) for q in positions(reference.shape[1:])]
        for p in positions(target.shape[1:])
    ]
    return torch.tensor(rows)


def chosen(table, field):
    """The similarity of each position's match, from the table."""
    return table.gather(1, field.reshape(-1, 1)).reshape(field.shape)


class TestExact:
    @pytest.mark.parametrize("radius", [0, 1, 2])
    @pytest.mark.parametrize(("shape", "shape2"), [((4, 5), (3, 4)), ((1, 6), (5, 1)), ((2, 2), (6, 3))])
    def test_best_of_all_pairs_in_both_directions(self, radius, shape, shape2):
        target, reference = features(2, *shape, seed=1), features(1, *shape2, seed=2)
        target_mask = torch.stack([random_mask(*shape, seed=n) for n in (3, 4)])
        reference_mask = random_mask(*shape2, seed=5)
        field, similarity, reverse, reverse_similarity = exact.search(
            target, reference, radius, target_mask, reference_mask, both=True
        )
        for n in range(2):
            table = naive_table(target[n], reference[0], radius)
            allowed = table.masked_fill(~reference_mask.reshape(1, -1), -9)
            torch.testing.assert_close(similarity[n].reshape(-1), allowed.max(1).values, atol=1e-5, rtol=0)
            torch.testing.assert_close(chosen(allowed, field[n]), similarity[n], atol=1e-5, rtol=0)
            back = table.masked_fill(~target_mask[n].reshape(-1, 1), -9).T
            found = chosen(back, reverse[n])
            torch.testing.assert_close(found[reference_mask], reverse_similarity[n][reference_mask], atol=1e-5, rtol=0)
            best = back.max(1).values.reshape(shape2)
            torch.testing.assert_close(found[reference_mask], best[reference_mask], atol=1e-5, rtol=0)

    def test_one_direction_leaves_the_other_out(self):
        target = features(1, 4, 4)
        forward = exact.search(target, target, 1, everywhere(1, 4, 4), everywhere(4, 4), both=False)
        assert forward[2] is None and forward[3] is None
        both = exact.search(target, target, 1, everywhere(1, 4, 4), everywhere(4, 4), both=True)
        torch.testing.assert_close(forward[0], both[0])

    @pytest.mark.parametrize("radius", [0, 1, 2])
    def test_a_reference_like_the_target_gives_the_identity(self, radius):
        target = features(2, 7, 9, channels=16)
        field, _, reverse, _ = exact.search(target, target, radius, everywhere(2, 7, 9), everywhere(7, 9), both=True)
        torch.testing.assert_close(field, identity(2, 7, 9))
        torch.testing.assert_close(reverse, identity(2, 7, 9))

    def test_excluded_positions_are_never_chosen(self):
        target, reference = features(1, 6, 6, seed=1), features(1, 6, 6, seed=2)
        target_mask, reference_mask = random_mask(6, 6, 3, share=0.2), random_mask(6, 6, 4, share=0.2)
        field, _, reverse, _ = exact.search(target, reference, 1, target_mask[None], reference_mask, both=True)
        assert reference_mask.reshape(-1)[field].all() and target_mask.reshape(-1)[reverse].all()

    def test_arguments_are_not_altered(self):
        target, reference, mask = features(1, 4, 4), features(1, 4, 4, seed=1), random_mask(4, 4)
        before = target.clone(), reference.clone(), mask.clone()
        exact.search(target, reference, 1, mask[None], mask, both=True)
        for now, then in zip((target, reference, mask), before):
            torch.testing.assert_close(now, then, rtol=0, atol=0)

    def test_features_of_zero_length_match_without_nan(self):
        zero = torch.zeros(1, 3, 4, 4)
        field, similarity, reverse, _ = exact.search(zero, zero, 1, everywhere(1, 4, 4), everywhere(4, 4), both=True)
        assert not similarity.any() and field.max() < 16 and reverse.max() < 16


class TestPatches:
    """Products in bfloat16: a match is as good as the best by less than the rounding."""

    ROUNDING = 6e-3  # of means of inner products of unit features, which are far from a good match here

    @pytest.mark.parametrize("radius", [0, 1, 2])
    @pytest.mark.parametrize(
        ("shape", "shape2"), [((4, 5), (3, 4)), ((1, 6), (5, 1)), ((2, 2), (6, 3)), ((40, 30), (9, 11))]
    )
    def test_as_good_as_the_best_of_all_pairs_in_both_directions(self, radius, shape, shape2):
        target, reference = features(2, *shape, seed=1), features(1, *shape2, seed=2)
        inside = torch.stack([random_mask(*shape, seed=n, share=0.4) for n in (3, 4)])
        wanted = inside | torch.stack([random_mask(*shape, seed=n) for n in (6, 7)])
        mask2 = random_mask(*shape2, seed=5)
        field, similarity, reverse = patches.search(target, reference, radius, wanted, inside, mask2, both=True)
        for n in range(2):
            table = exact.similarity_volume(target[n], reference[0], radius)
            allowed = table.masked_fill(~mask2.reshape(1, -1), -9)
            best, found = allowed.max(1).values.view(shape), chosen(allowed, field[n])
            assert (best - found)[wanted[n]].max() <= self.ROUNDING
            torch.testing.assert_close(similarity[n][wanted[n]], best[wanted[n]], atol=self.ROUNDING, rtol=0)
            assert not field[n][~wanted[n]].any() and not similarity[n][~wanted[n]].any()
            back = table.masked_fill(~inside[n].reshape(-1, 1), -9).T
            assert (back.max(1).values.view(shape2) - chosen(back, reverse[n]))[mask2].max() <= self.ROUNDING
            assert inside[n].reshape(-1)[reverse[n]].all()
        once = patches.search(target, reference, radius, wanted, inside, mask2, both=False)
        assert torch.equal(once[0], field) and once[2] is None

    def test_more_positions_than_one_block(self):
        target = features(1, 40, 45, channels=16)
        all_of_it = everywhere(1, 40, 45)
        field, _, reverse = patches.search(target, target, 1, all_of_it, all_of_it, everywhere(40, 45), both=True)
        assert torch.equal(field, identity(1, 40, 45)) and torch.equal(reverse, identity(1, 40, 45))

    def test_empty_masks(self):
        target, nothing = features(1, 4, 4), ~everywhere(4, 4)
        field, _, reverse = patches.search(target, target, 1, everywhere(1, 4, 4), nothing[None], nothing, both=True)
        assert torch.equal(field, identity(1, 4, 4)) and not reverse.any()
        field, similarity, _ = patches.search(
            target, target, 1, nothing[None], nothing[None], everywhere(4, 4), both=True
        )
        assert not field.any() and not similarity.any()


class TestField:
    def test_identity(self):
        assert identity(2, 3, 4)[1].tolist() == [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9, 10, 11]]

    @pytest.mark.parametrize(("to_shape", "from_width"), [((8, 10), 5), ((7, 9), 5), ((4, 2), 1)])
    def test_upsampled_children_keep_their_place(self, to_shape, from_width):
        rows2 = -(-to_shape[0] // 2)
        field = random_field(2, (3, 4), (rows2, from_width))
        got = upsample(field, to_shape, from_width)
        assert got.shape == (2, 6, 8)
        for n, row, col in product(range(2), range(6), range(8)):
            match = int(field[n, row // 2, col // 2])
            expected_row = min(2 * (match // from_width) + row % 2, to_shape[0] - 1)
            expected_col = min(2 * (match % from_width) + col % 2, to_shape[1] - 1)
            assert got[n, row, col] == expected_row * to_shape[1] + expected_col

    def test_warp(self):
        values, field = features(2, 3, 5, seed=1), random_field(2, (4, 2), (3, 5))
        got = warp(values, field)
        shared = warp(values[:1], field)
        for n, row, col in product(range(2), range(4), range(2)):
            match = divmod(int(field[n, row, col]), 5)
            torch.testing.assert_close(got[n, :, row, col], values[n][:, match[0], match[1]])
            torch.testing.assert_close(shared[n, :, row, col], values[0][:, match[0], match[1]])

    @pytest.mark.parametrize("radius", [0, 1, 2])
    @pytest.mark.parametrize(
        ("shape", "shape2"), [((5, 6), (4, 7)), ((1, 3), (6, 2)), ((3, 1), (1, 1)), ((1, 1), (4, 4))]
    )
    def test_average_vote(self, radius, shape, shape2):
        values, field = features(2, *shape2, channels=3, seed=1), random_field(2, shape, shape2)
        got = average_vote(values, field, radius)
        for n, (row, col) in product(range(2), positions(shape)):
            votes = []
            for y, x in product(range(-radius, radius + 1), repeat=2):
                if 0 <= row - y < shape[0] and 0 <= col - x < shape[1]:
                    match_row, match_col = divmod(int(field[n, row - y, col - x]), shape2[1])
                    if 0 <= match_row + y < shape2[0] and 0 <= match_col + x < shape2[1]:
                        votes.append(values[n][:, match_row + y, match_col + x])
            torch.testing.assert_close(got[n, :, row, col], torch.stack(votes).mean(0))

    def test_vote_stays_within_the_reference_and_keeps_constants(self):
        field = random_field(1, (9, 9), (7, 8))
        values = torch.rand(1, 2, 7, 8)
        got = average_vote(values, field)
        assert got.min() >= values.min() - 1e-6 and got.max() <= values.max() + 1e-6
        torch.testing.assert_close(average_vote(torch.full((1, 1, 7, 8), 3.0), field), torch.full((1, 1, 9, 9), 3.0))


class TestVote:
    @pytest.mark.parametrize("layer", [1, 2, 3, 4, 5])
    def test_identity_brings_the_reference_itself(self, layer):
        reference = torch.rand(1, 3, 48, 64)
        side = 2 ** (layer - 1)
        field = identity(2, 48 // side, 64 // side)
        torch.testing.assert_close(matched_colors(field, layer, reference), reference.expand(2, -1, -1, -1))

    def test_patches_of_five_by_five_vote(self):
        reference, field = torch.rand(1, 3, 16, 16), random_field(1, (8, 8), (8, 8))
        full = upsample(field, (16, 16), 8)
        torch.testing.assert_close(matched_colors(field, 2, reference), average_vote(reference, full, radius=2))

    @pytest.mark.parametrize("radius", [0, 1, 2, 3])
    @pytest.mark.parametrize("layer", [1, 2, 3, 4])
    @pytest.mark.parametrize("references", [1, 2])
    def test_a_coarse_field_votes_like_its_upsampled_self(self, layer, radius, references):
        """Blocks read once and counted as often as they occur: the same as every vote by itself."""
        scale = 2 ** (layer - 1)
        shape, shape2 = (3, 5), (4, 2)
        field = full = random_field(2, shape, shape2, seed=layer)
        for doubling in range(layer - 1):
            full = upsample(full, tuple(side * 2 ** (doubling + 1) for side in shape2), shape2[1] * 2**doubling)
        values = torch.rand(references, 3, shape2[0] * scale, shape2[1] * scale)
        torch.testing.assert_close(average_vote(values, field, radius, scale), average_vote(values, full, radius))

    def test_a_reference_that_ends_inside_a_block(self):
        """Positions beyond it give no vote."""
        values, field = torch.rand(1, 1, 3, 3), torch.full((1, 1, 1), 3)
        torch.testing.assert_close(
            average_vote(values, field, 0, 2)[0, 0], values[0, 0, 2, 2] * torch.tensor([[1.0, 0], [0, 0]])
        )


def patchmatch_search(target, reference, field, mask, radius):
    generator = torch.Generator().manual_seed(7)
    return patchmatch.refine(target, reference, field, mask, radius, 6, 3, generator)


SEARCHES = {"patchmatch": patchmatch_search, "windowed": windowed.refine}


@pytest.mark.parametrize("search", SEARCHES.values(), ids=SEARCHES)
class TestLocalSearches:
    @pytest.mark.parametrize("radius", [0, 1, 2])
    def test_similarity_is_that_of_the_definition(self, search, radius):
        target, reference = features(2, 5, 6, seed=1), features(1, 4, 7, seed=2)
        field, similarity = search(target, reference, random_field(2, (5, 6), (4, 7)), everywhere(4, 7), radius)
        for n in range(2):
            table = naive_table(target[n], reference[0], radius)
            torch.testing.assert_close(similarity[n], chosen(table, field[n]), atol=1e-5, rtol=0)

    @pytest.mark.parametrize(("shape", "shape2"), [((37, 29), (41, 26)), ((16, 40), (9, 9)), ((3, 2), (30, 30))])
    def test_never_worse_than_its_start_and_only_allowed_targets(self, search, shape, shape2):
        target, reference = features(2, *shape, seed=1), features(2, *shape2, seed=2)
        mask = random_mask(*shape2, seed=3)
        allowed = torch.nonzero(mask.reshape(-1))[:, 0]
        start = allowed[random_field(2, shape, (1, len(allowed)))]
        before = start.clone()
        field, similarity = search(target, reference, start, mask, 1)
        assert (similarity >= patch_similarity(target, reference, start, 1) - 1e-5).all()
        torch.testing.assert_close(similarity, patch_similarity(target, reference, field, 1), atol=1e-5, rtol=0)
        assert mask.reshape(-1)[field].all()
        assert similarity.mean() > 0.1  # chance alone gives 0; it did search
        torch.testing.assert_close(start, before)

    def test_a_start_that_is_not_allowed_is_left(self, search):
        target = features(1, 20, 20)
        mask = everywhere(20, 20)
        mask[:, 10:] = False
        field, _ = search(target, target, identity(1, 20, 20), mask, 1)
        assert mask.reshape(-1)[field[0, :, :14]].all()

    def test_same_result_twice(self, search):
        target, reference, start = features(1, 20, 24), features(1, 22, 18, seed=1), random_field(1, (20, 24), (22, 18))
        first, second = (search(target, reference, start, everywhere(22, 18), 1) for _ in range(2))
        torch.testing.assert_close(first[0], second[0])
        torch.testing.assert_close(first[1], second[1], rtol=0, atol=0)

    def test_constant_images_keep_their_start(self, search):
        constant = torch.ones(1, 1, 30, 30)
        inner = identity(1, 30, 30)
        field, _ = search(constant, constant, inner, everywhere(30, 30), 2)
        torch.testing.assert_close(field, inner.contiguous())

    @pytest.mark.parametrize("period", [2, 3, 5])
    def test_periodic_images_keep_their_start(self, search, period):
        tile = features(1, period, period, channels=8)
        image = tile.repeat(1, 1, 30 // period + 1, 30 // period + 1)[:, :, :30, :30]
        start = identity(1, 30, 30)
        field, _ = search(image, image, start, everywhere(30, 30), 1)
        torch.testing.assert_close(field, start.contiguous())

    def test_zero_features(self, search):
        zero = torch.zeros(1, 2, 12, 12)
        field, similarity = search(zero, zero, identity(1, 12, 12), everywhere(12, 12), 1)
        torch.testing.assert_close(field, identity(1, 12, 12).contiguous())
        assert not similarity.any()


class TestWindowed:
    @pytest.mark.parametrize("radius", [0, 1, 2])
    @pytest.mark.parametrize(("shape", "shape2"), [((13, 9), (17, 24)), ((24, 24), (5, 3))])
    def test_exhaustive_where_the_window_holds_the_whole_map(self, radius, shape, shape2):
        target, reference = features(2, *shape, seed=1), features(1, *shape2, seed=2)
        mask = random_mask(*shape2, seed=3)
        start = torch.nonzero(mask.reshape(-1))[:, 0][:1].expand(2, *shape)
        _, best, _, _ = exact.search(target, reference, radius, everywhere(2, *shape), mask, both=False)
        _, similarity = windowed.refine(target, reference, start, mask, radius)
        torch.testing.assert_close(similarity, best, atol=1e-5, rtol=0)

    def test_a_shift_within_reach_is_found(self):
        reference = features(1, 40, 44, channels=12)
        target = torch.roll(reference, (3, -4), (2, 3))
        field, _ = windowed.refine(target, reference, identity(1, 40, 44), everywhere(40, 44), 1)
        rows, cols = torch.meshgrid(torch.arange(5, 39), torch.arange(1, 39), indexing="ij")
        assert (field[0, 5:39, 1:39] == (rows - 3) * 44 + cols + 4).float().mean() > 0.97

    def test_a_block_that_starts_astray_is_led_back_by_its_neighbours(self):
        image = features(1, 40, 48, channels=12)
        start = identity(1, 40, 48).clone()
        start[0, 16:24, 8:16] = start[0, 16:24, 40:48]
        field, _ = windowed.refine(image, image, start, everywhere(40, 48), 1)
        torch.testing.assert_close(field, identity(1, 40, 48).contiguous())

    def test_slices_together_as_alone(self):
        target, reference = features(3, 21, 19, seed=1), features(1, 26, 30, seed=2)
        start = random_field(3, (21, 19), (26, 30))
        together, _ = windowed.refine(target, reference, start, everywhere(26, 30), 2)
        for n in range(3):
            one = slice(n, n + 1)
            alone, _ = windowed.refine(target[one], reference, start[one], everywhere(26, 30), 2)
            torch.testing.assert_close(together[one], alone)

    def test_memory_limit_does_not_change_the_result(self, monkeypatch):
        target, reference, start = features(1, 40, 40), features(1, 40, 40, seed=1), identity(1, 40, 40)
        whole = windowed.refine(target, reference, start, everywhere(40, 40), 1)
        monkeypatch.setattr(windowed, "_CHUNK_BYTES", 1)
        monkeypatch.setattr(patchmatch, "_CHUNK_BYTES", 1)
        chunked = windowed.refine(target, reference, start, everywhere(40, 40), 1)
        torch.testing.assert_close(whole[0], chunked[0])
        torch.testing.assert_close(whole[1], chunked[1])


class TestPatchMatch:
    def test_seed_decides(self):
        target, reference, start = features(1, 20, 20), features(1, 20, 20, seed=1), random_field(1, (20, 20), (20, 20))
        fields = []
        for seed in (0, 0, 1):
            generator = torch.Generator().manual_seed(seed)
            fields.append(patchmatch.refine(target, reference, start, everywhere(20, 20), 1, 6, 2, generator)[0])
        assert torch.equal(fields[0], fields[1]) and not torch.equal(fields[0], fields[2])

    def test_chance_is_not_drawn_from_the_global_generator(self):
        torch.manual_seed(1)
        before = torch.get_rng_state()
        patchmatch_search(features(1, 9, 9), features(1, 9, 9), identity(1, 9, 9), everywhere(9, 9), 1)
        assert torch.equal(before, torch.get_rng_state())

    def test_approaches_the_exhaustive_search(self):
        coarse = features(1, 6, 6, channels=8)
        smooth = torch.nn.functional.interpolate(coarse, size=(24, 24), mode="bicubic")
        reference = smooth / smooth.norm(dim=1, keepdim=True)
        target = torch.flip(reference, (3,))
        start = random_field(1, (24, 24), (24, 24))
        _, best, _, _ = exact.search(target, reference, 1, everywhere(1, 24, 24), everywhere(24, 24), both=False)
        generator = torch.Generator().manual_seed(0)
        _, found = patchmatch.refine(target, reference, start, everywhere(24, 24), 1, 24, 6, generator)
        assert (best - found).mean() < 0.02 and (found <= best + 1e-5).all()


class TestBlocks:
    """Rows at a time, as on a CPU, against the whole matrix at once."""

    @pytest.mark.parametrize("shape", [(7, 5), (1, 9), (9, 1)])
    @pytest.mark.parametrize("radius", [1, 2])
    def test_same_matches(self, monkeypatch, shape, radius):
        generator = torch.Generator().manual_seed(3)
        target, reference = (torch.randn(n, 6, *shape, generator=generator) for n in (2, 1))
        masks = torch.rand(2, *shape, generator=generator) > 0.3, torch.rand(shape, generator=generator) > 0.3
        whole = exact.search(target, reference, radius, *masks, True)
        monkeypatch.setattr(exact, "_BLOCK_ENTRIES", 1)  # a row at a time
        for got, expected in zip(exact.search(target, reference, radius, *masks, True), whole):
            torch.testing.assert_close(got, expected, rtol=0, atol=1e-6)  # rounding of the products

    def test_half_products_agree_within_their_digits(self):
        generator = torch.Generator().manual_seed(4)
        sides = [
            torch.nn.functional.normalize(torch.randn(1, 64, 12, 12, generator=generator), dim=1) for _ in range(2)
        ]
        masks = torch.ones(1, 12, 12, dtype=torch.bool), torch.ones(12, 12, dtype=torch.bool)
        _, precise, _, _ = exact.search(*sides, 1, *masks, False)
        _, halved, _, _ = exact.search(*(side.bfloat16() for side in sides), 1, *masks, False)
        assert 0 < (precise - halved).abs().max() < 2.0**-8
