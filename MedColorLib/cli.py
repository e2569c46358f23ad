"""The command line `medcolor`: parse, call the library, one clear line for what went wrong.

Exit status: 0 done, 1 some volumes of a batch failed (its table says which and why), 2 bad input or arguments, 130
interrupted. Nothing half-written is left in any case.
"""

from __future__ import annotations

import argparse
import logging
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NoReturn

from . import __version__
from .cli_guard import add_guard, guard_of
from .errors import Cancelled, MedColorError
from .parameters import FEATURES, LUMINANCE, PRESETS, RECONSTRUCTIONS, SMOOTHERS, Settings

INTERRUPTED = "interrupted; nothing was written"
_KEPT = "interrupted; what is done is kept, the same command goes on from there"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    arguments = _parser().parse_args(argv)
    # Threads that wait give their core away: the pipeline's tests took 16 s instead of 52 s beside other programs.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    logging.basicConfig(level=logging.DEBUG if arguments.verbose else logging.WARNING, format="medcolor: %(message)s")
    try:
        return arguments.run(arguments) or 0
    except MedColorError as error:
        print(f"medcolor: {error}", file=sys.stderr)
        return 2
    except (KeyboardInterrupt, Cancelled):
        print(f"medcolor: {getattr(arguments, 'interrupted', INTERRUPTED)}", file=sys.stderr)
        return 130
    except BrokenPipeError:  # the reader of our output went away, as `| head` does
        return 0


