"""The command line `medcolor`: parse, call the library, one clear line for what went wrong.

Exit status: 0 done, 1 some volumes of a batch failed (its table says which and why), 2 bad input or arguments or too little
memory, 130 interrupted (143 by SIGTERM, 129 by SIGHUP). Nothing half-written is left in any case. As with ITK, FSL and ANTs, a
result replaces an earlier file of its name, and it is said; a link is followed to its file.
"""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from ..cohort.terminal import plain, prepare_streams, say, tell
from ..device import is_out_of_memory
from ..errors import Cancelled, MedColorError, SettingsError
from ..parameters import Settings
from .guard_options import guard_of
from .options import make_parser
from .outputs import check_named, check_outputs, existing, tell_leftovers, tell_replaced
from .stopping import Stopped, stoppable

INTERRUPTED = "interrupted; nothing was written"
OUT_OF_MEMORY = "the memory of this machine is too small; close other programs, or take a smaller volume or picture"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")  # names of files that are not UTF-8, terminals that are ASCII
    arguments = make_parser().parse_args(argv)
    # Threads that wait give their core away: the pipeline's tests took 16 s instead of 52 s beside other programs.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    prepare_streams(logging.DEBUG if arguments.verbose else logging.WARNING)
    try:
        with stoppable():
            return _RUN[arguments.run](arguments) or 0
    except MedColorError as error:
        tell(error)
        return 2
    except (KeyboardInterrupt, Cancelled) as error:
        tell(getattr(arguments, "interrupted", INTERRUPTED))
        return 128 + error.number if isinstance(error, Stopped) else 130
    except BrokenPipeError:  # the reader of our output went away, as `| head` does
        return 0
    except Exception as error:
        if not is_out_of_memory(error):
            raise
        tell(OUT_OF_MEMORY)
        return 2


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
    if arguments.luminance != "natural" and arguments.lightness != Settings.lightness:
        raise SettingsError(f"--lightness belongs to --luminance natural; leave it out with {arguments.luminance}")
    options["smoother_options"] = dict(arguments.smoother_option) if arguments.smoother_option else None
    ranges = arguments.region
    options["region"] = (ranges[0:2], ranges[2:4], ranges[4:6]) if ranges else None
    options["coherence_mm"] = arguments.coherence
    window = tuple(arguments.window) if arguments.window else None
    return Settings(**options, gamma={"on": True, "off": False}.get(arguments.gamma), window=window)


def _resume_bytes(arguments) -> int:
    if not 0 <= arguments.resume_limit < float("inf"):
        raise SettingsError(f"--resume-limit: expected 0 GB or more, got {arguments.resume_limit:g}")
    return round(arguments.resume_limit * 1e9)


def _colorize(arguments) -> None:
    from ..io.files import file_sha256, read_volume, write_color_volume, write_confidence
    from ..pipeline import colorize
    from ..report import write_report
    from ..run.resume import Resume, forget_run

    settings = replace(_settings(arguments), confidence=arguments.confidence is not None)
    resume = Resume(max_bytes=_resume_bytes(arguments)) if arguments.resume else False
    if arguments.time_points:
        _colorize_time_points(arguments, settings)
        return
    former = [] if arguments.plan else check_outputs(arguments)
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
    tell_replaced(former)
    _say_credits([result.report])
    seconds = result.report["seconds"]["total"]
    resumed = result.report["resumed_slices"]
    if resumed:
        say(f"{resumed} slices were matched in an interrupted run before and were taken from there.")
    say(
        f"{arguments.output}: {len(result.report['plan']['slices'])} slices with {result.report['plan']['features']} "
        f"features in {seconds:.1f} s. The colours are an illustration, not a measurement."
    )


def _colorize_time_points(arguments, settings: Settings) -> None:
    from ..io.files import file_sha256, read_time_points
    from .time_points import check_arguments, colorize_series, numbered, plan_lines

    check_arguments(arguments)
    check_named(arguments)
    volumes, guard = read_time_points(arguments.input, volume=arguments.number), guard_of(arguments)
    for note in dict.fromkeys(note for volume in volumes for note in volume.notes):
        tell(f"{Path(arguments.input).name}: {note}")
    if arguments.plan:
        for line in plan_lines(volumes, arguments.reference, settings, guard):
            say(line)
        return
    count, wanted = len(volumes), (arguments.output, arguments.confidence, arguments.report)
    outputs = [[path and numbered(path, n, count) for path in wanted] for n in range(1, count + 1)]
    former = [path for paths in outputs for path in check_outputs(arguments, paths)]
    digest = file_sha256(arguments.input)
    with _Bar("colouring") as bar:
        reports = colorize_series(volumes, arguments.reference, settings, guard, outputs, digest, bar)
    tell_replaced(former)
    _say_credits(reports)
    for (path, *_), report in zip(outputs, reports):
        say(f"{path}: {report['plan']['steps']['time point']}")
    say(f"{count} time points. The colours are an illustration, not a measurement.")


def _say_credits(reports: Sequence[dict]) -> None:
    for credit in sorted({r["credit"] for report in reports for r in report["references"] if r["credit"]}):
        say(f"References: {credit}.")


