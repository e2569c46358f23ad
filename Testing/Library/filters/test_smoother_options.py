"""Parameters of the smoothers: every one of them does something, defaults are what None takes, wrong ones are refused."""

from __future__ import annotations

import json
import subprocess
import sys
from functools import cache

import numpy as np
import pytest

from MedColorLib import Settings, Volume, colorize, make_plan
from MedColorLib.cli.main import main
from MedColorLib.errors import SettingsError
from MedColorLib.filters import PARAMETERS, smoother_options, smoother_parameters
from MedColorLib.filters.options import values_text
from MedColorLib.filters.regression import RegressionParameters, splat
from MedColorLib.parameters import SMOOTHERS

pytestmark = pytest.mark.usefixtures("small_raster")

CHANGED = {
    "fgs": {"lam": 4.0, "sigma": 5.0, "iterations": 1, "schedule": "opencv"},
    "guided": {"radius": 3, "eps": 2000.0},
    "domain-transform": {"sigma_s": 2.0, "sigma_r": 5.0, "iterations": 1},
    "wls": {"lam": 2.0, "alpha": 0.5, "eps": 1e-2},
    "regression": {"cell_px": 20.0, "bins": 4, "support_px": 400.0, "levels": 0},
}
ONE_BY_ONE = [(smoother, name, value) for smoother, values in CHANGED.items() for name, value in values.items()]


BASE = {"preset": "draft", "features": "embedded", "device": "cpu"}


@pytest.fixture(scope="module")
def colored(ct, small_raster):
    """Colours of one slice with a smoother and its options, each computed once."""
    volume = Volume(ct.volume.array[5:6], ct.volume.ijk_to_ras)

    @cache
    def compute(smoother, options, **more):
        settings = Settings(**BASE, **more, smoother=smoother, smoother_options=json.loads(options))
        return colorize(volume, [ct.reference], settings).rgb

    return lambda smoother, options, **more: compute(smoother, json.dumps(options), **more)


def test_every_smoother_has_options_and_every_option_is_tried():
    assert set(PARAMETERS) == set(SMOOTHERS) - {"auto"} == set(CHANGED)
    for smoother, values in CHANGED.items():
        assert {option.name for option in smoother_options(smoother)} == set(values)


@pytest.mark.parametrize(("smoother", "name", "value"), ONE_BY_ONE)
def test_every_option_changes_the_colors(colored, smoother, name, value):
    assert (colored(smoother, {name: value}) != colored(smoother, None)).any()


@pytest.mark.parametrize("smoother", CHANGED)
def test_defaults_are_what_none_takes(colored, smoother):
    defaults = {option.name: option.default for option in smoother_options(smoother)}
    assert smoother_parameters(smoother, defaults) == smoother_parameters(smoother) == PARAMETERS[smoother]()
    defaults.pop("support_px", None)  # the matches ask for it where it is not given
    np.testing.assert_array_equal(colored(smoother, defaults), colored(smoother, None))
    np.testing.assert_array_equal(colored(smoother, {}), colored(smoother, None))


@pytest.mark.parametrize("smoother", CHANGED)
def test_options_have_a_meaning_and_a_range_that_holds(smoother):
    for option in smoother_options(smoother):
        assert option.about.endswith(".")
        if option.choices:
            assert option.default in option.choices
            outside, ends = ["no such word", 3], option.choices
        else:
            assert option.low <= option.default <= option.high
            low = option.low + (1e-3 if option.above_low else 0)
            outside = [option.low - 1, option.high * 2, float("nan"), "much", None, True]
            outside += [option.low] if option.above_low else []
            outside += [low + 0.5] if option.whole else []
            ends = (low, option.high)
        for value in outside:
            with pytest.raises(SettingsError, match=f"smoother_options.*{option.name}"):
                Settings(smoother=smoother, smoother_options={option.name: value})
        for value in ends:
            assert Settings(smoother=smoother, smoother_options={option.name: value})


