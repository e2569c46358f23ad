"""Resume: what a run has matched lies on disk, so that the same run goes on from there after it was cancelled or killed.

Matching takes nearly all the time and yields little: fields of positions. They are kept as one safetensors file per batch
of slices in `runs/KEY/`. KEY is a SHA-256 over everything that matches depend on: voxels and geometry, references,
settings, weights, this library's own code, versions, machine and number of threads. So a run never takes up anything but
its own matches, and no name of a patient or file is kept. Colours are made anew from the matches: the same bytes as
without the interruption. For the sake of equal bytes slices go through the network in the same batches as before, too: how
many go together may change the rounding.

Only files that bear MedColor's mark and the key of their run are ever deleted, and a folder only once it is empty. Links are
not followed.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import os
import re
import secrets
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..errors import SettingsError, WeightsError
from ..features import own_weights_sha256
from ..parameters import PRESETS

if TYPE_CHECKING:
    from ..matching.analogy import Match
    from .prepare import Prepared

log = logging.getLogger("MedColorLib")

_SUFFIX = ".safetensors"
_KEY = re.compile(r"[0-9a-f]{64}")
_MATCHES = re.compile(r"\d{6,}-\d{6,}-\d+-\d+\.safetensors")
_PARTIAL = re.compile(r"\.[0-9a-f]{8}-" + _MATCHES.pattern)
_MARK = "medcolor"  # in the metadata of each file, with the key of its run: what is deleted must have it


@dataclass(frozen=True)
class Resume:
    """Parameters of the store.

    Attributes:
        folder: where runs are kept; None: `runs` in the platform's cache folder for MedColor.
        max_bytes: of all runs together, 0 or more; those not written to for the longest time are deleted first.
    """

    folder: Path | None = None
    max_bytes: int = 2_000_000_000

    def __post_init__(self) -> None:
        if isinstance(self.max_bytes, bool) or not isinstance(self.max_bytes, int) or self.max_bytes < 0:
            raise SettingsError(f"resume: expected a limit of 0 bytes or more, got {self.max_bytes!r}")

    @property
    def root(self) -> Path:
        """The folder of all runs."""
        return runs_folder() if self.folder is None else Path(self.folder)


def runs_folder() -> Path:
    """Where runs are kept unless a folder is named: beside the weights in the platform's cache folder."""
    from ..features.weights import cache_folder

    return cache_folder().parent / "runs"


def resume_options(resume: bool | str | os.PathLike | Resume) -> Resume | None:
    """What `colorize` takes as `resume`: False, True (the cache folder), a folder, or `Resume`."""
    if isinstance(resume, Resume):
        return resume
    if isinstance(resume, bool) or resume is None:
        return Resume() if resume else None
    return Resume(Path(resume))


def open_store(prepared: Prepared, resume: bool | str | os.PathLike | Resume) -> RunStore | None:
    """The store of this very run, or None when `resume` is False."""
    options = resume_options(resume)
    return None if options is None else RunStore(options, run_key(prepared))


def forget_run(report: dict, resume: bool | str | os.PathLike | Resume) -> None:
    """Delete what was kept of the run with this report, once its result is written; a finished run does not need it."""
    options, key = resume_options(resume), report.get("resume_run")
    if options is not None and isinstance(key, str) and _KEY.fullmatch(key):
        _delete_run(options.root / key)


def forget_runs(folder: Path) -> None:
    """Delete all runs kept in a folder, and the folder itself if nothing else is in it."""
    for run, _, _ in list(_runs(folder)):
        _delete_run(run)
    with contextlib.suppress(OSError):  # not there, or something else is in it
        folder.rmdir()


