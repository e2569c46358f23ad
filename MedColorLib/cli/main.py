"""The command line `medcolor`: parse, call the library, one clear line for what went wrong.

Exit status: 0 done, 1 some volumes of a batch failed (its table says which and why), 2 bad input or arguments, 130
interrupted. Nothing half-written is left in any case.
"""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from ..errors import Cancelled, MedColorError
from ..parameters import Settings
from .guard_options import guard_of
from .options import make_parser

INTERRUPTED = "interrupted; nothing was written"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")  # names of files that are not UTF-8, terminals that are ASCII
    arguments = make_parser().parse_args(argv)
    # Threads that wait give their core away: the pipeline's tests took 16 s instead of 52 s beside other programs.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    logging.basicConfig(level=logging.DEBUG if arguments.verbose else logging.WARNING, format="medcolor: %(message)s")
    try:
        return _RUN[arguments.run](arguments) or 0
    except MedColorError as error:
        print(f"medcolor: {error}", file=sys.stderr)
        return 2
    except (KeyboardInterrupt, Cancelled):
        print(f"medcolor: {getattr(arguments, 'interrupted', INTERRUPTED)}", file=sys.stderr)
        return 130
    except BrokenPipeError:  # the reader of our output went away, as `| head` does
        return 0


def _settings(arguments) -> Settings:
    names = (
        "preset",
        "features",
        "smoother",
        "luminance",
        "lightness",
        "reconstruction",
        "slices",
        "body",
        "plane",
        "device",
        "seed",
        "exposure",
        "reference_masks",
    )
    options = {name: getattr(arguments, name) for name in names}
    options["smoother_options"] = dict(arguments.smoother_option) if arguments.smoother_option else None
    ranges = arguments.region
    options["region"] = (ranges[0:2], ranges[2:4], ranges[4:6]) if ranges else None
    options["coherence_mm"] = arguments.coherence
    window = tuple(arguments.window) if arguments.window else None
    return Settings(**options, gamma={"on": True, "off": False}.get(arguments.gamma), window=window)


def _resume_bytes(arguments) -> int:
    from ..errors import SettingsError

    if not 0 <= arguments.resume_limit < float("inf"):
        raise SettingsError(f"--resume-limit: expected 0 GB or more, got {arguments.resume_limit:g}")
    return round(arguments.resume_limit * 1e9)


def _colorize(arguments) -> None:
    from ..io.files import check_output_path, file_sha256, read_volume, write_color_volume, write_confidence
    from ..pipeline import colorize
    from ..report import write_report
    from ..run.resume import Resume, forget_run

    settings = replace(_settings(arguments), confidence=arguments.confidence is not None)
    resume = Resume(max_bytes=_resume_bytes(arguments)) if arguments.resume else False
    if not arguments.plan:
        _check_outputs(arguments, check_output_path)
    volume, guard = read_volume(arguments.input, volume=arguments.number), guard_of(arguments)
    _say_notes(volume)
    if arguments.plan:
        _print_plan(volume, arguments.reference, settings, resume, guard)
        return
    if resume:
        arguments.interrupted = f"{INTERRUPTED}; the same command goes on from there (--resume)"
    with _Bar("colouring") as bar:
        result = colorize(volume, arguments.reference, settings, progress=bar, resume=resume, guard=guard)
    result.report["input"]["file_sha256"] = file_sha256(arguments.input)
    write_color_volume(result, arguments.output)
    if arguments.confidence:
        write_confidence(result, arguments.confidence)
    if arguments.report:
        write_report(result.report, arguments.report)
    forget_run(result.report, resume)
    for credit in sorted({r["credit"] for r in result.report["references"] if r["credit"]}):
        print(f"References: {credit}.")
    seconds = result.report["seconds"]["total"]
    resumed = result.report["resumed_slices"]
    if resumed:
        print(f"{resumed} slices were matched in an interrupted run before and were taken from there.")
    print(
        f"{arguments.output}: {len(result.report['plan']['slices'])} slices with {result.report['plan']['features']} "
        f"features in {seconds:.1f} s. The colours are an illustration, not a measurement."
    )


