"""All measures on real images in one table: the defaults, the other luminances, and the trivial methods beside them.

A measure is a function of `colorize`, the folder of the real images and settings that gives `Figure`s. To add one, write it
in a module of its own and name it in `MEASURES`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from ..errors import MedColorError
from ..features import choose_features
from ..parameters import Settings
from ..pipeline import colorize
from ..progress import Progress
from . import chroma_pairs, detail, front_back, seen, slab_ends, trivial, wrong_references
from .tables import Suite, Table

COLUMNS = ("measure", "what", "method", "features", "value", "worst", "limit", "limit_worst", "met")
REGION_COLUMNS = (
    "measure", "method", "features", "region", "lightness", "a", "b", "true_lightness", "true_a", "true_b", "gain", "error",
)  # fmt: skip
WARNING_COLUMNS = ("volume", "picture", "right", "noticed", "said")

DEFAULT = "default"
AT_LEAST = ("detail, correlation", "chest CT, fat to muscle", "wrong references warned of")  # better the larger
JUDGED = (DEFAULT, trivial.REFERENCE_END)  # what is promised, is promised of the defaults
OF_REFERENCE_END = ("CT slice 122", "pairs seen")  # and some of the slider's end
SEEN_BARS = ("CT slice 122", "chest CT", "pairs seen", "front against back")  # of the diagram

NOTES = [
    "seen: measures on real images, whole CIEDE2000 of the final sRGB unless said otherwise. 'default' is the default "
    "settings, 'keep' and 'paper' the same with that luminance; the look-up table and the histogram match give every grey one "
    "colour. limit: what the defaults are to reach; for correlation, fat to muscle and wrong references at least that. The "
    "slider at the reference's end has limits of its own on CT slice 122 and on the pairs.",
    "CT slice 122, chest CT: the median colour of each region or tissue against the photograph's, with one exposure gain in "
    "linear light for all regions (photograph times gain, 1/4 to 4, the smallest mean counts); value: mean of the regions, "
    "worst: the worst region. Regions of the head are drawn by hand on both pictures; tissues of the chest CT are found by "
    "Hounsfield units and depth, the photograph's are drawn. 'fat to muscle' is CIEDE2000 between the two in the result; in the "
    "photograph it is 50.",
    "pairs seen: the thorax photograph mirrored, warped, and grey; two-to-one is |2 g - 1|; worst: mean of the worst patch of "
    "16 x 16. One exposure gain is free here, too; 'exposure as it is' is without.",
    "chroma pairs: a*, b* before they are drawn into the gamut with the true luminance, thorax and head, as it is, strong, "
    "extreme and inverted, three seeds; the look-up table beside it gives a*, b* alone.",
    "detail: " + " ".join(detail.__doc__.split("\n\n")[2].split()),
    "front against back: frontal and occipital lobes drawn by hand; for every step of one L* of the result that both hold, "
    "CIEDE2000 between their mean a*, b*; 'at equal grey' the same for steps of the scan's L*, lightness included.",
    "slab ends: chest CT, mean CIEDE2000 over the body of a slice when both ends of the slab move by two slices; worst: worst "
    "slice.",
    "wrong references: ten slices of every volume after both photographs and after pictures of wood, a mosaic and bread by "
    "formula; a picture that is refused with an error counts as noticed. The table reference_warnings has every case.",
]


@dataclass(frozen=True)
class Figure:
    """One number of a measure, and what the defaults are to reach.

    Attributes:
        measure: see NOTES. what: image, remap or volume. worst: of regions, patches or slices, where there is one.
        limit, limit_worst: at most that, or at least (AT_LEAST); None where nothing was promised.
    """

    measure: str
    what: str
    value: float
    worst: float | None = None
    limit: float | None = None
    limit_worst: float | None = None

    @property
    def met(self) -> bool | None:
        """None without a limit."""
        if self.limit is None:
            return None
        good = self.value >= self.limit if self.measure in AT_LEAST else self.value <= self.limit
        return good and (self.limit_worst is None or self.worst <= self.limit_worst)


Measure = Callable[["Run"], Iterator[Figure]]


@dataclass(frozen=True)
class Run:
    """One method on the real images.

    Attributes:
        name: "default" or key of `trivial.METHODS`. quick: fewer cases.
        suite: takes tables with single cases.
    """

    name: str
    colorize: seen.Colorize
    data: Path
    settings: Settings
    suite: Suite
    quick: bool = False

    @property
    def features(self) -> str:
        """ "" for the trivial methods, which have none."""
        return trivial.features_of(self.name, self.settings)


def head_ct(run: Run) -> Iterator[Figure]:
    """CT slice 122 against the photograph of its level."""
    result = seen.head_ct(run.colorize, run.data, run.settings)
    _add_regions(run, "CT slice 122", result)
    target = seen.HEAD_TARGET_REFERENCE if run.name == trivial.REFERENCE_END else seen.HEAD_TARGET
    yield from _by_regions("CT slice 122", f"{len(result.errors)} regions", result, target)


def chest_ct(run: Run) -> Iterator[Figure]:
    """Chest CT against the thorax photograph, by tissue."""
    result = seen.chest_ct(run.colorize, run.data, run.settings)
    _add_regions(run, "chest CT", result)
    yield from _by_regions("chest CT", f"{len(result.errors)} tissues", result, seen.CHEST_TARGET)
    yield Figure("chest CT, fat to muscle", "result", result.fat_to_muscle, limit=seen.FAT_TO_MUSCLE_TARGET)


def _by_regions(measure: str, what: str, result: seen.Regions, target: tuple[float, float]) -> Iterator[Figure]:
    yield Figure(measure, what, result.seen.mean, result.seen.worst, *target)
    yield Figure(measure, f"{what}, exposure as it is", result.seen.mean_as_it_is, result.seen.worst_as_it_is)


def _add_regions(run: Run, measure: str, result: seen.Regions) -> None:
    table = run.suite.tables.setdefault("seen_regions", Table(REGION_COLUMNS))
    names = ("lightness", "a", "b")
    for region, error in result.errors.items():
        got = dict(zip(names, result.got[region]))
        true = {f"true_{name}": value for name, value in zip(names, result.true[region])}
        keys = {"measure": measure, "method": run.name, "features": run.features, "region": region}
        table.add(**keys, **got, **true, gain=result.seen.gain, error=error)


def pairs_seen(run: Run) -> Iterator[Figure]:
    """Thorax pairs, lightness included; the limits are those of the slider at the reference's end."""
    remaps = ("as it is", "inverted") if run.quick else tuple(seen.SEEN_REMAPS)
    for remap, result in seen.thorax_pairs(run.colorize, run.data, run.settings, remaps=remaps).items():
        limit = None if run.name == DEFAULT else seen.PAIR_TARGETS[remap]
        yield Figure("pairs seen", remap, result.mean, result.worst, limit)
        yield Figure("pairs seen", f"{remap}, exposure as it is", result.mean_as_it_is, result.worst_as_it_is)


