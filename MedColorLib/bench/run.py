"""The benchmark from end to end: measure, check, write JSON, pictures and one HTML page."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path

from .. import __version__
from ..errors import InputError, MissingPackageError, OutputError, SettingsError
from ..output import atomic_output
from ..progress import Progress
from .pairs import Section, load_sections
from .tables import Suite

_DATA = Path(__file__).resolve().parents[3] / "shared" / "data"  # beside a checkout of the repository
# in the order of the page, with a share of the run time for the progress bar
SUITES = {
    "time": 0.1,
    "pipeline": 0.3,
    "quality": 0.22,
    "smoothing": 0.04,
    "correspondence": 0.06,
    "features": 0.03,
    "profile": 0.05,
    "sidebyside": 0.05,
    "scaling": 0.1,
    "stability": 0.05,
}
_TOO_LONG_FOR_QUICK = ("scaling",)  # run there only when named


def run_bench(
    folder: str | Path,
    quick: bool = False,
    stability: bool = False,
    data: str | Path | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    suites: Sequence[str] | None = None,
) -> list[Path]:
    """Measure and write the report.

    Args:
        folder: for bench.json, bench.html and the PNG files; made if missing.
        quick: fewer points and repeats, under two minutes on two cores.
        stability: only the stability table.
        data: folder with the Visible Human photographs and CT; None takes ../shared/data beside the repository, else the
            section made by formula alone.
        suites: keys of SUITES, for some of them alone; None takes all (a quick run: all that are quick enough).

    Returns:
        The files written, the page first.

    Raises:
        InputError: `data` holds none of the pictures.
        SettingsError: a seed below 0, a suite that does not exist, or suites beside `stability`.
        OutputError: the folder cannot be written.
        MissingPackageError: matplotlib is not installed.
    """
    _require_matplotlib()
    if isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed < 2**63:
        raise SettingsError(f"bench: expected a seed from 0 to 2^63 - 1, got {seed!r}")
    chosen = _chosen(suites, quick, stability)
    folder = _folder(Path(folder))
    progress = progress or (lambda _fraction, _text: None)
    source = _data_folder(data)
    sections = [] if chosen == ("stability",) else load_sections(source)
    load_before = _load()
    runs = _suites(sections, source, quick, seed)
    measured, seconds = _run_suites({name: runs[name] for name in chosen}, progress)
    options = {"quick": quick, "stability": stability, "seed": seed, "sections": [section.name for section in sections]}
    return _write(folder, measured, seconds, options, load_before)


def _chosen(suites: Sequence[str] | None, quick: bool, stability: bool) -> tuple[str, ...]:
    """The suites to run, in the page's order."""
    if suites is None:
        whole = tuple(name for name in SUITES if not (quick and name in _TOO_LONG_FOR_QUICK))
        return ("stability",) if stability else whole
    if stability:
        raise SettingsError("bench: --stability is a suite by itself; name it among --suites or leave --suites out")
    wanted = {name.strip() for name in suites}
    unknown = sorted(wanted - set(SUITES))
    if unknown or not wanted:
        named = ", ".join(map(repr, unknown)) or "none"
        raise SettingsError(f"bench: there is no suite {named}; choose from {', '.join(SUITES)}")
    return tuple(name for name in SUITES if name in wanted)


def _require_matplotlib() -> None:
    from importlib.util import find_spec

    if find_spec("matplotlib") is None:
        raise MissingPackageError(
            "bench: matplotlib draws the plots and is not installed; run: pip install 'medcolor[bench]'"
        )


def _folder(folder: Path) -> Path:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"bench folder {folder}: cannot be made ({error.strerror})") from error
    return folder


def _data_folder(given: str | Path | None) -> Path | None:
    from .pairs import SECTIONS

    if given is None:
        return _DATA if _DATA.is_dir() else None
    if not any((Path(given) / name).is_file() for name in SECTIONS.values()):
        raise InputError(
            f"bench data {given}: none of {', '.join(SECTIONS.values())} is there; name another folder with --data"
        )
    return Path(given)


