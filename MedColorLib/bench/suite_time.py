"""Suite *time*: error against run time on scans of all kinds, lightness included as a viewer sees it, and of colour alone."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ..errors import MedColorError
from ..parameters import Settings
from ..pipeline import colorize
from ..progress import Progress
from ..volume import ColorVolume, Volume
from . import seen, trivial
from .measures import DEFAULT
from .pairs import Section
from .suite_pipeline import has_network
from .tables import TIME_COLUMNS, Suite, Table, seconds_of

COLUMNS = ("scan", "method", "features", "seen", "chroma", *TIME_COLUMNS)
PAIRS, HEAD, CHEST = "pairs with known colours", "CT head, slice 122", "chest CT"
PORT = "public port of deep image analogy"
_PORT_ERRORS, _PORT_S = (4.0, 5.3), 244.0  # a thorax pair as it is, and with two greys made one; CPU seconds a picture

NOTES = [
    "seen: mean CIEDE2000 of the final sRGB, lightness included; chroma: the same with the photograph's lightness put in, so of "
    "a* and b* alone. One exposure gain, the one that is best for 'seen', is free in both.",
    "Pairs: means over the first photograph mirrored, warped and seen in grey as it is, by g^0.6, |2 g - 1| and 1 - g. CT head: "
    "ten regions against the photograph of their level. Chest CT: five tissues against the thorax photograph.",
    "Seconds of a processor's core a slice, so that neither the number of cores nor what else the machine does counts: those of "
    "the call times the share of its time that goes to single slices. Finding the body, and what is learned once a volume, are "
    "left out. Of the pairs the median of four slices, of the CTs one run of 9 and of 18 slices of 512 x 512.",
    "'paper's preset' is the preset full with the paper's luminance and VGG-19; 'reference's lightness' and 'scan's "
    "lightness' are the default with its slider at the end, and with --luminance keep.",
    f"The {PORT} (Ben-Louis, loops compiled, 20 iterations of L-BFGS) was measured on a thorax pair as it is and with two greys "
    f"made one, {_PORT_ERRORS[0]} and {_PORT_ERRORS[1]}, {_PORT_S:g} CPU seconds; its point is their mean. It has no lightness "
    "of its own.",
]


@dataclass(frozen=True)
class Way:
    """One point of the diagram."""

    name: str
    settings: Settings
    colorize: seen.Colorize = colorize

    @property
    def features(self) -> str:
        """ "" for the trivial methods, which have none."""
        return trivial.features_of(self.name, self.settings)


@dataclass
class Stopped:
    """A method that notes the seconds of a core that it takes a slice, without what is done once a volume."""

    way: Way
    seconds: list[float] = field(default_factory=list)

    def __call__(self, volume: Volume, references: list, settings: Settings) -> ColorVolume:
        start = time.process_time()
        result = self.way.colorize(volume, references, settings)
        taken, stages = time.process_time() - start, result.report["seconds"]
        share = 1 - (stages["prepare"] + stages["network"]) / stages["total"]
        self.seconds.append(taken * share / len(volume.array))
        return result


def ways(quick: bool, with_network: bool) -> list[Way]:
    """The methods that are compared."""
    own = Settings(features="embedded")
    found = [
        Way("look-up table", own, trivial.look_up_table),
        Way("histogram match", own, trivial.histogram_match),
        Way(DEFAULT, own),
    ]
    if quick:
        return found
    found += [
        Way("draft", replace(own, preset="draft")),
        Way("reference's lightness", replace(own, lightness=1.0)),
        Way("scan's lightness", replace(own, luminance="keep")),
    ]
    if with_network:
        deep = replace(own, features="vgg19")
        found += [
            Way("default, VGG-19", deep),
            Way("paper's preset", replace(deep, preset="full", luminance="paper")),
        ]
    return found


def run(sections: list[Section], data: Path | None, quick: bool, seed: int, progress: Progress) -> Suite:
    """Measure every method on every scan."""
    table = Table(COLUMNS)
    suite = Suite({"against_time": table}, notes=list(NOTES))
    with_network = has_network()
    if not with_network and not quick:
        suite.failures.append(("VGG-19 and the paper's preset", "no weights here; run 'medcolor weights fetch'"))
    scans = _scans(sections[0], data, quick, seed)
    if len(scans) == 1 and not quick:
        suite.failures.append((f"{HEAD}, {CHEST}", "the real images are not here (--data)"))
    jobs = [(scan, way) for scan in scans for way in ways(quick, with_network)]
    for number, (scan, way) in enumerate(jobs):
        progress(number / len(jobs), f"time: {scan}, {way.name}")
        stopped = Stopped(way)
        try:
            results = scans[scan](stopped, way.settings)
        except MedColorError as error:
            suite.failures.append((f"{way.name} on {scan}", str(error)))
            continue
        errors = {name: float(np.mean([getattr(one, name) for one in results])) for name in ("mean", "chroma")}
        seconds = seconds_of(stopped.seconds[-len(results) :])  # what came before was the warm-up
        table.add(
            scan=scan,
            method=way.name,
            features=way.features,
            seen=errors["mean"],
            chroma=errors["chroma"],
            **seconds.columns(),
        )
    if not quick:
        table.add(scan=PAIRS, method=PORT, chroma=float(np.mean(_PORT_ERRORS)), seconds=_PORT_S)
    return suite


def _scans(section: Section, data: Path | None, quick: bool, seed: int) -> dict[str, Callable]:
    """Scan -> function of a method and its settings that gives `seen.Seen`s; of the pairs the first call is a warm-up."""

    def pairs(method: seen.Colorize, settings: Settings) -> list[seen.Seen]:
        remaps = ("as it is", "inverted") if quick else tuple(seen.SEEN_REMAPS)
        seen.seen_pair(method, section, "as it is", settings, seed)
        return [seen.seen_pair(method, section, remap, settings, seed) for remap in remaps]

    if quick or seen.missing_files(data):
        return {PAIRS: pairs}
    return {
        PAIRS: pairs,
        HEAD: lambda method, settings: [seen.head_ct(method, data, settings).seen],
        CHEST: lambda method, settings: [seen.chest_ct(method, data, settings).seen],
    }