def details(run: Run) -> Iterator[Figure]:
    """The scan's own detail in the result."""
    for name, measure in (("MR head", detail.mr_head), ("CT head", detail.ct_head)):
        result = measure(run.colorize, run.data, run.settings)
        yield Figure("detail, correlation", name, result.correlation, limit=detail.TARGETS[name])
        yield Figure("detail, noise", name, result.noise)
        yield Figure("detail, halo", name, result.halo)


def lobes(run: Run) -> Iterator[Figure]:
    """Front against back of one brain."""
    for name in front_back.LOBES:
        result = front_back.front_back(run.colorize, run.data, name, run.settings)
        yield Figure("front against back", name.split(".")[0], result.same_lightness, limit=front_back.TARGET)
        yield Figure("front against back", f"{name.split('.')[0]}, at equal grey", result.same_grey)


def chroma(run: Run) -> Iterator[Figure]:
    """Colour alone on pairs, several seeds; through the stages, so for the pipeline's own colours and the table alone."""
    if run.name == "look-up table":
        result = chroma_pairs.looked_up(run.data)
    else:
        result = chroma_pairs.chroma_pairs(run.settings.features, run.data, run.settings.preset)
    yield Figure("chroma pairs", "mean", result.mean, limit=chroma_pairs.TARGET)
    for (section, remap), error in result.pairs.items():
        yield Figure("chroma pairs", f"{section}, {remap}", error)


