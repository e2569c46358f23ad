"""Suite *quality*: what each improvement on the paper brings, alone and all together, on pairs with known colours.

The paper's mode is the preset `full` to the letter: features alone, histogram match, the photograph as it lies, every match
counts alike, fast global smoother, gamma, and the photograph's luminance. Each improvement is switched on by itself on top of
it, stopped at layer 3, where the default stops, too. Volumes, where neighbouring slices count, are in `slabs`; what a viewer
sees on real images, lightness included, in `measures`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..errors import MedColorError
from ..parameters import PRESETS
from ..progress import Progress
from . import measures, outline, slabs, suite_pipeline
from .matched import Matched, Method, Transfer
from .pairs import REMAPS, Pair, Section, make_pair
from .quality import baselines, color_errors, color_spill, dark_share
from .summary import ALL_TOGETHER
from .tables import TIME_COLUMNS, Suite, Table, timed

KEYS = ("section", "remap", "features", "method")
COLUMNS = (*KEYS, "mean", "p95", "worst_patch", "spill", "dark_share", *TIME_COLUMNS)
BEATEN_COLUMNS = ("section", "remap", "features", "default", "paper", "best_baseline", "baseline", "met")

PAPER, SHORT, DEFAULT = "paper", "paper, to layer 3", ALL_TOGETHER
UPSIDE_DOWN = "as it is, photograph upside down"
_BASELINES = ("grey", "mean colour", "look-up table")
_OF_LAYERS = (SHORT, "+ context", "+ learned contrast")  # modes that the own features do not have

NOTES = [
    "Pairs as in the suite pipeline; CIEDE2000 inside the body with the true luminance.",
    "'paper' is the preset full to the letter: features alone, histogram match, photograph as it lies, matches count alike, "
    "fast global smoother, gamma, luminance of the paper. Each line with + switches one improvement on, on top of the paper's "
    "mode to layer 3; the remainder stands only beside the regression. 'all together' is the preset balanced, with the scan's "
    "luminance kept. MedColor's own features see no contrast and have one layer: no context, no learned contrast. "
    "A quick run stops the paper's mode at layer 3.",
    "spill: share of the true steps of a*, b* (over 15, between points 4 pixels apart, means over 3 x 3) that is missing; 0 "
    "for sharp edges, 1 for none.",
    "dark_share: share of the body as it was found that is more than 15 L* darker than the scan; 0 by construction where "
    "luminance is kept.",
    f"'{UPSIDE_DOWN}': the reference is given turned; the only pair on which the orientation has something to do.",
    "Seconds: features, matching and transfer of one slice of 256 x 256, measured on the first pair, shown with every one. They "
    "count only where the error is below that of the mean colour. Without the remainder they hold a solve of zeros.",
]


@dataclass(frozen=True)
class Mode:
    """One line: how a slice is matched, and how its colours are transferred.

    Attributes:
        trusted: whether the match finds out how far it can be trusted.
    """

    name: str
    method: Method
    transfer: Transfer
    trusted: bool = False

    @property
    def match(self) -> tuple[Method, bool]:
        """Modes with the same match differ only in the transfer."""
        return self.method, self.trusted


def modes(features: str, preset: str = "balanced", paper: str = "full") -> list[Mode]:
    """The paper's mode, every improvement alone, and all together as `preset` has them.

    Args:
        paper: key of PRESETS with the paper's layers.
    """
    own_features = features == "embedded"
    full = Method(features, paper, context=None if own_features else False, contrast=False, orientation=False)
    short = full if own_features else replace(full, stop_layer=max(3, PRESETS[paper].stop_layer))
    letter = Transfer("fgs", gamma=True, luminance="paper", weighted=False)
    by_regression = replace(letter, smoother="regression")
    own = PRESETS[preset]
    default = Transfer(own.smoother, own.gamma)
    found = [
        Mode(PAPER, full, letter),
        Mode(SHORT, short, letter),
        *([] if own_features else [Mode("+ context", replace(short, context=True), letter)]),
        Mode("+ learned contrast", replace(short, contrast=True), letter),
        Mode("+ orientation", replace(short, orientation=True), letter),
        Mode("+ confidence weights", short, replace(letter, weighted=True), trusted=True),
        Mode("+ regression", short, replace(by_regression, remainder=False)),
        Mode("+ regression and remainder", short, by_regression),
        Mode("+ gamma off", short, replace(letter, gamma=False)),
        Mode("+ luminance kept", short, replace(letter, luminance="keep")),
        Mode(DEFAULT, Method(features, preset), default),
        Mode(f"{DEFAULT}, luminance paper", Method(features, preset), replace(default, luminance="paper")),
    ]
    return [mode for mode in found if not (own_features and mode.name in _OF_LAYERS)]


def run(sections: list[Section], data: Path | None, quick: bool, seed: int, progress: Progress) -> Suite:
    """Colour every pair in every mode, then volumes with and without coherence."""
    table = Table(COLUMNS)
    suite = Suite({"improvements": table}, notes=list(NOTES))
    jobs = _jobs(sections, quick)
    for number, (section, remap, lines) in enumerate(jobs):
        progress(0.4 * number / len(jobs), f"quality, {section.name}, {remap}")
        pair = make_pair(section, remap, seed)
        measure_pair(suite, pair, section.rgb, lines, runs=(2 if quick else 5) if number == 0 else 0)
    if not quick:
        unturned = PAPER if _main_features() == "embedded" else SHORT
        turned = [mode for mode in modes(_main_features()) if mode.name in (unturned, "+ orientation", DEFAULT)]
        measure_pair(suite, make_pair(sections[0], "as it is", seed), sections[0].rgb[::-1], turned, 0, UPSIDE_DOWN)
    _share_times(table)
    if (verdicts := beaten(table)).rows:
        suite.tables = {"beaten": verdicts, **suite.tables}
    outline.run(suite, data, quick, lambda fraction, text: progress(0.4 + 0.03 * fraction, text))
    slabs.run(suite, data, quick, lambda fraction, text: progress(0.43 + 0.07 * fraction, text))
    measures.run(suite, data, quick, lambda fraction, text: progress(0.5 + 0.5 * fraction, text))
    return suite


def _main_features() -> str:
    return "vgg19" if suite_pipeline.has_network() else "embedded"


def _jobs(sections: list[Section], quick: bool) -> list[tuple[Section, str, list[Mode]]]:
    """(section, remap, modes): every mode with the paper's features, the two that matter most with MedColor's own, too."""
    if quick:  # the own features on the smallest pictures
        lines = modes("embedded", paper="balanced")
        ends = [mode for mode in lines if mode.name in (PAPER, DEFAULT)]
        return [(sections[-1], "as it is", lines), (sections[-1], "inverted", ends)]
    lines = modes(_main_features())
    if _main_features() != "embedded":
        lines += [mode for mode in modes("embedded") if mode.name in (PAPER, DEFAULT)]
    return [(section, remap, lines) for section in sections for remap in REMAPS]


def measure_pair(
    suite: Suite, pair: Pair, reference: np.ndarray, lines: list[Mode], runs: int, remap: str = ""
) -> None:
    """Add baselines and modes on one pair.

    Args:
        reference: (h, w, 3) uint8 the photograph. runs: of the time measurement; 0 measures none.
        remap: what the pair is called; "" takes its remap.
    """
    keys = {"section": pair.section.name, "remap": remap or pair.remap}
    worst = np.inf
    if not remap:
        trivial = baselines(pair)
        for name in _BASELINES:
            _add(suite, {**keys, "method": name}, np.dstack([_scan_lightness(pair), trivial[name]]), pair, pair.mask)
        worst = color_errors(trivial["mean colour"], pair).mean
    matches: dict[tuple, Matched | None] = {}
    matching: dict = {}
    for mode in lines:
        if mode.match not in matches:
            matches[mode.match] = matched = _match(suite, pair, reference, mode, keys)
            if matched is not None and runs:
                matching[mode.match] = timed(matched.match, runs, warm=True)[1]
        matched = matches[mode.match]
        if matched is None:
            continue
        row = {**keys, "features": mode.method.features, "method": mode.name}
        mean = _add(suite, row, matched.colored(mode.transfer), pair, matched.body)
        if runs and mean < worst:
            transfer = timed(lambda m=matched, t=mode.transfer: m.colored(t), runs, warm=True)[1]
            _set_times(
                suite.tables["improvements"], suite_pipeline.summed_seconds(matching[mode.match], transfer).columns()
            )
        elif runs:
            reason = f"error {mean:.2f} is not below the mean colour's {worst:.2f}"
            suite.failures.append((f"time of {mode.method.features}, {mode.name}", reason))


def _match(suite: Suite, pair: Pair, reference: np.ndarray, mode: Mode, keys: dict) -> Matched | None:
    try:
        return Matched(pair.volume, reference, mode.method, confidence=mode.trusted)
    except MedColorError as error:
        what = f"{mode.method.features} {mode.name} on {keys['section']}, {keys['remap']}"
        suite.failures.append((what, str(error)))
        return None


def _scan_lightness(pair: Pair) -> np.ndarray:
    from ..color.lab import gray_to_lightness

    return gray_to_lightness(pair.grey)


def _add(suite: Suite, keys: dict, lab: np.ndarray, pair: Pair, body: np.ndarray) -> float:
    errors = color_errors(lab[..., 1:], pair)
    measured = {"mean": errors.mean, "p95": errors.p95, "worst_patch": errors.worst_patch}
    seen = {"spill": color_spill(lab[..., 1:], pair), "dark_share": dark_share(lab[..., 0], pair, body)}
    suite.tables["improvements"].add(**keys, **measured, **seen)
    return errors.mean


def _set_times(table: Table, times: dict) -> None:
    first = table.columns.index(TIME_COLUMNS[0])
    table.rows[-1] = (
        *table.rows[-1][:first],
        *(float(f"{times[name]:.6g}") for name in TIME_COLUMNS[:3]),
        times["runs"],
    )


def _share_times(table: Table) -> None:
    """A mode takes the same time on every pair; it was measured on the first one."""
    first, keys = table.columns.index(TIME_COLUMNS[0]), slice(2, 4)
    known = {row[keys]: row[first:] for row in table.rows if row[first] is not None}
    table.rows = [(*row[:first], *known.get(row[keys], row[first:])) for row in table.rows]


def beaten(improvements: Table) -> Table:
    """For every pair and features: does the default beat the paper's mode and every baseline?"""
    table = Table(BEATEN_COLUMNS)
    for row in improvements.where(method=DEFAULT):
        keys = {name: row[name] for name in ("section", "remap")}
        paper = improvements.where(**keys, features=row["features"], method=PAPER)
        trivial = [line for name in _BASELINES for line in improvements.where(**keys, method=name)]
        if not paper or not trivial:
            continue
        best = min(trivial, key=lambda line: line["mean"])
        table.add(
            **keys,
            features=row["features"],
            default=row["mean"],
            paper=paper[0]["mean"],
            best_baseline=best["mean"],
            baseline=best["method"],
            met=row["mean"] < min(paper[0]["mean"], best["mean"]),
        )
    return table