def _say_notes(volume) -> None:
    """What the reader decided."""
    for note in volume.notes:
        print(f"medcolor: {volume.name}: {note}", file=sys.stderr)


def _info(arguments) -> None:
    from ..io.files import list_volumes

    choices, notes = list_volumes(arguments.input)
    rows = [("volume", "size", "spacing (mm)", "what")]
    for number, choice in enumerate(choices, 1):
        size = " x ".join(map(str, choice.size))
        spacing = " x ".join(f"{step:.4g}" for step in choice.spacing_mm)
        rows.append((str(number), size, spacing or "not known", choice.label))
    widths = [max(map(len, column)) for column in zip(*rows)]
    for row in rows:
        print("  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths)).rstrip())
    for note in notes:
        print(note)
    if len(choices) > 1:
        print("Number 1 is read unless --volume N says otherwise.")


def _batch(arguments) -> int:
    from ..cohort.batch import SUMMARY, run_batch

    settings, resume_bytes = _settings(arguments), _resume_bytes(arguments)
    where = {"workers": arguments.workers, "scheduler": arguments.scheduler, "resume_bytes": resume_bytes}
    with _Bar("batch") as bar:
        result = run_batch(arguments.input, arguments.reference, arguments.output, settings, **where, progress=bar)
    print(result.text())
    count = len(result.outcomes)
    print(f"{count - result.failed} of {count} volumes are finished; see {arguments.output / SUMMARY}")
    return 1 if result.failed else 0


def _print_plan(volume, references, settings, resume, guard) -> None:
    from ..pipeline import make_plan
    from ..run.estimate import estimate

    print(make_plan(volume, references, settings, resume, guard).text())
    expected = estimate(volume, references, settings, guard)
    print(f"Time on this machine: {expected.text()}")
    print(f"Colour error to expect: {expected.error_text()}")


def _check_outputs(arguments, check_output_path: Callable) -> None:
    from ..errors import SettingsError

    if not arguments.output:
        raise SettingsError("colorize: name the result with -o OUT.nrrd (or use --plan)")
    taken = {Path(arguments.input).resolve(): "the input"}
    for path, role in ((arguments.output, "the result"), (arguments.confidence, "the confidence")):
        if not path:
            continue
        check_output_path(path)
        former = taken.setdefault(Path(path).resolve(), role)
        if former != role:
            raise SettingsError(f"colorize: {path} is {former}; {role} would replace it, name another file")
    if arguments.report:
        check_output_path(arguments.report, (".json",))


def _render(arguments) -> None:
    from ..io.files import read_color_volume, read_volume
    from ..rendering import render_to_png

    color = read_color_volume(arguments.volume)
    left = read_volume(arguments.grey, volume=arguments.number) if arguments.grey else None
    if left:
        _say_notes(left)
    if arguments.beside:
        left = read_color_volume(arguments.beside)
    titles = tuple(arguments.titles or ("Other" if arguments.beside else "Scan", "Coloured"))
    render_to_png(arguments.output, color, left, size=tuple(arguments.size), titles=titles)
    print(arguments.output)


def _recommend(arguments) -> None:
    from ..io.files import read_volume
    from ..matching.recommend import recommend

    volume = read_volume(arguments.input, volume=arguments.number)
    _say_notes(volume)
    options = {"features": arguments.features, "device": arguments.device}
    with _Bar("describing") as bar:
        found = recommend(volume, arguments.library, arguments.top, arguments.slice, progress=bar, **options)
    for path, score in found:
        print(f"{score:.3f} {path}")


def _library_fetch(arguments) -> None:
    from ..references.visible_human import SOURCES, fetch_library, list_photographs, missing_photographs

    source = SOURCES[arguments.name]
    print(f"{source.title}: {source.credit} ({source.licence})")
    photographs = list_photographs(arguments.name, arguments.step, arguments.part, arguments.url)
    missing = missing_photographs(arguments.name, photographs)
    megabytes = sum(photograph.size for photograph in missing) / 1e6
    print(
        f"{len(photographs)} photographs, one every {arguments.step} mm; {len(missing)} to fetch, {megabytes:.1f} MB; "
        "each is prepared at once and only the prepared picture is kept"
    )
    if missing and not arguments.yes:
        _confirm("fetch them?")
    with _Bar(arguments.name) as bar:
        index = fetch_library(arguments.name, photographs, progress=bar)
    _print_library(arguments.name, index)


def _confirm(question: str) -> None:
    from ..errors import SettingsError

    if not sys.stdin or not sys.stdin.isatty():
        raise SettingsError("library fetch: nobody can be asked here; add --yes to start the download")
    if input(f"{question} [y/N] ").strip().lower() not in ("y", "yes"):
        raise Cancelled("library fetch")


def _library_add(arguments) -> None:
    from ..references.library import add_library

    options = {"name": arguments.name, "credit": arguments.credit, "licence": arguments.licence}
    with _Bar("preparing") as bar:
        name, index = add_library(arguments.folder, **options, progress=bar)
    _print_library(name, index)


def _print_library(name: str, index: dict) -> None:
    left_out = f", {len(index['left_out'])} left out" if index["left_out"] else ""
    credit = f". {index['credit']}" if index["credit"] else ""
    print(f"library {name}: {len(index['pictures'])} references{left_out}{credit}")


def _library_list(_arguments) -> None:
    from ..references.library import libraries_folder, list_libraries

    for row in list_libraries():
        state = "" if row["complete"] else ", not complete: run the command that made it again"
        credit = f". {row['credit']}" if row["credit"] else ""
        print(f"{row['name']:<20} {row['pictures']} references, {row['bytes'] / 1e6:.1f} MB{state}{credit}")
    print(f"folder {libraries_folder()}")


def _library_remove(arguments) -> None:
    from ..references.library import remove_library

    remove_library(arguments.name)
    print(f"library {arguments.name}: removed")


def _weights_status(_arguments) -> None:
    from ..features.weights import cache_folder, weights_status

    for row in weights_status():
        state = f"present: {row['path']}" if row["present"] else row["problem"] or "not here"
        print(f"{row['network']:<12} {state}")
    print(f"cache folder {cache_folder()}; MEDCOLOR_WEIGHTS names another file or folder")


def _weights_fetch(arguments) -> None:
    from ..features.weights import fetch_weights

    with _Bar(arguments.network) as bar:
        path = fetch_weights(arguments.network, progress=lambda got, total: bar(got / max(total, 1), "downloading"))
    print(path)


def _demo(arguments) -> None:
    from .demo import run_demo

    with _Bar("demo") as bar:
        written = run_demo(arguments.output, progress=bar)
    for path in written:
        print(path)


def _bench(arguments) -> None:
    from ..bench.run import run_bench

    options = {name: getattr(arguments, name) for name in ("quick", "stability", "data", "seed")}
    options["suites"] = None if arguments.suites is None else arguments.suites.split(",")
    with _Bar("bench") as bar:
        written = run_bench(arguments.output, **options, progress=bar)
    for path in written:
        print(path)


class _Bar:
    """Progress bar with time left on the error stream; called with (fraction, text)."""

    def __init__(self, title: str) -> None:
        self._title = title

    def __enter__(self) -> _Bar:
        from tqdm import tqdm

        form = "{desc}: {percentage:3.0f}%|{bar}| {elapsed} gone, {remaining} left{postfix}"
        self._bar = tqdm(total=1.0, desc=self._title, bar_format=form, leave=False, disable=None)
        return self

    def __call__(self, fraction: float, text: str) -> None:
        self._bar.set_postfix_str(text, refresh=False)
        self._bar.update(fraction - self._bar.n)

    def __exit__(self, *_exception) -> None:
        self._bar.close()


_RUN = {
    "demo": _demo,
    "colorize": _colorize,
    "batch": _batch,
    "info": _info,
    "render": _render,
    "recommend": _recommend,
    "library_fetch": _library_fetch,
    "library_add": _library_add,
    "library_list": _library_list,
    "library_remove": _library_remove,
    "weights_status": _weights_status,
    "weights_fetch": _weights_fetch,
    "bench": _bench,
}