def _suites(sections: list[Section], data: Path | None, quick: bool, seed: int) -> dict[str, Callable]:
    """Name -> function of progress that measures the suite."""
    from . import stability

    def by_module(name: str, *arguments) -> Callable[[Progress], Suite]:
        suite = import_module(
            f".suite_{name}", __package__
        )  # now: what cannot run is known before the first measurement
        return lambda progress: suite.run(*arguments, quick, seed, progress)

    first = sections[0] if sections else None
    return {
        "pipeline": lambda progress: _pipeline(sections, data, quick, seed, progress),
        "time": by_module("time", sections, data),
        "quality": by_module("quality", sections, data),
        "correspondence": lambda progress: _correspondence(sections, quick, seed, progress),
        "profile": by_module("profile", first, data),
        **{name: by_module(name, first) for name in ("smoothing", "features", "sidebyside", "scaling")},
        "stability": stability.run,
    }


def _correspondence(sections: list[Section], quick: bool, seed: int, progress: Progress) -> Suite:
    from ..features import make_extractor
    from . import suite_correspondence, suite_pipeline

    names = ("vgg19", "embedded") if suite_pipeline.has_network() else ("embedded",)
    extractors = [make_extractor(name, "cpu") for name in (names[:1] if quick else names)]
    pairs = sections[:1] if quick else sections[:1] + sections[1:][-1:]
    return suite_correspondence.run(pairs, extractors, quick, seed, progress)


def _pipeline(sections: list[Section], data: Path | None, quick: bool, seed: int, progress: Progress) -> Suite:
    from . import regions, suite_pipeline
    from .summary import summarise

    chosen = [sections[0], *([sections[-1]] if len(sections) > 1 else [])] if quick else sections
    suite = suite_pipeline.run(chosen, quick, seed, lambda f, text: progress(0.9 * f, text))
    ct = regions.load_ct(data)
    head = [section for section in sections if section.name == "head"]
    if ct is not None and head:
        regions.run(suite, ct, head[0], quick, lambda f, text: progress(0.9 + 0.1 * f, text))
    else:
        suite.failures.append(
            ("CT against cryosection by region", "the CT or the photograph of the head is not here (--data)")
        )
    suite.tables = {"summary": summarise(suite.tables["errors"]), **suite.tables}
    return suite


def _run_suites(suites: dict[str, Callable[[Progress], Suite]], progress: Progress):
    total = sum(SUITES[name] for name in suites)
    results, seconds, done = {}, {}, 0.0
    for name, run in suites.items():
        share, start = SUITES[name] / total, time.perf_counter()
        results[name] = run(lambda f, text, d=done, s=share: progress(d + s * f, text))
        seconds[name] = round(time.perf_counter() - start, 1)
        done += share
    progress(1.0, "writing")
    return results, seconds


def _load() -> float | None:
    """Runnable processes, averaged over a minute; None where the platform does not tell."""
    return round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None


def _cpu() -> str:
    """Model of the processor."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as lines:
            names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    except OSError:
        names = []
    return names[0] if names else platform.processor() or "unknown processor"


def _write(
    folder: Path, suites: dict[str, Suite], seconds: dict, options: dict, load_before: float | None
) -> list[Path]:
    from ..report import environment
    from .page import make_page
    from .plots import draw_all
    from .schema import SCHEMA, check_results, to_text
    from .summary import all_targets

    table = all_targets(suites)
    data = {
        "schema": SCHEMA,
        "medcolor": __version__,
        "options": options,
        "environment": {**environment("cpu"), "cpu": _cpu(), "load_before": load_before, "load_after": _load()},
        "targets": table.to_dict(),
        "suites": {name: {**suite.to_dict(), "seconds": seconds[name]} for name, suite in suites.items()},
    }
    check_results(data)
    pictures = draw_all(suites)
    files = {"bench.html": make_page(data, pictures).encode(), "bench.json": to_text(data).encode()}
    files.update({f"{name}.png": png for name, png in pictures.items()})
    return [_write_file(folder / name, content) for name, content in files.items()]


def _write_file(path: Path, content: bytes) -> Path:
    with atomic_output(path) as temporary:
        temporary.write_bytes(content)
    return path
