"""Deconvolution (`--reconstruction lbfgs`): loss and colour error against its iterations; part of the suite correspondence."""

from __future__ import annotations

import time

from ..matching.reconstruction import Deconvolution
from ..progress import Progress
from .matched import Matched, Method, Transfer
from .pairs import Section, make_pair
from .quality import color_errors
from .tables import Suite, Table

COLUMNS = (
    "section", "remap", "iterations", "loss_before", "loss_after", "evaluations", "converged", "of", "mean_matched", "mean",
    "seconds",
)  # fmt: skip
ITERATIONS = (8, 16, 32)

NOTES = [
    "deconvolution: the preset full with features brought one layer down by L-BFGS, stopped after so many iterations; 0 is "
    "warp, which takes the reference's own finer features. loss: |CNN(R) - warped|^2 / |warped|^2, the mean over layers 4 to 1 "
    "and both directions; converged: how many of the `of` deconvolutions ended before the iterations did. mean_matched: mean "
    "CIEDE2000 of the matched a*, b* on the pair, votes of the matches alone; mean: after the paper's transfer. seconds: of one "
    "match, measured once.",
]


def run(suite: Suite, section: Section, quick: bool, seed: int, progress: Progress) -> None:
    """Add the table; VGG-19 has to be here. A quick run: one pair, 8 iterations, layers 5 and 4 only."""
    table = suite.tables["deconvolution"] = Table(COLUMNS)
    suite.notes += NOTES
    remaps, counts = (("as it is",), (0, 8)) if quick else (("as it is", "inverted"), (0, *ITERATIONS))
    jobs = [(remap, count) for remap in remaps for count in counts]
    for number, (remap, count) in enumerate(jobs):
        progress(number / len(jobs), f"deconvolution, {remap}, {count} iterations")
        add_row(table, section, remap, count, seed, stop_layer=4 if quick else None)


def add_row(table: Table, section: Section, remap: str, iterations: int, seed: int, stop_layer: int | None) -> None:
    """Match one pair with so many iterations; 0 warps."""
    pair = make_pair(section, remap, seed)
    matched = Matched(pair.volume, section.rgb, Method("vgg19", "full", stop_layer))
    if iterations:
        matched.engine.reconstruct = Deconvolution(matched.engine.extractor, iterations)
    start = time.perf_counter()
    matched.match()
    seconds = time.perf_counter() - start
    solved = matched.engine.reconstruct.solved if iterations else []
    losses = [sum(getattr(one, name) for one in solved) / len(solved) for name in ("before", "after")] if solved else ()
    columns = dict(zip(("loss_before", "loss_after"), losses))
    means = {
        "mean_matched": color_errors(matched.unsmoothed()[..., 1:], pair).mean,
        "mean": color_errors(matched.colored(Transfer("fgs", gamma=True, luminance="paper"))[..., 1:], pair).mean,
    }
    counts = {"evaluations": sum(one.evaluations for one in solved), "converged": sum(one.converged for one in solved)}
    keys = {"section": section.name, "remap": remap, "iterations": iterations, "of": len(solved)}
    table.add(**keys, **columns, **counts, **means, seconds=seconds)