class RunStore:
    """The matches of one run on disk.

    Attributes:
        key: name of its folder.
        problem: why nothing more is kept, or None. The run itself goes on in any case.
        by_batch: slices are kept as they were matched together.
    """

    by_batch = True

    def __init__(self, options: Resume, key: str) -> None:
        self.key, self.problem = key, None
        self._resumed: set[int] = set()
        self._matched: set[int] = set()
        self._root, self._folder, self._max_bytes = options.root, options.root / key, options.max_bytes

    @property
    def resumed_slices(self) -> int:
        """How many slices have been taken from an interrupted run so far, with all their references."""
        return len(self._resumed - self._matched)

    def load(self, slices: Sequence[int], reference: int, device: str) -> Match | None:
        """The match of this batch of slices with a reference, or None: not there, or damaged, which is logged."""
        from safetensors import SafetensorError

        path = self._path(slices, reference)
        try:
            match = _read(path, device)
        except FileNotFoundError:
            return None
        except (OSError, SafetensorError, ValueError, KeyError) as error:
            log.warning("resume: slices %d to %d are matched again: %s", slices[0], slices[-1], _reason(error))
            return None
        self._resumed.update(slices)
        return match

    def save(self, slices: Sequence[int], reference: int, match: Match) -> None:
        """Keep a match. A full or read-only disk ends the keeping, with a warning, not the run."""
        self._matched.update(slices)
        if self.problem:
            return
        data = _packed(match, self.key)
        try:
            if not self._make_room(len(data)):
                self._give_up(f"the limit of {self._max_bytes} bytes is reached")
                return
            try:
                self._write(self._path(slices, reference), data)
            except FileNotFoundError:  # another run has just made room
                self._write(self._path(slices, reference), data)
        except OSError as error:
            self._give_up(f"the folder of unfinished runs cannot be written ({error.strerror or error})")

    def stored_slices(self) -> int:
        """How many slices lie matched, as far as the names of the files say."""
        stored = {path.stem.rpartition("-")[0] for path in self._folder.glob(f"[0-9]*{_SUFFIX}")}
        return sum(int(batch.rpartition("-")[2]) for batch in stored)

    def _write(self, path: Path, data: bytes) -> None:
        partial = path.with_name(f".{secrets.token_hex(4)}-{path.name}")
        self._folder.mkdir(parents=True, exist_ok=True)
        try:
            partial.write_bytes(data)
            os.replace(partial, path)
        finally:
            with contextlib.suppress(OSError):  # most often because it is not there
                partial.unlink()

    def _path(self, slices: Sequence[int], reference: int) -> Path:
        return self._folder / f"{slices[0]:06d}-{slices[-1]:06d}-{len(slices)}-{reference}{_SUFFIX}"

    def _give_up(self, problem: str) -> None:
        self.problem = problem
        log.warning("resume: %s; what is matched from here on cannot be resumed", problem)

    def _make_room(self, needed: int) -> bool:
        """Delete other runs, the oldest first, until `needed` bytes more are within the limit."""
        runs = sorted(_runs(self._root), key=lambda run: run[1])
        total = needed + sum(size for _, _, size in runs)
        for folder, _, _ in runs:
            if total <= self._max_bytes:
                break
            if folder.name != self.key and (freed := _delete_run(folder)):
                log.warning("resume: an older interrupted run was deleted to make room (%d bytes)", freed)
                total -= freed
        return total <= self._max_bytes


def run_key(prepared: Prepared) -> str:
    """SHA-256 (hex) over everything that decides the matches of a run, batch boundaries and rounding included."""
    import torch

    from ..report import environment, voxels_sha256

    volume, plan = prepared.volume, prepared.plan
    what = {
        "voxels": voxels_sha256(volume.array),
        "array": [volume.array.shape, volume.array.dtype.name, volume.ijk_to_ras.tolist(), volume.window],
        "references": [[_sha256(r.rgb), _sha256(r.mask), r.rgb.shape] for r in prepared.references],
        "guard": prepared.groups and prepared.groups.identity(),
        "settings": prepared.settings.to_dict(),
        "body": None if prepared.body.given is None else voxels_sha256(prepared.body.given),
        "preset": asdict(PRESETS[prepared.settings.preset]),
        "resolved": [plan.features, plan.device, plan.smoother],
        "weights": weights_sha256(plan.features),
        "code": _code_sha256(),
        "environment": [environment(plan.device), torch.backends.cpu.get_cpu_capability()],
    }
    return hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()


def weights_sha256(features: str) -> str:
    """Hash of the weights of a resolved feature network.

    Raises:
        WeightsError: they are not here, or damaged.
    """
    if features == "embedded":
        return own_weights_sha256()
    from ..features.weights import find_weights

    found = find_weights(features)
    if found is None:
        raise WeightsError(f"features {features}: no weights found; run 'medcolor weights fetch {features}'")
    state = found.path.stat()
    return _hash_of_weights(found.path, state.st_size, state.st_mtime_ns)


