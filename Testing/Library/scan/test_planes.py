"""Planes that lie across memory: the same values as the view, read a block at a time, whatever is asked for in which order."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from MedColorLib import Settings, Volume, colorize
from MedColorLib.phantom import section
from MedColorLib.scan import planes
from MedColorLib.scan.intensity import strided
from MedColorLib.scan.planes import PlaneBlocks, planes_of

PLANE_BYTES = 6 * 5 * 2


@pytest.fixture
def across() -> np.ndarray:
    """(20, 6, 5) int16 whose first axis has the smallest stride, as transverse slices of a sagittal series."""
    return np.random.default_rng(0).integers(-1000, 1000, (5, 6, 20), dtype=np.int16).transpose(2, 1, 0)


@pytest.fixture
def reads(monkeypatch) -> list[int]:
    numbers, read = [], PlaneBlocks._read
    monkeypatch.setattr(PlaneBlocks, "_read", lambda self, number: numbers.append(number) or read(self, number))
    return numbers


class TestChoice:
    def test_planes_that_lie_together_stay_a_view(self):
        array = np.zeros((4, 5, 6), np.int16)
        assert planes_of(array) is array
        flipped = array[::-1, ::-1]
        assert planes_of(flipped) is flipped and planes_of(array.transpose(0, 2, 1)).base is array

    def test_a_single_plane_stays_a_view(self, across):
        assert np.shares_memory(planes_of(across[:1]), across)

    def test_small_stacks_are_copied_once(self, across):
        got = planes_of(across)
        assert isinstance(got, np.ndarray) and got.flags.c_contiguous and not np.shares_memory(got, across)
        np.testing.assert_array_equal(got, across)

    def test_large_ones_come_in_blocks(self, across):
        assert isinstance(planes_of(across, across.nbytes - 1), PlaneBlocks)


class TestReading:
    @pytest.mark.parametrize("most_bytes", [1, PLANE_BYTES, 3 * PLANE_BYTES + 1, 100 * PLANE_BYTES])
    def test_the_same_values_as_the_view(self, across, most_bytes):
        blocks = PlaneBlocks(across, most_bytes)
        assert (blocks.shape, blocks.dtype, blocks.ndim, blocks.size, len(blocks)) == ((20, 6, 5), np.int16, 3, 600, 20)
        for k in (0, 7, 19, -1, np.int64(4)):
            np.testing.assert_array_equal(blocks[k], across[k])
            np.testing.assert_array_equal(blocks[k, 1:4, 2:], across[k, 1:4, 2:])
        for several in ([3, 3, 18], np.array([5, 0]), slice(None, None, 4), slice(2, 9)):
            np.testing.assert_array_equal(np.stack(list(blocks[several])), across[several])
        np.testing.assert_array_equal(np.stack(list(blocks)), across)
        np.testing.assert_array_equal(np.asarray(blocks), across)
        np.testing.assert_array_equal(strided(blocks, 100), strided(across, 100))

    def test_beyond_the_end(self, across):
        with pytest.raises(IndexError):
            PlaneBlocks(across, PLANE_BYTES)[20]

    def test_each_block_is_read_once_along_the_stack(self, across, reads):
        list(PlaneBlocks(across, 4 * PLANE_BYTES))
        assert reads == [0, 1, 2, 3, 4]

    def test_also_with_a_second_reader_behind(self, across, reads):
        """Slices are matched first and coloured when their neighbours are in."""
        blocks = PlaneBlocks(across, 4 * PLANE_BYTES)
        for k in range(len(blocks)):
            assert blocks[k].any() and blocks[max(0, k - 3)].any()
        assert reads == [0, 1, 2, 3, 4]

    def test_several_threads(self, across):
        blocks = PlaneBlocks(across, 2 * PLANE_BYTES)
        with ThreadPoolExecutor(4) as pool:
            for k, plane in zip(range(20), pool.map(blocks.__getitem__, range(20))):
                np.testing.assert_array_equal(plane, across[k])

    def test_blocks_are_no_way_into_the_volume(self, across):
        with pytest.raises(ValueError, match="read-only"):
            PlaneBlocks(across, PLANE_BYTES)[0][:] = 0


@pytest.mark.usefixtures("small_raster")
def test_a_sagittal_volume_has_the_same_colours_in_blocks(ct, monkeypatch, reads):
    """Array axes (i, j, k) -> stack along the last one; the input is not touched."""
    array = np.ascontiguousarray(ct.volume.array.transpose(2, 1, 0))
    ijk_to_ras = ct.volume.ijk_to_ras[:, [2, 1, 0, 3]]
    volume = Volume(array, ijk_to_ras, name="sagittal")
    settings = Settings(preset="draft", features="embedded")
    before = array.copy()
    whole = colorize(volume, [section()], settings)
    assert not reads
    monkeypatch.setattr(planes, "MOST_BYTES", 3 * array[..., 0].nbytes)
    blocks = colorize(volume, [section()], settings)
    assert reads
    np.testing.assert_array_equal(blocks.rgb, whole.rgb)
    np.testing.assert_array_equal(array, before)
    axial = colorize(ct.volume, [section()], settings)
    np.testing.assert_array_equal(whole.rgb.transpose(2, 1, 0, 3), axial.rgb)
