"""Suite *profile*: where the time of a slice goes, and how far each stage is from what the machine can do."""

from __future__ import annotations

import tempfile
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
import torch

from ..device import fast_dtype, side_by_side
from ..features import CONTEXT_WEIGHTS
from ..features.weights import find_weights, load_weights
from ..io.files import write_color_volume
from ..matching import analogy, contrast_match, vote
from ..matching.fields import exact, patches
from ..parameters import Settings
from ..progress import Progress, Run
from ..run.engine import Engine
from ..run.paint import Painter
from ..run.prepare import Prepared, prepare
from ..volume import ColorVolume, Volume
from . import real_volumes, suite_pipeline, work
from .machine import Machine, measure_machine
from .pairs import Section, make_pair
from .stopwatch import Stopwatch
from .tables import TIME_COLUMNS, Suite, Table, seconds_of, timed

ONCE = ("prepare", "network and contrast")
PER_SLICE = (
    "features", "similarity product", "box sum", "argmax", "descent", "vote", "rest of matching", "colour", "writing",
)  # fmt: skip
COLUMNS = (
    "features", "method", "side_px", "stage", "per", "share", "operations", "bytes_moved", "gflop_per_s", "gb_per_s",
    "share_of_limit", *TIME_COLUMNS,
)  # fmt: skip
NETWORK_COLUMNS = ("features", "what", "precision", "ratio", *TIME_COLUMNS)

NOTES = [
    "One slice through the pipeline; functions are replaced by timed ones while it runs, and the time of a stage is without "
    "the stages inside it. share: of the stages that are done for every slice; those done once a volume have none.",
    "prepare holds finding body and window, and the photograph's tissue; network and contrast: the weights, the photograph's "
    "orientation and features, the learned contrast. descent: a layer's own features blended with those matched above; "
    "MedColor's own network has one layer, and none. rest of matching: components of the features, unit vectors, context, "
    "trust, and bringing the slice to the raster.",
    f"operations and bytes_moved are counted from the shapes. {work.formulas()}",
    "share_of_limit: the least time by the measured rates of this machine (the larger of operations / matrix product and "
    "bytes / copy) over the time taken; small arrays stay in the cache, where moving is faster than the copy measured.",
    "network: the extractor against the bare forward pass of the same convolutions in torch, same type and weights, from "
    "three planes to relu5_1, in the faster of the two memory orders.",
]


def run(section: Section, data: Path | None, quick: bool, seed: int, progress: Progress) -> Suite:
    """Measure the machine, every stage by features, preset and size of the slice, the bare network, and real volumes."""
    progress(0.0, "profile, rates of the machine")
    machine = measure_machine(quick)
    suite = Suite({"stages": Table(COLUMNS), "machine": machine.table()}, notes=list(NOTES))
    names = ("vgg19", "embedded") if suite_pipeline.has_network() else ("embedded",)
    jobs = [(n, p, s) for n in names for p in ("draft", "balanced") for s in (256, 512)]
    if quick:
        jobs = [(names[-1], "balanced", 256)]
    for number, (name, preset, side) in enumerate(jobs):
        progress(0.1 + 0.2 * number / len(jobs), f"profile, {name} {preset}, {side} x {side}")
        settings = Settings(preset=preset, features=name, window=(0.0, 1.0))
        measure(suite.tables["stages"], machine, slice_volume(section, side, seed), section.rgb, settings, quick)
    if "vgg19" in names:
        progress(0.3, "profile, bare network")
        suite.tables["network"] = measure_network(3 if quick else 7)
    else:
        suite.failures.append(("VGG-19 and the bare network", "no weights here"))
    if not quick:
        real_volumes.run(suite, data, lambda f: progress(0.35 + 0.65 * f, "profile, real volumes"))
    return suite


def slice_volume(section: Section, side: int, seed: int) -> Volume:
    """The target of a pair as a slice of side x side pixels."""
    import cv2

    volume = make_pair(section, "as it is", seed).volume
    resized = cv2.resize(volume.array[0], (side, side), interpolation=cv2.INTER_LINEAR)
    return Volume(resized[None], volume.ijk_to_ras, name=volume.name)


def measure(table: Table, machine: Machine, volume: Volume, rgb: np.ndarray, settings: Settings, quick: bool) -> None:
    """Add the stages of one configuration."""
    runs = 3 if quick else 5
    prepared, seconds = timed(lambda: prepare(volume, [rgb], settings), 2)
    once = {"prepare": seconds}
    start = time.perf_counter()
    engine = Engine(prepared, Run(None, None))
    once["network and contrast"] = seconds_of([time.perf_counter() - start])
    engine.match([0], 0)  # warm-up, and the photograph's features
    laps: dict[str, list[float]] = defaultdict(list)
    for _ in range(runs):
        for stage, value in _one_lap(prepared, engine).items():
            laps[stage].append(value)
    medians = {stage: float(np.median(values)) for stage, values in laps.items()}
    done = stage_work(prepared, engine, rgb)
    keys = {"features": settings.features, "method": settings.preset, "side_px": volume.array.shape[1]}
    for stage in (*ONCE, *(stage for stage in PER_SLICE if stage in laps)):
        taken = once.get(stage) or seconds_of(laps[stage])
        share = None if stage in once else medians[stage] / sum(medians.values())
        row = {**keys, "stage": stage, "per": "volume" if stage in once else "slice", "share": share}
        table.add(**row, **_rates(done.get(stage), taken.median, machine), **taken.columns())


