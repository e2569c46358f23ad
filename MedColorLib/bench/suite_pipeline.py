"""Suite *pipeline*: colour error of the whole way against its run time, on pairs with known colours."""

from __future__ import annotations

from dataclasses import dataclass

from ..errors import MedColorError
from ..features.weights import find_weights
from ..parameters import PRESETS
from ..progress import Progress
from .matched import Matched, Method
from .pairs import REMAPS, Pair, Section, make_pair
from .quality import Errors, baselines, color_errors
from .tables import TIME_COLUMNS, Seconds, Suite, Table, timed

KEYS = ("section", "remap", "features", "method", "smoother", "gamma")
COLUMNS = (*KEYS, "mean", "p95", "worst_patch", *TIME_COLUMNS)
CALL_COLUMNS = ("features", "method", "what", *TIME_COLUMNS)

NOTES = [
    "CIEDE2000 inside the body, with the true luminance and the result's a*, b* before they are drawn into the gamut.",
    "The target is the section mirrored and warped by up to 3 %, its grey kept or remapped; the section is the reference.",
    "Baselines: no colour, the reference's mean colour, its colour at the same position, and a look-up table from L* to "
    "a*, b* after a histogram match. 'Perfect match' takes the true colours as matched: what remains is the transfer.",
    "With gamma the chroma depends on the target's own luminance, so on remapped targets even a perfect match is off.",
    "Seconds: features, matching and transfer of one slice of 256 x 256, the reference prepared before; median and "
    "quartiles after a warm-up. They count only where the error is below that of the mean colour.",
]


@dataclass(frozen=True)
class Variant:
    """How matched colours are transferred."""

    smoother: str
    gamma: bool


def methods(quick: bool, with_network: bool) -> list[Method]:
    """Points on the curve: the presets, layers at which matching stops, reconstruction."""
    found = []
    for features in ("vgg19", "embedded") if with_network else ("embedded",):
        found += [Method(features, "draft"), Method(features, "balanced")]
        if features == "vgg19" or not quick or not with_network:
            found.append(Method(features, "full"))
        if quick or features == "embedded":  # one layer, without context
            continue
        found += [Method(features, "balanced", stop_layer=layer) for layer in (5, 4, 2, 1)]
        found.append(Method(features, "balanced", context=False))
        found.append(Method(features, "balanced", whole_features=True))
        found.append(Method(features, "balanced", reconstruction="lbfgs"))
        found.append(Method(features, "full", reconstruction="lbfgs"))
    return found


def has_network() -> bool:
    """Whether VGG-19's weights are here."""
    return find_weights("vgg19") is not None


def run(sections: list[Section], quick: bool, seed: int, progress: Progress) -> Suite:
    """Colour every pair by every method."""
    errors, calls = Table(COLUMNS), Table(CALL_COLUMNS)
    suite = Suite({"errors": errors, "calls": calls}, notes=list(NOTES))
    with_network = has_network()
    if not with_network:
        suite.failures.append(
            ("features vgg19", "no weights here; run 'medcolor weights fetch' or set MEDCOLOR_WEIGHTS")
        )
    jobs = _jobs(sections, quick, with_network)
    for number, (section, remap, method) in enumerate(jobs):
        progress(number / len(jobs), f"{section.name}, {remap}: {method.features if method else 'baselines'}")
        pair = make_pair(section, remap, seed)
        if method is None:
            _add_baselines(errors, pair)
            continue
        try:
            _add_method(suite, pair, method, quick, times=section is sections[0] and remap == "as it is")
        except MedColorError as error:
            suite.failures.append((f"{method.features} {method.label} on {section.name}, {remap}", str(error)))
    _share_times(errors)
    return suite


def _jobs(sections, quick, with_network):
    """(section, remap, method or None for baselines). Deep methods take long and see fewer pairs."""
    jobs = []
    for section in sections:
        for remap in REMAPS:
            jobs.append((section, remap, None))
            for method in methods(quick, with_network):
                if _is_worth(method, remap, section is sections[0], quick):
                    jobs.append((section, remap, method))
    return jobs


