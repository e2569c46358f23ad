"""The benchmark from end to end: measure, check, write JSON, pictures and one HTML page."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable
from pathlib import Path

from .. import __version__
from ..errors import InputError, MissingPackageError, OutputError
from ..progress import Progress
from .pairs import Section, load_sections
from .tables import Suite

_DATA = Path(__file__).resolve().parents[3] / "shared" / "data"  # beside a checkout of the repository
# share of the run time, for the progress bar
_SHARES = {"pipeline": 0.62, "smoothing": 0.1, "correspondence": 0.13, "features": 0.05, "stability": 0.1}


def run_bench(
    folder: str | Path,
    quick: bool = False,
    stability: bool = False,
    data: str | Path | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> list[Path]:
    """Measure and write the report.

    Args:
        folder: for bench.json, bench.html and the PNG files; made if missing.
        quick: fewer points and repeats, about two minutes on two cores.
        stability: only the stability table.
        data: folder with the Visible Human photographs and CT; None takes ../shared/data beside the repository, else the
            section made by formula alone.

    Returns:
        The files written, the page first.

    Raises:
        InputError: `data` holds none of the pictures.
        OutputError: the folder cannot be written.
        MissingPackageError: matplotlib is not installed.
    """
    _require_matplotlib()
    folder = _folder(Path(folder))
    progress = progress or (lambda _fraction, _text: None)
    source = _data_folder(data)
    sections = [] if stability else load_sections(source)
    load_before = _load()
    suites, seconds = _run_suites(_suites(sections, source, quick, stability, seed), progress)
    options = {"quick": quick, "stability": stability, "seed": seed, "sections": [section.name for section in sections]}
    return _write(folder, suites, seconds, options, load_before)


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


def _suites(sections: list[Section], data: Path | None, quick: bool, only_stability: bool, seed: int):
    """Name -> function of progress that measures the suite."""
    from . import stability, suite_correspondence, suite_features, suite_pipeline, suite_smoothing

    if only_stability:
        return {"stability": stability.run}

    def correspondence(progress: Progress) -> Suite:
        from ..features import make_extractor

        names = ("vgg19", "embedded") if suite_pipeline.has_network() else ("embedded",)
        extractors = [make_extractor(name, "cpu") for name in (names[:1] if quick else names)]
        pairs = sections[:1] if quick else sections[:1] + sections[1:][-1:]
        return suite_correspondence.run(pairs, extractors, quick, seed, progress)

    return {
        "pipeline": lambda progress: _pipeline(sections, data, quick, seed, progress),
        "smoothing": lambda progress: suite_smoothing.run(sections[0], quick, seed, progress),
        "correspondence": correspondence,
        "features": lambda progress: suite_features.run(sections[0], quick, seed, progress),
        "stability": stability.run,
    }


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
    total = sum(_SHARES[name] for name in suites)
    results, seconds, done = {}, {}, 0.0
    for name, run in suites.items():
        share, start = _SHARES[name] / total, time.perf_counter()
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
    from .summary import TARGET_COLUMNS, targets
    from .tables import Table

    table = targets(suites["pipeline"]) if "pipeline" in suites else Table(TARGET_COLUMNS)
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
    temporary = path.with_name(f".{path.name}.part")
    try:
        temporary.write_bytes(content)
        os.replace(temporary, path)
    except OSError as error:
        raise OutputError(f"bench: {path} cannot be written ({error.strerror})") from error
    finally:
        temporary.unlink(missing_ok=True)
    return path