class _Parser(argparse.ArgumentParser):
    """Wrong arguments are told in one line, like any other bad input; the usage is in --help."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message}; see {self.prog} --help\n")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="medcolor",
        description="Colour grey medical volumes after a colour photograph of real anatomy. An illustration, not a measurement.",
    )
    parser.add_argument("--version", action="version", version=f"medcolor {__version__}")
    parser.add_argument("-v", "--verbose", action="store_true", help="say what is being decided")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    _add_colorize(commands)
    _add_batch(commands)
    _add_render(commands)
    _add_recommend(commands)
    _add_library(commands)
    _add_weights(commands)
    demo = commands.add_parser("demo", help="colour and render a sample made by formula: needs no download")
    demo.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="folder for the results")
    demo.set_defaults(run=_demo)
    _add_bench(commands)
    return parser


def _add_colorize(commands) -> None:
    command = commands.add_parser("colorize", help="colour a volume")
    add = command.add_argument
    add("input", metavar="INPUT", help="NRRD, MetaImage, NIfTI, DICOM folder, or folder of PNG/TIFF slices")
    add("-o", "--output", metavar="OUT", help="result: .nrrd or .nii.gz (not needed with --plan)")
    _add_settings(add)
    add(
        "--resume",
        action="store_true",
        help="keep what is matched until the end; go on where the same run was broken off",
    )
    add("--plan", action="store_true", help="print what would be done and left out, and stop")
    add("--report", type=Path, metavar="F.json", help="write settings, plan, seconds, memory and hashes")
    add_guard(add)
    add(
        "--confidence", type=Path, metavar="OUT2", help="write how far colours can be trusted, in per cent, as a volume"
    )
    command.set_defaults(run=_colorize)


def _add_batch(commands) -> None:
    command = commands.add_parser("batch", help="colour every volume of a folder; finished ones are not done again")
    add = command.add_argument
    add("input", type=Path, metavar="IN_FOLDER", help="folder with volume files and DICOM folders, at any depth")
    add("-o", "--output", type=Path, required=True, metavar="OUT_FOLDER", help="results, reports and batch.json")
    _add_settings(add)
    where = command.add_mutually_exclusive_group()
    where.add_argument("--workers", type=int, default=1, metavar="N", help="processes (default: %(default)s)")
    where.add_argument("--scheduler", metavar="ADDRESS", help="work on this Dask cluster, such as tcp://host:8786")
    command.set_defaults(run=_batch, interrupted="interrupted; finished volumes are kept, the same command goes on")


def _add_settings(add: Callable) -> None:
    """The options that say how a volume is coloured."""
    add(
        "-r",
        "--reference",
        action="append",
        required=True,
        metavar="REF",
        help="colour picture, folder of them, colour volume, or a library's name; may be repeated",
    )
    add("--preset", choices=tuple(PRESETS), default="balanced", help="how deep to go (default: %(default)s)")
    add(
        "--features",
        choices=FEATURES,
        default="auto",
        help="feature network (default: VGG-19 where present, else embedded)",
    )
    add("--smoother", choices=SMOOTHERS, default="auto", help="how colour is spread (default: the preset's)")
    add(
        "--smoother-option",
        action="append",
        type=_named_value,
        metavar="NAME=VALUE",
        help="parameter of the smoother, such as lam=16; may be repeated (a wrong name lists the right ones)",
    )
    add("--luminance", choices=LUMINANCE, default="keep", help="the scan's own, or the reference's as in the paper")
    add("--gamma", choices=("on", "off"), help="transfer between gamma 1/2 and 2 (default: on in full, else off)")
    add(
        "--reconstruction",
        choices=RECONSTRUCTIONS,
        default="warp",
        help="features one layer down (default: %(default)s)",
    )
    add("--window", nargs=2, type=float, metavar=("LO", "HI"), help="values shown black and white")
    add("--slices", type=_slice_range, metavar="A:B", help="transverse slices from A up to B, counted from the feet")
    add("--region", nargs=6, type=int, metavar=("K0", "K1", "J0", "J1", "I0", "I1"), help="voxels to colour")
    add(
        "--coherence",
        type=float,
        default=Settings.coherence_mm,
        metavar="MM",
        help="averaging along the stack (default: %(default)s mm)",
    )
    add(
        "--plane",
        choices=("transverse", "acquired"),
        default="transverse",
        help="slices to colour (default: %(default)s)",
    )
    add("--device", default="auto", help="auto, cpu, cuda, cuda:N or mps (default: %(default)s)")
    add("--seed", type=int, default=0, metavar="N", help="of the random search (default: %(default)s)")
    add(
        "--resume-limit",
        type=float,
        default=2.0,
        metavar="GB",
        help="what unfinished runs may take on disk (default: %(default)s)",
    )


def _add_render(commands) -> None:
    command = commands.add_parser("render", help="picture of a coloured volume: views and sections")
    command.add_argument("volume", metavar="VOLUME", help="RGB volume as written by colorize")
    command.add_argument("-o", "--output", type=Path, required=True, metavar="PNG")
    left = command.add_mutually_exclusive_group()
    left.add_argument("--grey", metavar="INPUT", help="the grey volume, to stand beside the colours")
    left.add_argument("--beside", metavar="VOLUME2", help="another coloured volume, to stand there instead")
    command.add_argument("--titles", nargs=2, metavar=("LEFT", "RIGHT"), help="above the two halves")
    command.add_argument("--size", nargs=2, type=int, default=(1600, 1200), metavar=("W", "H"))
    command.set_defaults(run=_render)


def _add_recommend(commands) -> None:
    command = commands.add_parser("recommend", help="references of a library that look most like a volume")
    command.add_argument("input", metavar="INPUT", help="the grey volume")
    library = "folder of colour pictures, or a library's name"
    command.add_argument("--library", required=True, metavar="DIR", help=library)
    command.add_argument("--top", type=int, default=3, metavar="N", help="how many to name (default: %(default)s)")
    command.add_argument("--slice", type=int, metavar="K", help="one transverse slice, counted from the feet")
    command.add_argument("--features", choices=FEATURES, default="auto")
    command.add_argument("--device", default="auto")
    command.set_defaults(run=_recommend)


def _add_library(commands) -> None:
    command = commands.add_parser("library", help="libraries of references: fetch, add, list, remove")
    actions = command.add_subparsers(required=True, metavar="ACTION")
    fetch = actions.add_parser("fetch", help="download photographs and prepare them; goes on where it was interrupted")
    fetch.add_argument("name", choices=("visible-human-male",), help="which library")
    fetch.add_argument("--step", type=int, default=5, metavar="MM", help="between two (default: %(default)s mm)")
    fetch.add_argument("--part", action="append", choices=("head", "thorax", "abdomen"), help="only these parts")
    fetch.add_argument("--url", help="a mirror's folder with the same pages and files (https)")
    fetch.add_argument("-y", "--yes", action="store_true", help="do not ask before the download")
    fetch.set_defaults(run=_library_fetch, interrupted=_KEPT)
    add = actions.add_parser("add", help="prepare a folder of photographs, atlas plates or painted slices")
    add.add_argument("folder", metavar="FOLDER")
    add.add_argument("--name", help="of the library (default: the folder's name)")
    add.add_argument("--credit", default="", help="whom to name with results")
    add.add_argument("--licence", default="", help="of the pictures")
    add.set_defaults(run=_library_add, interrupted=_KEPT)
    actions.add_parser("list", help="libraries on this machine").set_defaults(run=_library_list)
    remove = actions.add_parser("remove", help="delete a library from this machine")
    remove.add_argument("name")
    remove.set_defaults(run=_library_remove)


def _add_weights(commands) -> None:
    command = commands.add_parser("weights", help="network weights: where they are, download")
    actions = command.add_subparsers(required=True, metavar="ACTION")
    status = actions.add_parser("status", help="say what is present")
    status.set_defaults(run=_weights_status)
    fetch = actions.add_parser("fetch", help="download, check and convert; resumes a broken download")
    fetch.add_argument("network", nargs="?", choices=("vgg19", "gray-vgg19"), default="vgg19")
    fetch.set_defaults(run=_weights_fetch)


def _add_bench(commands) -> None:
    command = commands.add_parser("bench", help="error against run time on this machine; extreme cases")
    add = command.add_argument
    add(
        "-o",
        "--output",
        type=Path,
        default=Path("bench"),
        metavar="DIR",
        help="folder for the report (default: %(default)s)",
    )
    add("--quick", action="store_true", help="fewer points and repeats: about two minutes")
    add("--stability", action="store_true", help="only the table of stiff and extreme cases")
    add("--suites", metavar="NAME[,NAME]", help="only these, such as quality,profile")
    add(
        "--data",
        type=Path,
        metavar="FOLDER",
        help="Visible Human photographs and CT (default: ../shared/data if there)",
    )
    add("--seed", type=int, default=0, metavar="N", help="of warps and random search (default: %(default)s)")
    command.set_defaults(run=_bench)


def _named_value(text: str) -> tuple[str, int | float | str]:
    name, separator, value = text.partition("=")
    if not (separator and name.strip() and value.strip()):
        raise argparse.ArgumentTypeError(f"expected NAME=VALUE, such as lam=16, got {text!r}")
    for kind in (int, float):
        try:
            return name.strip(), kind(value)
        except ValueError:
            continue
    return name.strip(), value.strip()


def _slice_range(text: str) -> tuple[int, int]:
    start, separator, stop = text.partition(":")
    if not separator or not start.isdigit() or not stop.isdigit():
        raise argparse.ArgumentTypeError(f"expected A:B with whole numbers, got {text!r}")
    return int(start), int(stop)


def _settings(arguments) -> Settings:
    names = ("preset", "features", "smoother", "luminance", "reconstruction", "slices", "plane", "device", "seed")
    options = {name: getattr(arguments, name) for name in names}
    options["smoother_options"] = dict(arguments.smoother_option) if arguments.smoother_option else None
    ranges = arguments.region
    options["region"] = (ranges[0:2], ranges[2:4], ranges[4:6]) if ranges else None
    options["coherence_mm"] = arguments.coherence
    window = tuple(arguments.window) if arguments.window else None
    return Settings(**options, gamma={"on": True, "off": False}.get(arguments.gamma), window=window)


def _resume_bytes(arguments) -> int:
    from .errors import SettingsError

    if not 0 <= arguments.resume_limit < float("inf"):
        raise SettingsError(f"--resume-limit: expected 0 GB or more, got {arguments.resume_limit:g}")
    return round(arguments.resume_limit * 1e9)


def _colorize(arguments) -> None:
    from .pipeline import colorize
    from .report import write_report
    from .resume import Resume, forget_run
    from .volume_io import check_output_path, file_sha256, read_volume, write_color_volume, write_confidence

    settings = replace(_settings(arguments), confidence=arguments.confidence is not None)
    resume = Resume(max_bytes=_resume_bytes(arguments)) if arguments.resume else False
    if not arguments.plan:
        _check_outputs(arguments, check_output_path)
    volume, guard = read_volume(arguments.input), guard_of(arguments)
    for note in volume.notes:
        print(f"medcolor: {volume.name}: {note}", file=sys.stderr)
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


def _batch(arguments) -> int:
    from .batch import SUMMARY, run_batch

    settings, resume_bytes = _settings(arguments), _resume_bytes(arguments)
    where = {"workers": arguments.workers, "scheduler": arguments.scheduler, "resume_bytes": resume_bytes}
    with _Bar("batch") as bar:
        result = run_batch(arguments.input, arguments.reference, arguments.output, settings, **where, progress=bar)
    print(result.text())
    count = len(result.outcomes)
    print(f"{count - result.failed} of {count} volumes are finished; see {arguments.output / SUMMARY}")
    return 1 if result.failed else 0


def _print_plan(volume, references, settings, resume, guard) -> None:
    from .estimate import estimate
    from .pipeline import make_plan

    print(make_plan(volume, references, settings, resume, guard).text())
    expected = estimate(volume, references, settings, guard)
    print(f"Time on this machine: {expected.text()}")
    print(f"Colour error to expect: {expected.error_text()}")


def _check_outputs(arguments, check_output_path: Callable) -> None:
    from .errors import SettingsError

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
    from .rendering import render_to_png
    from .volume_io import read_color_volume, read_volume

    color = read_color_volume(arguments.volume)
    left = read_volume(arguments.grey) if arguments.grey else None
    if arguments.beside:
        left = read_color_volume(arguments.beside)
    titles = tuple(arguments.titles or ("Other" if arguments.beside else "Scan", "Coloured"))
    render_to_png(arguments.output, color, left, size=tuple(arguments.size), titles=titles)
    print(arguments.output)


def _recommend(arguments) -> None:
    from .recommend import recommend
    from .volume_io import read_volume

    volume = read_volume(arguments.input)
    options = {"features": arguments.features, "device": arguments.device}
    with _Bar("describing") as bar:
        found = recommend(volume, arguments.library, arguments.top, arguments.slice, progress=bar, **options)
    for path, score in found:
        print(f"{score:.3f} {path}")


def _library_fetch(arguments) -> None:
    from .visible_human import SOURCES, fetch_library, list_photographs, missing_photographs

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
    from .errors import SettingsError

    if not sys.stdin or not sys.stdin.isatty():
        raise SettingsError("library fetch: nobody can be asked here; add --yes to start the download")
    if input(f"{question} [y/N] ").strip().lower() not in ("y", "yes"):
        raise Cancelled("library fetch")


def _library_add(arguments) -> None:
    from .library import add_library

    options = {"name": arguments.name, "credit": arguments.credit, "licence": arguments.licence}
    with _Bar("preparing") as bar:
        name, index = add_library(arguments.folder, **options, progress=bar)
    _print_library(name, index)


def _print_library(name: str, index: dict) -> None:
    left_out = f", {len(index['left_out'])} left out" if index["left_out"] else ""
    credit = f". {index['credit']}" if index["credit"] else ""
    print(f"library {name}: {len(index['pictures'])} references{left_out}{credit}")


def _library_list(_arguments) -> None:
    from .library import libraries_folder, list_libraries

    for row in list_libraries():
        state = "" if row["complete"] else ", not complete: run the command that made it again"
        credit = f". {row['credit']}" if row["credit"] else ""
        print(f"{row['name']:<20} {row['pictures']} references, {row['bytes'] / 1e6:.1f} MB{state}{credit}")
    print(f"folder {libraries_folder()}")


def _library_remove(arguments) -> None:
    from .library import remove_library

    remove_library(arguments.name)
    print(f"library {arguments.name}: removed")


def _weights_status(_arguments) -> None:
    from .features.weights import cache_folder, weights_status

    for row in weights_status():
        state = f"present: {row['path']}" if row["present"] else row["problem"] or "not here"
        print(f"{row['network']:<12} {state}")
    print(f"cache folder {cache_folder()}; MEDCOLOR_WEIGHTS names another file or folder")


def _weights_fetch(arguments) -> None:
    from .features.weights import fetch_weights

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
    from .bench.run import run_bench

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