def slabs(run: Run) -> Iterator[Figure]:
    """Colours of a slab whose ends move."""
    result = slab_ends.slab_ends(run.colorize, run.data, run.settings)
    yield Figure(
        "slab ends", f"{len(result.slabs)} slabs", result.mean, result.worst, slab_ends.TARGET, slab_ends.TARGET
    )
    for (first, stop), (mean, worst) in result.slabs.items():
        yield Figure("slab ends", f"slices {first}:{stop}", mean, worst)


def warnings(run: Run) -> Iterator[Figure]:
    """Wrong references are noticed, right ones are not warned of."""
    cases = wrong_references.wrong_references(run.colorize, run.data, run.settings)
    table = run.suite.tables["reference_warnings"] = Table(WARNING_COLUMNS)
    for case in cases:
        table.add(**vars(case))
    noticed, wronged = wrong_references.rates(cases)
    wrong = sum(not case.right for case in cases)
    yield Figure("wrong references warned of", f"{wrong} cases", noticed, limit=1.0)
    yield Figure("right references warned of", f"{len(cases) - wrong} cases", wronged, limit=0.0)


# measure -> the methods it is run for. Clear tissue left black, and table and noise that are coloured, belong here, too.
_ALL = (DEFAULT, *trivial.METHODS)
MEASURES: dict[Measure, tuple[str, ...]] = {
    head_ct: _ALL,
    chest_ct: _ALL,
    pairs_seen: _ALL,
    details: _ALL,
    lobes: _ALL,
    chroma: (DEFAULT, "look-up table"),
    slabs: (DEFAULT,),
    warnings: (DEFAULT,),
}
_QUICK: dict[Measure, tuple[str, ...]] = {head_ct: (DEFAULT, "look-up table"), pairs_seen: (DEFAULT, "look-up table")}


def run(suite: Suite, data: Path | None, quick: bool, progress: Progress) -> None:
    """Add the tables `seen`, `seen_regions` and `reference_warnings` to the suite, where the real images are."""
    missing = seen.missing_files(data)
    if missing:
        suite.failures.append(("measures on real images", f"not here: {', '.join(missing)} (--data)"))
        return
    suite.notes.extend(NOTES)
    table = suite.tables["seen"] = Table(COLUMNS)
    settings = Settings(features="embedded" if quick else choose_features(Settings().features))
    jobs = [(measure, name) for measure, names in (_QUICK if quick else MEASURES).items() for name in names]
    for number, (measure, name) in enumerate(jobs):
        progress(number / len(jobs), f"seen: {measure.__name__.replace('_', ' ')}, {name}")
        own = Run(name, trivial.METHODS.get(name, colorize), data, settings, suite, quick)
        try:
            for figure in measure(own):
                _add(table, own, figure)
        except MedColorError as error:
            suite.failures.append((f"seen: {measure.__name__.replace('_', ' ')}, {name}", str(error)))
    if not table.rows:
        del suite.tables["seen"]


def _add(table: Table, run: Run, figure: Figure) -> None:
    judged = run.name in JUDGED and (run.name == DEFAULT or figure.measure in OF_REFERENCE_END)
    table.add(method=run.name, features=run.features, met=figure.met if judged else None, **vars(figure))
