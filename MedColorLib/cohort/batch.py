"""Batch: colour every volume of a folder. Finished volumes are recognised by content, failures are listed and not fatal.

A volume is finished when its result is there and the report beside it names the same input, references, settings,
weights and version by hash. A volume that was interrupted goes on from the slices matched so far (`resume`); these lie in
`.unfinished` in the output folder until the volume is done, where any worker finds them.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import os
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from .. import __version__
from ..device import is_out_of_memory
from ..errors import InputError, MedColorError, OutputError, SettingsError, WeightsError
from ..io.dicom import DICOM_ENDINGS, is_dicom
from ..io.files import check_output_path, file_sha256, input_sha256, read_volume, write_color_volume
from ..io.folders import VOLUME_ENDINGS
from ..io.nifti import is_pair, nifti_files
from ..io.usable import usable
from ..io.voxel_data import title
from ..output import leftovers
from ..parameters import Settings
from ..run.resume import Resume, forget_run, forget_runs, weights_sha256
from .workers import run_here, run_on_cluster, run_processes

log = logging.getLogger("MedColorLib")

TIFF_ENDINGS = (".tif", ".tiff")
SUMMARY = "batch.json"
_RESULT = "-colored.nrrd"
_REPORT = "-colored.json"
_UNFINISHED = ".unfinished"


@dataclass(frozen=True)
class Found:
    """The volumes of a folder.

    Attributes:
        volumes: name relative to the folder, with "/" -> file or DICOM folder, in order.
        passed_over: file ending -> how many files that are no volumes; also counted: linked folders, results of a batch.
    """

    volumes: dict[str, Path]
    passed_over: dict[str, int]


@dataclass(frozen=True)
class Task:
    """One volume, as plain data: it may go to another process or machine, where the paths must be the same.

    Attributes:
        name: of the volume, relative to the input folder. result: of its output, relative to the output folder.
        source, output, report, store: absolute paths; `store` is the folder of matches of interrupted runs.
        references: absolute paths, or names of libraries. settings: `Settings.to_dict()`. store_bytes: limit of the store.
        expected: what the report of a finished result says, all but the input.
    """

    name: str
    result: str
    source: str
    output: str
    report: str
    store: str
    store_bytes: int
    references: tuple[str, ...]
    settings: dict
    expected: dict


@dataclass(frozen=True)
class Outcome:
    """What became of a volume.

    Attributes:
        volume, output: names relative to the two folders.
        state: "done", "skipped" (finished before), "failed" or "not reached" (the batch was interrupted).
        seconds: of the work; reason: of a failure, one line; resumed_slices: taken from an interrupted run.
        notes: what the reader decided, such as which of several volumes it took. replaced: an earlier file of that name.
    """

    volume: str
    output: str
    state: str
    seconds: float = 0.0
    reason: str = ""
    resumed_slices: int = 0
    notes: tuple[str, ...] = ()
    replaced: bool = False

    def text(self) -> str:
        """State, and seconds or reason."""
        resumed = f", {self.resumed_slices} slices from an interrupted run" if self.resumed_slices else ""
        replaced = ", an earlier file of this name was replaced" if self.replaced else ""
        noted = f"; {'; '.join(self.notes)}" if self.notes else ""
        last = {"done": f"{self.seconds:.1f} s{resumed}{replaced}{noted}", "skipped": "finished before"}
        return f"{self.state:<7}  {last.get(self.state, self.reason)}"


@dataclass(frozen=True)
class BatchResult:
    """What became of each volume, in the order of their names, and of what else was found; see `Found`."""

    outcomes: tuple[Outcome, ...]
    passed_over: dict[str, int]

    @property
    def failed(self) -> int:
        """How many volumes failed."""
        return sum(outcome.state == "failed" for outcome in self.outcomes)

    def text(self) -> str:
        """A table for people: volume, state, seconds or reason."""
        width = max(len(outcome.volume) for outcome in self.outcomes)
        lines = [f"{outcome.volume:<{width}}  {outcome.text()}" for outcome in self.outcomes]
        others = ", ".join(f"{count} {ending}" for ending, count in self.passed_over.items())
        return "\n".join([*lines, *([f"Passed over, no volumes: {others}"] if others else [])])


def run_batch(
    folder: str | os.PathLike,
    references: Sequence[str | os.PathLike],
    output_folder: str | os.PathLike,
    settings: Settings | None = None,
    workers: int = 1,
    scheduler: str | None = None,
    resume_bytes: int = Resume.max_bytes,
    progress: Callable[[float, str], None] | None = None,
) -> BatchResult:
    """Colour every volume below `folder` after the same references.

    Args:
        references: as for `colorize`, but paths and names only.
        output_folder: made where missing; gets NAME-colored.nrrd and NAME-colored.json under the same relative paths, and
            `batch.json`, also when interrupted.
        workers: processes of this machine; 1: this process.
        scheduler: address of a Dask scheduler instead, whose workers see both folders under the same paths.
        resume_bytes: limit of what is kept of all unfinished volumes together.
        progress: called with the fraction done (0..1) and a short text.

    Raises:
        InputError, SettingsError, OutputError, WeightsError, MissingPackageError, DeviceError: before any volume is
            begun, for what concerns all of them.
    """
    if not isinstance(workers, int) or workers < 1:
        raise SettingsError(f"workers: expected a whole number of at least 1, got {workers!r}")
    references = [references] if isinstance(references, (str, os.PathLike)) else references
    progress = progress or (lambda _fraction, _text: None)
    found = find_volumes(folder, output_folder)
    tasks = make_tasks(found, references, output_folder, settings or Settings(), resume_bytes)
    _prepare_folder(Path(output_folder))
    outcomes = [Outcome(task.name, task.result, "not reached") for task in tasks]

    def said(number: int, fraction: float, text: str) -> None:
        progress((number + fraction) / len(tasks), f"{number + 1} of {len(tasks)}: {text}")

    if scheduler:
        ended = run_on_cluster(color_file, tasks, scheduler)
    else:
        ended = run_here(color_file, tasks, said) if workers == 1 else run_processes(color_file, tasks, workers)
    try:
        with contextlib.closing(ended):
            for count, (number, result) in enumerate(ended, 1):
                outcomes[number] = _outcome(tasks[number], result)
                progress(count / len(tasks), f"{count} of {len(tasks)} volumes")
    finally:
        _remove_leftovers(tasks, outcomes)
        _write_summary(Path(output_folder), found, tasks, outcomes)
    return BatchResult(tuple(outcomes), found.passed_over)


def find_volumes(folder: str | os.PathLike, output_folder: str | os.PathLike) -> Found:
    """Volume files and DICOM folders below a folder; hidden names and the output folder are left out.

    Raises:
        InputError: missing, no folder, inside the output folder, or without a volume.
    """
    root, results = usable(folder, "batch").resolve(), usable(output_folder, "batch, output").resolve()
    if not root.is_dir():
        raise InputError(f"{folder}: is not a folder; give the folder that holds the volumes")
    if root.is_relative_to(results):
        raise InputError(f"{folder}: is or lies inside the output folder {output_folder}; write the results elsewhere")
    paths, passed_over = [], Counter()
    for parent, folders, names in os.walk(root):
        here = Path(parent)
        folders[:] = sorted(n for n in folders if not n.startswith(".") and here / n != results)
        former = {name for name in folders if _is_former_result(here / name)}
        passed_over["results of a batch"] += len(former)
        passed_over["linked folders"] += sum((here / name).is_symlink() for name in folders)
        folders[:] = [name for name in folders if name not in former]
        files = [here / name for name in sorted(names) if not name.startswith(".")]
        volumes = [file for file in files if _is_volume(file)]
        pairs = {nifti_files(file)[1] for file in volumes if is_pair(file)}
        others = sorted({*files} - {*volumes} - pairs)
        if any(map(_is_dicom, others)):
            volumes.append(here)
        else:
            passed_over.update(file.suffix.lower() or "no ending" for file in others)
        paths += volumes
    if not paths:
        raise InputError(f"{folder}: holds no volume ({', '.join(VOLUME_ENDINGS)}, TIFF of many pages, DICOM folder)")
    names = {path.relative_to(root).as_posix() if path != root else root.name: path for path in paths}
    return Found(dict(sorted(names.items())), {ending: n for ending, n in sorted(passed_over.items()) if n})


def make_tasks(
    found: Found, references: Sequence, output_folder: str | os.PathLike, settings: Settings, resume_bytes: int
) -> list[Task]:
    """A task for each volume. `auto` features are resolved here, so that all workers take the same.

    Raises:
        InputError, WeightsError, SettingsError: references or features that cannot be used.
    """
    from ..features import choose_features
    from ..references.loading import load_references

    results = Path(output_folder).resolve()
    if settings.body not in ("auto", "all"):
        raise SettingsError("body: a mask belongs to one volume; colour that one by itself, or take auto or all")
    settings = replace(settings, features=choose_features(settings.features, settings.preset))
    pictures = load_references(references, settings.exposure, settings.reference_masks)
    expected = {
        "version": __version__,
        "settings": _plain(replace(settings, reference_masks=None).to_dict()),  # what they mark is in the hashes
        "references": [hashlib.sha256(r.rgb.tobytes() + r.mask.tobytes()).hexdigest() for r in pictures],
        "weights_sha256": weights_sha256(settings.features),
    }
    shared = {
        "references": tuple(str(Path(r).resolve()) if Path(r).exists() else str(r) for r in references),
        "settings": replace(settings, reference_masks=_absolute(settings.reference_masks)).to_dict(),
        "store": str(results / _UNFINISHED),
        "store_bytes": resume_bytes,
        "expected": expected,
    }
    return [
        Task(
            name,
            f"{stem}{_RESULT}",
            str(path),
            str(results / f"{stem}{_RESULT}"),
            str(results / f"{stem}{_REPORT}"),
            **shared,
        )
        for (name, path), stem in zip(found.volumes.items(), _stems(found.volumes))
    ]


def _absolute(masks: tuple[str | None, ...] | None) -> tuple[str | None, ...] | None:
    """The same paths for workers in another folder."""
    return masks and tuple(str(Path(mask).resolve()) if mask and Path(mask).exists() else mask for mask in masks)


def color_file(
    task: Task,
    progress: Callable[[float, str], None] | None = None,
    cancelled: Callable[[], bool] | None = None,
) -> Outcome:
    """Colour the volume of a task unless that was done before. Done twice at once, it leaves one result.

    Raises:
        MedColorError, Cancelled: as `colorize`.
    """
    from ..pipeline import colorize
    from ..report import write_report
    from ..run.doubts import warning_text

    started = time.perf_counter()
    _check_worker(task)
    output, resume = Path(task.output), Resume(Path(task.store), task.store_bytes)
    expected = {**task.expected, "input": input_sha256(task.source)}
    if finished := finished_report(task, expected):
        forget_run(finished, resume)  # a run may have been broken off between its report and this
        return Outcome(task.name, task.result, "skipped")
    volume = read_volume(task.source, below=False)  # the folders in it are volumes of their own
    settings = Settings.from_dict(task.settings)
    colored = colorize(volume, list(task.references), settings, progress, cancelled, resume)
    output.parent.mkdir(parents=True, exist_ok=True)
    replaced = output.exists()
    write_color_volume(colored, output)
    colored.report["input"]["file_sha256"] = expected["input"]
    colored.report["batch"] = {**expected, "output": file_sha256(output)}
    write_report(colored.report, task.report)
    forget_run(colored.report, resume)
    seconds = round(time.perf_counter() - started, 2)
    resumed = colored.report["resumed_slices"]
    notes = (*volume.notes, *map(warning_text, colored.report["reference_warnings"]))
    return Outcome(task.name, task.result, "done", seconds, resumed_slices=resumed, notes=notes, replaced=replaced)


def finished_report(task: Task, expected: dict) -> dict | None:
    """The report of the result if that is there, whole, and made from what `expected` says."""
    try:
        report = json.loads(Path(task.report).read_text(encoding="utf-8"))
        return report if report["batch"] == {**expected, "output": file_sha256(task.output)} else None
    except (OSError, ValueError, KeyError, TypeError, InputError):
        return None


def _is_volume(file: Path) -> bool:
    """A volume by its ending; a TIFF by its number of pages."""
    name = file.name.lower()
    if not name.endswith(TIFF_ENDINGS):
        return file.is_file() and (name.endswith(VOLUME_ENDINGS) or (is_pair(file)))
    from ..io.tiff import tiff_stacks

    try:
        return max(len(stack.pages) for stack in tiff_stacks(file)) > 1
    except (InputError, OSError):
        return False


def _is_former_result(folder: Path) -> bool:
    """An output folder of a batch, by its summary."""
    try:
        return {"counts", "passed_over"} <= json.loads((folder / SUMMARY).read_text(encoding="utf-8")).keys()
    except (OSError, ValueError, AttributeError):
        return False


def _is_dicom(file: Path) -> bool:
    try:
        return file.is_file() and is_dicom(file)
    except OSError:
        return file.suffix.lower() in DICOM_ENDINGS


def _stems(volumes: dict[str, Path]) -> list[str]:
    """Names of results without ending; where two volumes would share one, their own endings stay."""
    short = [str(Path(name).with_name(title(path) if path.is_file() else path.name)) for name, path in volumes.items()]
    often = Counter(stem.lower() for stem in short)
    return [stem if often[stem.lower()] == 1 else name for stem, name in zip(short, volumes)]


def _check_worker(task: Task) -> None:
    """A worker elsewhere must do what the report will say."""
    if task.expected["version"] != __version__:
        raise SettingsError(
            f"the worker has MedColor {__version__}, the batch was started with {task.expected['version']}; install the same"
        )
    features = task.settings["features"]
    if weights_sha256(features) != task.expected["weights_sha256"]:
        raise WeightsError(f"features {features}: the worker has other weights; set MEDCOLOR_WEIGHTS there")


def _prepare_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be made ({error.strerror}); choose another folder") from error
    check_output_path(folder / SUMMARY, (".json",))
    if (folder / SUMMARY).exists() and not _is_former_result(folder):
        raise OutputError(f"{folder / SUMMARY}: is no summary of a batch and would be replaced; choose another folder")


def _outcome(task: Task, result: Any) -> Outcome:
    if isinstance(result, Outcome):
        return result
    reason = " ".join(str(result).split()).replace(f"{task.source}: ", "")
    if is_out_of_memory(result) and not isinstance(result, MedColorError):
        log.debug("batch: out of memory", exc_info=result)
        reason = "the memory of this machine is too small; use fewer --workers, --preset draft, or a smaller volume"
    elif not isinstance(result, MedColorError):
        log.debug("batch: a volume failed", exc_info=result)
        reason = f"{type(result).__name__}: {reason}"
    return Outcome(task.name, task.result, "failed", reason=reason)


def _remove_leftovers(tasks: Sequence[Task], outcomes: Sequence[Outcome]) -> None:
    """Temporary files of killed workers; matches once no volume needs them."""
    for task in tasks:
        for final in (Path(task.output), Path(task.report)):
            for partial in leftovers(final):
                if partial.is_file() and not partial.is_symlink():
                    partial.unlink(missing_ok=True)
    if all(outcome.state in ("done", "skipped") for outcome in outcomes):
        forget_runs(Path(tasks[0].store))
    with contextlib.suppress(OSError):  # not there, or matches are in it
        Path(tasks[0].store).rmdir()


def _write_summary(folder: Path, found: Found, tasks: Sequence[Task], outcomes: Sequence[Outcome]) -> None:
    from ..report import write_report

    summary = {
        "notice": "Illustration: the colours are not a measurement.",
        **tasks[0].expected,
        "counts": dict(Counter(outcome.state for outcome in outcomes)),
        "passed_over": found.passed_over,
        "volumes": [asdict(outcome) for outcome in outcomes],
    }
    write_report(summary, folder / SUMMARY)


def _plain(values: dict) -> dict:
    """As JSON gives it back: lists instead of tuples."""
    return json.loads(json.dumps(values))