@pytest.mark.parametrize("wrong", [5, [("lam", 3)], "lam=3", {"lambda": 3}, {3: 3}])
def test_unknown_names_list_the_known_ones_with_ranges(wrong):
    with pytest.raises(SettingsError, match=r"fgs takes lam \(0 to 1e\+30, default 32\), sigma \(.*default 200\)"):
        Settings(smoother="fgs", smoother_options=wrong)


def test_auto_means_the_smoother_of_the_preset():
    assert Settings(preset="full", smoother_options={"sigma": 20}).smoother_options == {"sigma": 20.0}
    with pytest.raises(SettingsError, match="regression has no sigma"):
        Settings(preset="balanced", smoother_options={"sigma": 20})


def test_settings_survive_json_and_leave_the_caller_alone():
    given = {"iterations": 2, "lam": 8}
    settings = Settings(smoother="fgs", smoother_options=given)
    assert given == {"iterations": 2, "lam": 8}
    assert Settings.from_dict(json.loads(json.dumps(settings.to_dict()))) == settings
    given["lam"] = -1
    assert settings.smoother_options == {"iterations": 2, "lam": 8.0}
    assert Settings(smoother_options={}).smoother_options is None


def test_settings_load_nothing_heavy():
    code = (
        "import sys; sys.modules.update(dict.fromkeys(('torch', 'cv2', 'scipy', 'vtk'), None)); import MedColorLib; "
        "print(MedColorLib.Settings(smoother='wls', smoother_options={'lam': 1}).smoother_options)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "{'lam': 1.0}"


def test_values_text():
    assert values_text(smoother_parameters("fgs")) == "lam 32, sigma 200, iterations 3, schedule min2014"


def test_run_plan_and_report_take_them(ct):
    volume = Volume(ct.volume.array[4:6], ct.volume.ijk_to_ras)
    settings = Settings(**BASE, smoother="fgs", smoother_options={"lam": 0.01})
    changed = colorize(volume, [ct.reference], settings)
    assert "fgs, lam 0.01, sigma 200, iterations 3" in make_plan(volume, [ct.reference], settings).text()
    assert changed.report["settings"]["smoother_options"] == {"lam": 0.01}
    assert "lam 0.01" in changed.report["plan"]["steps"]["colour"]


def test_luminance_beside_the_regression_keeps_its_own_smoother(colored):
    """`luminance="paper"` smooths L* with FGS beside the regression, whose options are not those of FGS."""
    assert colored("regression", {"bins": 8}, luminance="paper").any()


def test_more_cells_than_memory_should_hold_are_refused():
    grey = np.zeros((256, 256), np.float32)
    with pytest.raises(SettingsError, match="cell_px"):
        splat(np.zeros((256, 256, 2), np.float32), grey, grey + 1, RegressionParameters(cell_px=1, bins=1024))


class TestCommandLine:
    @pytest.fixture
    def files(self, ct, tmp_path, monkeypatch):
        import cv2
        from volume_samples import save_nrrd

        save_nrrd(tmp_path / "ct.nrrd", ct.volume.array[4:6], ct.volume.ijk_to_ras)
        cv2.imwrite(str(tmp_path / "section.png"), ct.reference[..., ::-1])
        monkeypatch.chdir(tmp_path)

    def run(self, *options):
        base = ["colorize", "ct.nrrd", "-r", "section.png", "--features", "embedded", "--plan", "--smoother", "fgs"]
        try:
            return main([*base, *options])
        except SystemExit as end:
            return end.code

    def test_named_values(self, files, capsys):
        assert self.run("--smoother-option", "lam=16", "--smoother-option", "schedule=opencv") == 0
        assert "fgs, lam 16, sigma 200, iterations 3, schedule opencv" in capsys.readouterr().out

    @pytest.mark.parametrize("wrong", ["lambda=1", "lam=-1", "lam=much", "iterations=1.5", "lam", "=3", "lam="])
    def test_wrong_ones_are_one_line(self, files, capsys, wrong):
        assert self.run("--smoother-option", wrong) == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1 and "lam" in said