def _one_lap(prepared: Prepared, engine: Engine) -> dict[str, float]:
    """Seconds of every stage of PER_SLICE for slice 0."""
    watch = Stopwatch()
    places = (
        (engine.extractor, "extract", "features"),
        (exact.PatchSums, "_summed", "box sum"),
        (exact.PatchSums, "_multiply", "similarity product"),
        (exact, "search", "argmax"),
        (patches, "_products", "similarity product"),
        (patches, "search", "argmax"),
        (analogy, "_descend", "descent"),
        (vote, "matched_colors", "vote"),
    )
    stack = np.zeros((*prepared.view.shape, 3), np.uint8)
    with watch.watching(*places), tempfile.TemporaryDirectory() as folder:
        with watch.stage("rest of matching"):
            matches = engine.match([0], 0)
        with watch.stage("colour"), side_by_side() as each:
            Painter(prepared, engine, stack, each=each).add([0], matches)
        with watch.stage("writing"):
            write_color_volume(ColorVolume(stack, prepared.volume.ijk_to_ras), Path(folder) / "slice.nrrd")
    return {stage: watch.seconds[stage] for stage in PER_SLICE if stage not in _not_done(engine)}


def _not_done(engine: Engine) -> tuple[str, ...]:
    """Stages that MedColor's own features do not have: they have one layer, and in bfloat16 whole patches are multiplied."""
    if not engine.own_features:
        return ()
    return ("descent", "box sum") if _whole_patches(engine) else ("descent",)


def _whole_patches(engine: Engine) -> bool:
    return engine.own_features and contrast_match.by_whole_patches(
        fast_dtype(torch.device(engine.device)), engine.device
    )


def stage_work(prepared: Prepared, engine: Engine, rgb: np.ndarray) -> dict[str, work.Work]:
    """What the stages have to do, by formula; see `work`."""
    raster, pixels = prepared.grid.height * prepared.grid.width, prepared.view[0].size
    shapes = {layer: values.shape for layer, values in engine.features_of(0).layers.items()}
    matching = work.matching_work(
        {layer: shape[2] * shape[3] for layer, shape in shapes.items()},
        {layer: _compared(engine, shape[1]) for layer, shape in shapes.items()},
    )
    if _whole_patches(engine):
        (shape,) = shapes.values()
        inside = engine.slices_on_grid([0])[1].mean(), engine.references[0].mask.mean()
        positions = [share * shape[2] * shape[3] for share in inside]
        matching = work.patches_work(*positions, _compared(engine, shape[1]))
    if engine.own_features:
        features = work.own_work(raster, engine.extractor.context)
    else:
        features = work.vgg19_work(raster, str(engine.extractor.dtype).removeprefix("torch."))
    return {
        "prepare": work.Work(None, prepared.volume.array.nbytes + rgb.nbytes),
        "features": features,
        **matching,
        "colour": work.color_work(raster, pixels),
        "writing": work.Work(None, 3 * pixels),
    }


def _compared(engine: Engine, channels: int) -> int:
    """Numbers a position in the pairs that are matched: latent ones beside VGG-19's, and what tells place and grey."""
    if engine.own_features:
        return channels + 4  # row and column, each a point on a circle
    context = CONTEXT_WEIGHTS[engine.extractor.name] if engine.uses_context else (0, 0)
    return 2 * channels + sum(size for size, weight in zip((4, 2), context) if weight)


def _rates(done: work.Work | None, seconds: float, machine: Machine) -> dict:
    if done is None:
        return {}
    least = machine.least_seconds(done.operations, done.moved, done.kind)
    rate = None if done.operations is None else done.operations / seconds / 1e9
    return {
        "operations": done.operations,
        "bytes_moved": done.moved,
        "gflop_per_s": rate,
        "gb_per_s": done.moved / seconds / 1e9,
        "share_of_limit": least / seconds,
    }


def measure_network(runs: int, side: int = 256) -> Table:
    """VGG-19's extractor beside the bare forward pass; ratio: times the bare one."""
    from ..features.vgg19 import VGG19

    weights = load_weights(find_weights("vgg19").path)
    network = VGG19(weights)
    grey = torch.rand(1, 1, side, side, generator=torch.Generator().manual_seed(0))
    planes = grey.expand(1, 3, -1, -1).to(network.dtype)
    orders = {"contiguous": torch.contiguous_format, "channels last": torch.channels_last}
    bare = {name: timed(_bare(weights, planes, order), runs)[1] for name, order in orders.items()}
    order = min(bare, key=lambda name: bare[name].median)
    own = timed(lambda: network.extract(grey, (5, 4, 3)), runs)[1]
    table, keys = Table(NETWORK_COLUMNS), {"features": "vgg19", "precision": str(network.dtype).removeprefix("torch.")}
    table.add(**keys, what="extractor, layers 5 to 3", ratio=own.median / bare[order].median, **own.columns())
    table.add(**keys, what=f"bare forward pass, {order}", ratio=1.0, **bare[order].columns())
    return table


def _bare(weights, planes: torch.Tensor, order: torch.memory_format):
    """A call of the convolutions, ReLUs and poolings up to relu5_1, nothing else."""
    names = [[f"conv{b}_{i}" for i in range(1, depth + 1)] for b, depth in enumerate((2, 2, 4, 4, 1), start=1)]
    layers = [
        [(weights.tensor(f"{n}.weight").to(planes.dtype).contiguous(memory_format=order),
          weights.tensor(f"{n}.bias").to(planes.dtype)) for n in block]
        for block in names
    ]  # fmt: skip
    start = planes.contiguous(memory_format=order)

    def forward() -> torch.Tensor:
        x = start
        with torch.no_grad():
            for number, block in enumerate(layers):
                x = torch.nn.functional.max_pool2d(x, 2) if number else x
                for kernel, bias in block:
                    x = torch.relu_(torch.nn.functional.conv2d(x, kernel, bias, padding=1))
        return x

    return forward
