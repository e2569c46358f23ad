"""The command line's options: what may be asked, with ranges and defaults."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

from .. import __version__
from ..cohort.terminal import plain
from ..parameters import FEATURES, LUMINANCE, PRESETS, RECONSTRUCTIONS, SMOOTHERS, Settings
from .guard_options import add_guard
from .pictures import SIDES
from .values import at_least, exposure, file_name, named_value, path_name, slice_range

_WHICH = "which of several volumes (series, contrasts, time points), as `medcolor info` counts (default: the largest)"
# those of `rendering.views`, which loads NumPy and more; a test compares them
_VIEWS = ("anterior", "posterior", "left", "right", "superior", "inferior", "oblique", "left-oblique")
_KEPT = "interrupted; what is done is kept, the same command goes on from there"


class _Parser(argparse.ArgumentParser):
    """Wrong arguments are told in one line, like any other bad input; the usage is in --help."""

    def __init__(self, *arguments, **options) -> None:
        super().__init__(*arguments, **options)
        # As in Python 3.14: what begins like a negative number is one, also -1e3; no option of ours looks like that.
        self._negative_number_matcher = re.compile(r"-\.?\d")

    def error(self, message: str) -> NoReturn:
        self.exit(2, plain(f"{self.prog}: {message}; see {self.prog} --help\n"))


def make_parser() -> argparse.ArgumentParser:
    """The parser; the attribute `run` of what it parses names the command."""
    parser = _Parser(
        prog="medcolor",
        description="Colour grey medical volumes after a colour photograph of real anatomy. An illustration, not a measurement.",
    )
    parser.add_argument("--version", action="version", version=f"medcolor {__version__}")
    parser.add_argument("-v", "--verbose", action="store_true", help="say what is being decided")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    _add_colorize(commands)
    _add_batch(commands)
    _add_info(commands)
    _add_render(commands)
    _add_recommend(commands)
    _add_library(commands)
    _add_weights(commands)
    demo = commands.add_parser("demo", help="colour and render a sample made by formula: needs no download")
    demo.add_argument("-o", "--output", type=path_name, required=True, metavar="DIR", help="folder for the results")
    demo.set_defaults(run="demo")
    _add_bench(commands)
    return parser


def _add_colorize(commands) -> None:
    command = commands.add_parser("colorize", help="colour a volume")
    add = command.add_argument
    text = "NRRD, MetaImage, NIfTI, DICOM folder, or folder of PNG, TIFF, BMP or JPEG slices"
    add("input", type=file_name, metavar="INPUT", help=text)
    add("-o", "--output", type=file_name, metavar="OUT", help="result: .nrrd or .nii.gz (not needed with --plan)")
    add("--volume", dest="number", type=int, metavar="N", help=_WHICH)
    add(
        "--time-points",
        action="store_true",
        help="colour all time points of the volume's series: OUT_01.nrrd, OUT_02.nrrd and so on; those that show nearly the "
        "same are matched once",
    )
    _add_settings(add, "where the body is: found (default), all of the picture, or a label volume on the input's grid")
    add(
        "--resume",
        action="store_true",
        help="keep what is matched until the end; go on where the same run was broken off",
    )
    add("--plan", action="store_true", help="print what would be done and left out, and stop")
    add("--report", type=path_name, metavar="F.json", help="write settings, plan, seconds, memory and hashes")
    add_guard(add)
    add(
        "--confidence",
        type=path_name,
        metavar="OUT2",
        help="write how far colours can be trusted, in per cent, as a volume",
    )
    command.set_defaults(run="colorize")


def _add_info(commands) -> None:
    command = commands.add_parser("info", help="the volumes in a file or folder: series, contrast, size, spacing")
    command.add_argument("input", type=file_name, metavar="FOLDER_OR_FILE", help="anything that colorize reads")
    command.set_defaults(run="info")


def _add_batch(commands) -> None:
    command = commands.add_parser("batch", help="colour every volume of a folder; finished ones are not done again")
    add = command.add_argument
    add("input", type=path_name, metavar="IN_FOLDER", help="folder with volume files and DICOM folders, at any depth")
    add("-o", "--output", type=path_name, required=True, metavar="OUT_FOLDER", help="results, reports and batch.json")
    _add_settings(add, "where the body is: found (default) or all of the picture")
    where = command.add_mutually_exclusive_group()
    where.add_argument("--workers", type=int, default=1, metavar="N", help="processes (default: %(default)s)")
    where.add_argument("--scheduler", metavar="ADDRESS", help="work on this Dask cluster, such as tcp://host:8786")
    command.set_defaults(run="batch", interrupted="interrupted; finished volumes are kept, the same command goes on")


def _add_settings(add: Callable, body_help: str) -> None:
    """The options that say how a volume is coloured."""
    add(
        "-r",
        "--reference",
        action="append",
        type=file_name,
        required=True,
        metavar="REF",
        help="colour picture, folder of them, colour volume, or a library's name; may be repeated",
    )
    add(
        "--reference-mask",
        action="append",
        dest="reference_masks",
        metavar="FILE",
        help="picture of what is tissue in a reference (white, or not transparent), a folder of them for a folder; one for "
        "each -r in their order, or the word auto (default: found, where the picture is not transparent)",
    )
    add(
        "--exposure",
        type=exposure,
        default="auto",
        metavar="auto|off|GAIN",
        help="brightness and white balance of references: brought to the usual, left, or this gain (default: %(default)s)",
    )
    add("--preset", choices=tuple(PRESETS), default="balanced", help="how deep to go (default: %(default)s)")
    add(
        "--features",
        choices=FEATURES,
        default="auto",
        help="feature network (default: MedColor's own, which needs no download)",
    )
    add("--smoother", choices=SMOOTHERS, default="auto", help="how colour is spread (default: the preset's)")
    add(
        "--smoother-option",
        action="append",
        type=named_value,
        metavar="NAME=VALUE",
        help="parameter of the smoother, such as lam=16; may be repeated (a wrong name lists the right ones)",
    )
    add(
        "--luminance",
        choices=LUMINANCE,
        default=Settings.luminance,
        help="natural: the reference's for each tissue with the scan's detail; keep: the scan's own; paper: the paper's equation "
        "(default: %(default)s)",
    )
    add(
        "--lightness",
        type=float,
        default=Settings.lightness,
        metavar="0..1",
        help="natural luminance from the scan's own (0) to the reference's (1) (default: %(default)s)",
    )
    add(
        "--gamma",
        choices=("on", "off"),
        help="transfer between gamma 1/2 and 2 (default: on in full with --luminance paper)",
    )
    add(
        "--reconstruction",
        choices=RECONSTRUCTIONS,
        default="warp",
        help="features one layer down (default: %(default)s)",
    )
    add("--window", nargs=2, type=float, metavar=("LO", "HI"), help="values shown black and white")
    add("--body", type=file_name, default="auto", metavar="BODY", help=body_help)
    add("--slices", type=slice_range, metavar="A:B", help="transverse slices from A up to B, counted from the feet")
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
    command.add_argument("volume", type=file_name, metavar="VOLUME", help="RGB volume as written by colorize")
    command.add_argument("-o", "--output", type=path_name, metavar="PNG", help="the picture")
    left = command.add_mutually_exclusive_group()
    left.add_argument("--grey", type=file_name, metavar="INPUT", help="the grey volume, to stand beside the colours")
    command.add_argument("--volume", dest="number", type=int, metavar="N", help=f"of --grey: {_WHICH}")
    text = "another coloured volume, to stand there instead"
    left.add_argument("--beside", type=file_name, metavar="VOLUME2", help=text)
    command.add_argument("--titles", nargs=2, metavar=("LEFT", "RIGHT"), help="above the two halves")
    command.add_argument(
        "--size", nargs=2, type=int, default=None, metavar=("W", "H"), help="pixels, to 8192 a side for a single view"
    )
    command.add_argument("--view", choices=_VIEWS, help="a single view in place of the sheet")
    command.add_argument("--cut", nargs="+", choices=SIDES, metavar="SIDE", help=f"take away: {', '.join(SIDES)}")
    command.add_argument("--opacity", type=float, metavar="X", help="0 to 1: bone alone, muscle, skin (default: 0.9)")
    command.add_argument("--light", choices=("plain", "realistic"), default="plain", help="realistic: with shadows")
    command.add_argument(
        "--turntable",
        type=path_name,
        metavar="OUT",
        help="the body turns once around: .mp4, .gif, or a folder of pictures",
    )
    command.set_defaults(run="render")


def _add_recommend(commands) -> None:
    command = commands.add_parser("recommend", help="references of a library that look most like a volume")
    command.add_argument("input", type=file_name, metavar="INPUT", help="the grey volume")
    command.add_argument("--volume", dest="number", type=int, metavar="N", help=_WHICH)
    library = "folder of colour pictures, or a library's name"
    command.add_argument("--library", type=file_name, required=True, metavar="DIR", help=library)
    command.add_argument(
        "--top", type=at_least(1), default=3, metavar="N", help="how many to name (default: %(default)s)"
    )
    command.add_argument("--slice", type=int, metavar="K", help="one transverse slice, counted from the feet")
    command.add_argument("--features", choices=FEATURES, default="auto", help="as in colorize")
    command.add_argument("--device", default="auto", help="auto, cpu, cuda, cuda:N or mps (default: %(default)s)")
    command.set_defaults(run="recommend")


def _add_library(commands) -> None:
    command = commands.add_parser("library", help="libraries of references: fetch, add, list, remove")
    actions = command.add_subparsers(required=True, metavar="ACTION")
    fetch = actions.add_parser("fetch", help="download photographs and prepare them; goes on where it was interrupted")
    fetch.add_argument("name", choices=("visible-human-male",), help="which library")
    fetch.add_argument("--step", type=int, default=5, metavar="MM", help="between two (default: %(default)s mm)")
    fetch.add_argument("--part", action="append", choices=("head", "thorax", "abdomen"), help="only these parts")
    fetch.add_argument("--url", help="a mirror's folder with the same pages and files (https)")
    fetch.add_argument("-y", "--yes", action="store_true", help="do not ask before the download")
    fetch.set_defaults(run="library_fetch", interrupted=_KEPT)
    add = actions.add_parser("add", help="prepare a folder of photographs, atlas plates or painted slices")
    add.add_argument("folder", type=file_name, metavar="FOLDER", help="the pictures")
    add.add_argument("--name", help="of the library (default: the folder's name)")
    add.add_argument("--credit", default="", help="whom to name with results")
    add.add_argument("--licence", default="", help="of the pictures")
    add.set_defaults(run="library_add", interrupted=_KEPT)
    actions.add_parser("list", help="libraries on this machine").set_defaults(run="library_list")
    remove = actions.add_parser("remove", help="delete a library from this machine")
    remove.add_argument("name", help="as `medcolor library list` says")
    remove.set_defaults(run="library_remove")


def _add_weights(commands) -> None:
    command = commands.add_parser("weights", help="network weights: where they are, download")
    actions = command.add_subparsers(required=True, metavar="ACTION")
    status = actions.add_parser("status", help="say what is present")
    status.set_defaults(run="weights_status")
    fetch = actions.add_parser("fetch", help="download, check and convert; resumes a broken download")
    text = "of which network (default: %(default)s)"
    fetch.add_argument("network", nargs="?", choices=("vgg19", "gray-vgg19"), default="vgg19", help=text)
    fetch.set_defaults(run="weights_fetch")


def _add_bench(commands) -> None:
    command = commands.add_parser("bench", help="error against run time on this machine; extreme cases")
    add = command.add_argument
    add(
        "-o",
        "--output",
        type=path_name,
        default=Path("bench"),
        metavar="DIR",
        help="folder for the report (default: %(default)s)",
    )
    add("--quick", action="store_true", help="fewer points and repeats: under two minutes")
    add("--stability", action="store_true", help="only the table of stiff and extreme cases")
    add("--suites", metavar="NAME[,NAME]", help="only these, such as quality,profile")
    add(
        "--data",
        type=path_name,
        metavar="FOLDER",
        help="Visible Human photographs and CT (default: ../shared/data if there)",
    )
    add("--seed", type=at_least(0), default=0, metavar="N", help="of warps and random search (default: %(default)s)")
    command.set_defaults(run="bench")