def _say_notes(volume) -> None:
    """What the reader decided."""
    for note in volume.notes:
        tell(f"{volume.name}: {note}")


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
        say("  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths)).rstrip())
    for note in notes:
        say(note)
    if len(choices) > 1:
        say("Number 1 is read unless --volume N says otherwise.")


def _batch(arguments) -> int:
    from ..cohort.batch import SUMMARY, run_batch

    settings, resume_bytes = _settings(arguments), _resume_bytes(arguments)
    where = {"workers": arguments.workers, "scheduler": arguments.scheduler, "resume_bytes": resume_bytes}
    with _Bar("batch") as bar:
        result = run_batch(arguments.input, arguments.reference, arguments.output, settings, **where, progress=bar)
    say(result.text())
    count = len(result.outcomes)
    say(f"{count - result.failed} of {count} volumes are finished; see {arguments.output / SUMMARY}")
    return 1 if result.failed else 0


def _print_plan(volume, references, settings, resume, guard) -> None:
    from ..pipeline import make_plan
    from ..run.estimate import estimate

    say(make_plan(volume, references, settings, resume, guard).text())
    expected = estimate(volume, references, settings, guard)
    say(f"Time on this machine: {expected.text()}")
    say(f"Colour error to expect: {expected.error_text()}")


def _render(arguments) -> None:
    from .pictures import render

    tell_leftovers(path for path in (arguments.output, arguments.turntable) if path)
    former = existing(path for path in (arguments.output, arguments.turntable) if path)
    for written in render(arguments, _Bar, _say_notes):
        say(written)
    tell_replaced(former)


def _recommend(arguments) -> None:
    from ..io.files import read_volume
    from ..matching.recommend import recommend

    volume = read_volume(arguments.input, volume=arguments.number)
    _say_notes(volume)
    options = {"features": arguments.features, "device": arguments.device}
    with _Bar("describing") as bar:
        found = recommend(volume, arguments.library, arguments.top, arguments.slice, progress=bar, **options)
    for path, score in found:
        say(f"{score:.3f} {path}")


def _library_fetch(arguments) -> None:
    from ..references.visible_human import SOURCES, fetch_library, list_photographs, missing_photographs

    source = SOURCES[arguments.name]
    say(f"{source.title}: {source.credit} ({source.licence})")
    photographs = list_photographs(arguments.name, arguments.step, arguments.part, arguments.url)
    missing = missing_photographs(arguments.name, photographs)
    megabytes = sum(photograph.size for photograph in missing) / 1e6
    say(
        f"{len(photographs)} photographs, one every {arguments.step} mm; {len(missing)} to fetch, {megabytes:.1f} MB; "
        "each is prepared at once and only the prepared picture is kept"
    )
    if missing and not arguments.yes:
        _confirm("fetch them?")
    with _Bar(arguments.name) as bar:
        index = fetch_library(arguments.name, photographs, progress=bar)
    _print_library(arguments.name, index)


def _confirm(question: str) -> None:
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
    say(f"library {name}: {len(index['pictures'])} references{left_out}{credit}")


def _library_list(_arguments) -> None:
    from ..references.library import libraries_folder, list_libraries

    rows = list_libraries()
    if not rows:
        say(
            "no library yet: `medcolor library add FOLDER` makes one, `medcolor library fetch visible-human-male` gets one"
        )
    for row in rows:
        state = "" if row["complete"] else ", not complete: run the command that made it again"
        credit = f". {row['credit']}" if row["credit"] else ""
        say(f"{row['name']:<20} {row['pictures']} references, {row['bytes'] / 1e6:.1f} MB{state}{credit}")
    say(f"folder {libraries_folder()}")


def _library_remove(arguments) -> None:
    from ..references.library import remove_library

    remove_library(arguments.name)
    say(f"library {arguments.name}: removed")


def _weights_status(_arguments) -> None:
    from ..features.weights import cache_folder, weights_status

    for row in weights_status():
        state = f"present: {row['path']}" if row["present"] else row["problem"] or "not here"
        say(f"{row['network']:<12} {state}")
    say(f"cache folder {cache_folder()}; MEDCOLOR_WEIGHTS names another file or folder")


def _weights_fetch(arguments) -> None:
    from ..features.weights import fetch_weights

    with _Bar(arguments.network) as bar:
        path = fetch_weights(arguments.network, progress=lambda got, total: bar(got / max(total, 1), "downloading"))
    say(path)


def _demo(arguments) -> None:
    from .demo import FILES, WHAT_TO_SEE, run_demo

    former = set(existing(arguments.output / name for name in FILES))
    with _Bar("demo") as bar:
        written = run_demo(arguments.output, progress=bar)
    tell_replaced(path for path in written if path in former)
    for path in written:
        say(path)
    tell(WHAT_TO_SEE)


def _bench(arguments) -> None:
    from ..bench.run import run_bench

    options = {name: getattr(arguments, name) for name in ("quick", "stability", "data", "seed")}
    options["suites"] = None if arguments.suites is None else arguments.suites.split(",")
    former = set(arguments.output.iterdir()) if arguments.output.is_dir() else set()
    with _Bar("bench") as bar:
        written = run_bench(arguments.output, **options, progress=bar)
    tell_replaced(path for path in written if path in former)
    for path in written:
        say(path)


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
        self._bar.set_postfix_str(plain(text), refresh=False)
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