@lru_cache(maxsize=8)  # size and time are in the key: a changed file is hashed anew
def _hash_of_weights(path: Path, size: int, modified_ns: int) -> str:
    from ..features.weights import load_weights

    return load_weights(path).sha256


@lru_cache(maxsize=1)
def _code_sha256(library: Path = Path(__file__).parents[1]) -> str:
    """Hash of all code of this library: matches of another version or of changed code are not taken up."""
    total = hashlib.sha256()
    for path in sorted(library.rglob("*.py")):
        total.update(path.relative_to(library).as_posix().encode() + path.read_bytes())
    return total.hexdigest()


def _sha256(array: np.ndarray) -> str:
    return hashlib.sha256(np.ascontiguousarray(array).data).hexdigest()


def _packed(match: Match, key: str) -> bytes:
    """A match of the run `key` as a safetensors file with a check sum. Positions fit into 32 bits."""
    import torch
    from safetensors.torch import save

    values = {field.name: getattr(match, field.name) for field in fields(match)}
    tensors = {
        name: (value.cpu() if value.is_floating_point() else value.to("cpu", torch.int32)).contiguous()
        for name, value in values.items()
        if isinstance(value, torch.Tensor)
    }
    searched = list(match.searched.items())  # JSON would make text of its keys
    what = json.dumps({**{name: values[name] for name in values if name not in tensors}, "searched": searched})
    return save(tensors, {"what": what, "sha256": _check_sum(what, tensors), _MARK: key})


def _read(path: Path, device: str) -> Match:
    """A match as `_packed` wrote it.

    Raises:
        OSError, SafetensorError, ValueError, KeyError: missing or damaged.
    """
    from safetensors import safe_open

    from ..matching.analogy import Match

    if not path.is_file():
        raise FileNotFoundError(path)
    with safe_open(str(path), "pt") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
        metadata = file.metadata() or {}
    if metadata["sha256"] != _check_sum(metadata["what"], tensors):
        raise ValueError("the check sum of the stored matches is wrong")
    values = json.loads(metadata["what"])
    values["searched"] = dict(values["searched"])
    for name, tensor in tensors.items():
        values[name] = (tensor if tensor.is_floating_point() else tensor.long()).to(device)
    return Match(**values)


def _check_sum(what: str, tensors: dict) -> str:
    import torch

    total = hashlib.sha256(what.encode())
    for name in sorted(tensors):
        total.update(f"{name} {tensors[name].dtype} {tuple(tensors[name].shape)}".encode())
        total.update(tensors[name].view(torch.uint8).numpy().data)
    return total.hexdigest()


def _reason(error: Exception) -> str:
    if isinstance(error, OSError):
        return f"the stored matches cannot be read ({error.strerror or error})"
    return f"the stored matches are damaged ({' '.join(str(error).split())})"


def _runs(root: Path) -> Iterator[tuple[Path, float, int]]:
    """Folder, time of the last change and bytes of each run; one that another process deletes meanwhile is left out."""
    for folder in root.iterdir() if root.is_dir() else ():
        with contextlib.suppress(OSError):
            files = _files_of_run(folder)
            if files:
                yield folder, folder.stat().st_mtime, sum(file.stat().st_size for file in files)


def _files_of_run(folder: Path) -> list[Path]:
    """Files in a run's folder that have the names of matches; none of a folder or file that is a link."""
    if not _KEY.fullmatch(folder.name) or folder.is_symlink() or not folder.is_dir():
        return []
    with os.scandir(folder) as entries:
        names = [entry.name for entry in entries if entry.is_file(follow_symlinks=False)]
    return [folder / name for name in names if _MATCHES.fullmatch(name) or _PARTIAL.fullmatch(name)]


def _delete_run(folder: Path) -> int:
    """Delete what bears the mark of this run, and the folder if nothing else is in it; returns the bytes freed."""
    freed = 0
    with contextlib.suppress(OSError):  # another process deletes it, too
        for file in _files_of_run(folder):
            if _PARTIAL.fullmatch(file.name) or _bears_mark(file, folder.name):
                size = file.stat().st_size
                file.unlink()
                freed += size
        folder.rmdir()
    return freed


def _bears_mark(file: Path, key: str) -> bool:
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(str(file), "pt") as opened:
            return (opened.metadata() or {}).get(_MARK) == key
    except (OSError, SafetensorError, ValueError):
        return False
