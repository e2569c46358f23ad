"""Suite *time*: what its points are made of, and that the diagram shows every one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from MedColorLib import ColorVolume, Settings
from MedColorLib.bench import plots_suites, seen, suite_time
from MedColorLib.bench.pairs import make_pair
from MedColorLib.bench.tables import Suite, Table
from MedColorLib.color.gamut import lab_to_srgb_in_gamut


def test_lightness_counts_only_where_it_is_seen(phantom):
    """The true a*, b* at half the lightness: seen as wrong, but right in chroma."""
    truth = make_pair(phantom, "as it is", 0).truth
    inner = truth[..., 0].clip(20, 80)  # where sRGB holds the colours

    def colorize(lightness):
        colors = np.stack([lightness, 0.2 * truth[..., 1], 0.2 * truth[..., 2]], -1)
        rgb = lab_to_srgb_in_gamut(colors)[0][None]
        return lambda volume, *_: ColorVolume(rgb, volume.ijk_to_ras)

    grey = replace(phantom, lab=phantom.lab * (1, 0.2, 0.2))
    right = seen.seen_pair(colorize(truth[..., 0]), grey, "as it is")
    dark = seen.seen_pair(colorize(100 - inner), grey, "as it is")
    assert right.mean < 1 and right.chroma < 1
    assert dark.mean > 10 and dark.chroma < 0.2 * dark.mean


def test_suite_on_the_phantom(phantom, small_raster):
    suite = suite_time.run([phantom], None, True, 0, lambda *_: None)
    rows = suite.tables["against_time"].where()
    assert [row["method"] for row in rows] == ["look-up table", "histogram match", suite_time.DEFAULT]
    assert not suite.failures
    assert all(row["scan"] == suite_time.PAIRS and row["seconds"] > 0 and row["runs"] == 2 for row in rows)
    table, default = rows[0], rows[-1]
    assert default["seen"] < table["seen"] and default["chroma"] < table["chroma"]


def test_what_is_done_once_a_volume_does_not_count(phantom, monkeypatch):
    """Three quarters of the time are told as such, and a volume of one slice leaves the rest to that slice."""
    clock = iter(range(0, 1000, 8))
    monkeypatch.setattr(suite_time.time, "process_time", lambda: next(clock))
    report = {"seconds": {"prepare": 0.5, "network": 0.25, "total": 1.0}}

    def colorize(volume, *_):
        return ColorVolume(np.zeros((*volume.array.shape, 3), np.uint8), volume.ijk_to_ras, report)

    counted = suite_time.Stopped(suite_time.Way("", Settings(), colorize))
    counted(make_pair(phantom, "as it is", 0).volume, [], Settings())
    assert counted.seconds == [8 * 0.25]


@pytest.mark.parametrize("count", [1, 9])
def test_diagram_shows_every_method(count):
    pytest.importorskip("matplotlib")
    table = Table(suite_time.COLUMNS)
    for scan in (suite_time.PAIRS, suite_time.HEAD):
        for n in range(count):
            times = {"seconds": 0.1 + n, "seconds_low": 0.1 + n, "seconds_high": 0.2 + n, "runs": 2}
            table.add(scan=scan, method=f"method {n}", features="", seen=5 + n, chroma=2 + n, **times)
    table.add(scan=suite_time.PAIRS, method=suite_time.PORT, chroma=4.65, seconds=244)
    styles = [str(plots_suites._style(n)) for n in range(count + 1)]
    assert len(set(styles)) == len(styles)
    assert plots_suites.error_against_time(Suite({"against_time": table})).startswith(b"\x89PNG")
