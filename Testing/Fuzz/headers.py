"""Fuzz of what files say: damaged headers of every kind that MedColor reads, until time is up.

    python Testing/Fuzz/headers.py --minutes 60                     # every kind in turn, a seed of its own for every case
    python Testing/Fuzz/headers.py --minutes 5 --kinds dicom,tiff --seed 7
    python Testing/Fuzz/headers.py --repeat dicom 123456            # one case again, with its traceback

A fault is a crash or a hang of the process, an exception that is no `MedColorError`, or memory taken beyond what the size limit
allows. The cases run in a process of their own; inputs that fault are kept in `fuzz-faults/`. Exit status 1 if there was any.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import re
import select
import signal
import struct
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
import zlib
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
from sound_files import (
    PHOTOGRAPH_SHAPE,
    make_colors,
    make_dicom,
    make_labels,
    make_library,
    make_metaimage,
    make_nifti,
    make_nrrd,
    make_pair,
    make_photographs,
    make_plain,
    make_png,
    make_tiff,
)

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
MAX_BYTES = 10_000_000  # of voxels
MAX_GROWTH = 400 << 20  # bytes that the process may grow by in a case
SECONDS = 30  # for a case, before it counts as a hang
_EXTREMES = (
    "0",
    "-1",
    "1",
    "3",
    "65536",
    "2147483648",
    "99999999999",
    "18446744073709551616",
    "1e308",
    "-1e308",
    "1e-320",
    "nan",
    "inf",
)
_WORDS = (*_EXTREMES, "", "none", "(1,0,0)", '"m"', "LIST", "LOCAL", "../../../x", "/dev/zero", "a b c", "ä", "9" * 400)
_BYTES = (b"\0\0\0\0", b"\xff\xff\xff\xff", b"\x7f\xff\xff\xff", b"\xff\xff\xff\x7f", b"\0\0\0\x80", b"\x80\0\0\0")

# --- what is done with them -----------------------------------------------------------------------------------------


def read_scan(path: Path) -> None:
    """List, read, and look at every voxel."""
    from MedColorLib.io.files import list_volumes, read_volume

    for number in (None, 1):
        try:
            volume = read_volume(path, max_bytes=MAX_BYTES, volume=number)
            with np.errstate(all="ignore"):  # infinities of a damaged file may meet
                float(volume.array.sum(dtype=np.float64))
        except _errors():
            continue
    list_volumes(path)


def read_slices(path: Path) -> None:
    """The folder that a damaged slice lies in."""
    read_scan(path.parent)


def read_labels(path: Path) -> None:
    """A label picture."""
    from MedColorLib.io.label_picture import read_label_picture

    read_label_picture(path)


def read_photograph(path: Path) -> None:
    """A photograph as a reference, and as the mask of one."""
    from MedColorLib.references.given_mask import read_mask
    from MedColorLib.references.pictures import load_picture

    try:
        read_mask(path, PHOTOGRAPH_SHAPE)
    except _errors():
        pass
    load_picture(path)


def read_color_volume(path: Path) -> None:
    """A colour volume as references."""
    from MedColorLib.references.color_sections import read_sections

    read_sections(path)


def read_library(path: Path) -> None:
    """An index, and the references that it names."""
    from MedColorLib.references.library import read_index
    from MedColorLib.references.loading import load_references

    read_index(path.parent)
    load_references([path.parent])


KINDS: dict[str, tuple[Callable[[Path], None], Callable[[Path], None], str]] = {
    "nrrd": (make_nrrd, read_scan, "*.n*r*"),
    "metaimage": (make_metaimage, read_scan, "*.mh*"),
    "nifti": (make_nifti, read_scan, "*.nii*"),
    "pair": (make_pair, read_scan, "*.hdr"),
    "dicom": (make_dicom, read_slices, "*/*.dcm"),
    "png": (make_png, read_slices, "*/*.png"),
    "tiff": (make_tiff, read_scan, "*.tif"),
    "plain": (make_plain, read_slices, "*/*.*"),
    "photograph": (make_photographs, read_photograph, "p.*"),
    "colors": (make_colors, read_color_volume, "*.[mn]*"),
    "labels": (make_labels, read_labels, "*.png"),
    "library": (make_library, read_library, "*.json"),
}


def _errors() -> type[Exception]:
    from MedColorLib.errors import MedColorError

    return MedColorError


def mutated(data: bytes, chance: random.Random) -> bytes:
    """The bytes with one to four damages: numbers and words of text, single bytes, whole words of four bytes, lengths."""
    for _ in range(chance.choice((1, 1, 2, 4))):
        head = min(len(data), chance.choice((64, 600, 4000)))
        at = chance.randrange(max(head, 1))
        damage = chance.randrange(8)
        if damage == 0:
            data = data[:at] + bytes([chance.randrange(256)]) + data[at + 1 :]
        elif damage == 1:
            data = data[:at] + chance.choice(_BYTES) + data[at + 4 :]
        elif damage == 2:
            data = (
                data[: at - at % 2]
                + struct.pack(chance.choice("<>") + "H", chance.choice((0, 1, 2, 255, 32768, 65535)))
                + data[at - at % 2 + 2 :]
            )
        elif damage == 3:
            data = data[:at] + data[at + chance.randrange(1, 30) :]
        elif damage == 4:
            data = data[:at] + data[at : at + chance.randrange(1, 80)] + data[at:]
        elif damage == 5 and chance.random() < 0.3:
            data = data[: chance.randrange(1, max(len(data), 1) + 1)]
        else:
            data = _with_another_word(data, head, chance)
    return data


def _with_another_word(data: bytes, head: int, chance: random.Random) -> bytes:
    """A number of the text replaced; DICOM and TIFF hold numbers as text as well."""
    found = list(re.finditer(rb"[-+0-9.eE]+|[A-Za-z]+", data[:head]))
    if not found:
        return data
    place = chance.choice(found)
    word = chance.choice(_WORDS).encode()
    if chance.random() < 0.5:  # of the same length, so that binary lengths stay right
        word = word[: len(place.group())].ljust(len(place.group()))
    return data[: place.start()] + word + data[place.end() :]


def damaged(kind: str, data: bytes, chance: random.Random) -> bytes:
    """`mutated`; of most PNG photographs with the right check sums, or every reader would stop at the first chunk."""
    data = mutated(data, chance)
    if kind != "photograph" or data[:4] != b"\x89PNG" or chance.random() < 0.2:
        return data
    at, parts = 8, [data[:8]]
    while at + 12 <= len(data):
        size = int.from_bytes(data[at : at + 4], "big")
        body = data[at + 4 : at + 8 + size]
        parts += [data[at : at + 4], body, struct.pack(">I", zlib.crc32(body))]
        at += 12 + size
    return b"".join([*parts, data[at:]])


def run_case(kind: str, seed: int, folder: Path) -> str:
    """One case, in a folder with the sound files. Returns "read" or "refused".

    Raises:
        Exception: a fault.
    """
    _, target, pattern = KINDS[kind]
    chance = random.Random(f"{kind} {seed}")
    path = chance.choice(sorted(folder.glob(pattern)))
    data = path.read_bytes()
    try:
        path.write_bytes(damaged(kind, data, chance))
        target(path)
        return "read"
    except _errors():
        return "refused"
    finally:
        path.write_bytes(data)


# --- a process for the cases ----------------------------------------------------------------------------------------


def _peak_bytes(reset: bool) -> int:
    """Largest memory of this process since the last reset; 0 where the system does not tell."""
    try:
        if reset:
            Path("/proc/self/clear_refs").write_text("5")
        return int(re.search(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text())[1]) << 10
    except (OSError, TypeError):
        return 0


def _too_long(_signal, _frame) -> None:
    raise TimeoutError(f"more than {SECONDS} s")


def work(kind: str, first: int) -> None:
    """Run cases without end; a line of JSON for each, before and after it."""
    warnings.simplefilter("ignore")
    warnings.simplefilter("error", RuntimeWarning)  # what overflows unseen
    signal.signal(signal.SIGALRM, _too_long)
    with tempfile.TemporaryDirectory() as folder:
        KINDS[kind][0](Path(folder))
        for seed in range(first, first + 10**9):
            print(json.dumps({"begins": seed}), flush=True)
            signal.alarm(SECONDS)
            before = _peak_bytes(reset=True)
            try:
                outcome = run_case(kind, seed, Path(folder))
                if before and _peak_bytes(reset=False) - before > MAX_GROWTH:
                    outcome = f"memory: {(_peak_bytes(reset=False) - before) >> 20} MB"
            except (KeyboardInterrupt, BrokenPipeError):
                return
            except BaseException as error:
                signal.alarm(0)
                where = traceback.extract_tb(error.__traceback__)[-1]
                outcome = f"{type(error).__name__} in {Path(where.filename).name}:{where.lineno}: {str(error)[:200]}"
            signal.alarm(0)
            print(json.dumps({"ended": seed, "outcome": outcome}), flush=True)


def fuzz(kind: str, first: int, seconds: float) -> tuple[int, Counter, dict[int, str]]:
    """Cases of one kind until time is up: (how many, outcomes, seed -> fault)."""
    outcomes: Counter = Counter()
    faults: dict[int, str] = {}
    seed, end = first, time.monotonic() + seconds
    while time.monotonic() < end:
        worker = subprocess.Popen(
            [sys.executable, __file__, "--work", kind, str(seed)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
        )
        try:
            while time.monotonic() < end:
                ready, _, _ = select.select([worker.stdout], [], [], 3 * SECONDS)
                line = worker.stdout.readline() if ready else b""
                if not line:
                    faults[seed] = "hang" if not ready else f"the process died ({worker.wait()})"
                    seed += 1
                    break
                said = json.loads(line)
                seed = said.get("begins", seed)
                if "ended" in said:
                    seed += 1
                    outcomes[said["outcome"] if said["outcome"] in ("read", "refused") else "fault"] += 1
                    if said["outcome"] not in ("read", "refused"):
                        faults[said["ended"]] = said["outcome"]
        finally:
            worker.kill()
            worker.wait()
    return seed - first, outcomes, faults


def keep(kind: str, seed: int, where: Path) -> None:
    """Write the input of a case."""
    with tempfile.TemporaryDirectory() as folder:
        KINDS[kind][0](Path(folder))
        chance = random.Random(f"{kind} {seed}")
        path = chance.choice(sorted(Path(folder).glob(KINDS[kind][2])))
        where.mkdir(parents=True, exist_ok=True)
        (where / f"{kind}-{seed}-{path.name}").write_bytes(damaged(kind, path.read_bytes(), chance))


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60)
    parser.add_argument("--seed", type=int, default=0, help="of the first case")
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--faults", type=Path, default=Path("fuzz-faults"), metavar="FOLDER")
    parser.add_argument("--repeat", nargs=2, metavar=("KIND", "SEED"))
    parser.add_argument("--work", nargs=2, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    if arguments.work:
        work(arguments.work[0], int(arguments.work[1]))
        return 0
    if arguments.repeat:
        with tempfile.TemporaryDirectory() as folder:
            KINDS[arguments.repeat[0]][0](Path(folder))
            print(run_case(arguments.repeat[0], int(arguments.repeat[1]), Path(folder)))
        return 0
    kinds = arguments.kinds.split(",")
    bad = 0
    for kind in kinds:
        count, outcomes, faults = fuzz(kind, arguments.seed, arguments.minutes * 60 / len(kinds))
        print(
            f"{kind:<10} {count} cases: {outcomes['read']} read, {outcomes['refused']} refused, {len(faults)} faults",
            flush=True,
        )
        for seed, fault in faults.items():
            print(f"  {kind} {seed}: {fault}", flush=True)
            keep(kind, seed, arguments.faults)
        bad += len(faults)
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