def _is_worth(method: Method, remap: str, on_first: bool, quick: bool) -> bool:
    deep = method.preset == "full" or method.stop_layer in (1, 2)
    if quick:
        return on_first and remap == "as it is" if deep else on_first or method.features == "embedded"
    if method.reconstruction == "lbfgs":
        return on_first and remap in ("as it is", "strong")
    if not deep:
        return True
    if method.label == "full" and method.features == "vgg19" and on_first:
        return True
    return remap in ("as it is", "strong", "inverted") and (on_first or method.label == "full")


def _variants(method: Method, remap: str, quick: bool) -> list[Variant]:
    if method.label not in PRESETS:
        return [Variant("regression", False), Variant("fgs", True)]
    found = [Variant(smoother, gamma) for smoother in ("regression", "fgs") for gamma in (False, True)]
    found += [Variant("guided", False), Variant("domain-transform", False)]
    if remap == "as it is" and not (quick and method.preset != "balanced"):
        found.append(Variant("wls", False))
    return found


def _add_baselines(table: Table, pair: Pair) -> None:
    keys = {"section": pair.section.name, "remap": pair.remap}
    for name, chroma in baselines(pair).items():
        table.add(**keys, method=name, **_error_columns(color_errors(chroma, pair)))
    matched = Matched(pair.volume, pair.section.rgb, Method("embedded", "balanced"))
    matched.use_truth(pair.truth)
    for variant in (Variant(s, g) for s in ("regression", "fgs") for g in (False, True)):
        errors = color_errors(matched.chroma(variant.smoother, variant.gamma), pair)
        table.add(**keys, method="perfect match", **vars(variant), **_error_columns(errors))


def _add_method(suite: Suite, pair: Pair, method: Method, quick: bool, times: bool) -> None:
    matched = Matched(pair.volume, pair.section.rgb, method)
    deep = method.preset == "full"
    runs = 1 if quick and deep else 3 if quick else 5
    matching = timed(matched.match, runs, warm=True)[1] if times else None
    worst = color_errors(baselines(pair)["mean colour"], pair).mean
    keys = {"section": pair.section.name, "remap": pair.remap, "features": method.features, "method": method.label}
    for variant in _variants(method, pair.remap, quick):
        errors = color_errors(matched.chroma(variant.smoother, variant.gamma), pair)
        seconds = {}
        if matching and errors.mean >= worst:
            name = f"time of {method.features} {method.label}, {variant.smoother}"
            suite.failures.append((name, f"error {errors.mean:.2f} is not below the mean colour's {worst:.2f}"))
        elif matching:
            transfer = timed(lambda v=variant: matched.chroma(v.smoother, v.gamma), runs)[1]
            seconds = summed_seconds(matching, transfer).columns()
        suite.tables["errors"].add(**keys, **vars(variant), **_error_columns(errors), **seconds)
    if times and method.label in PRESETS and not (quick and deep):
        _add_call(suite.tables["calls"], pair, method, runs)


def _add_call(table: Table, pair: Pair, method: Method, runs: int) -> None:
    """Time the public call: a volume of one slice with everything that comes before and after."""
    from ..pipeline import colorize

    seconds = timed(lambda: colorize(pair.volume, [pair.section.rgb], method.settings()), runs)[1]
    table.add(
        features=method.features, method=method.label, what="colorize(), volume of one slice", **seconds.columns()
    )


def summed_seconds(a: Seconds, b: Seconds) -> Seconds:
    """Median and quartiles of two steps that follow each other."""
    return Seconds(a.median + b.median, a.low + b.low, a.high + b.high, min(a.runs, b.runs))


def _error_columns(errors: Errors) -> dict[str, float]:
    return {"mean": errors.mean, "p95": errors.p95, "worst_patch": errors.worst_patch}


def _share_times(table: Table) -> None:
    """A method takes the same time on every pair; it was measured on the first one."""
    at = [table.columns.index(name) for name in (*KEYS[2:], *TIME_COLUMNS)]
    known = {
        tuple(row[i] for i in at[:4]): tuple(row[i] for i in at[4:]) for row in table.rows if row[at[4]] is not None
    }
    for number, row in enumerate(table.rows):
        times = known.get(tuple(row[i] for i in at[:4]))
        if times:
            table.rows[number] = (*row[: at[4]], *times)
