"""From the tables to what a reader wants first: one line per method, and whether the targets are met."""

from __future__ import annotations

from ..parameters import PRESETS
from .measures import AT_LEAST, DEFAULT
from .outline import BESIDE_TARGET, LEFT_BLACK_TARGET, WORST_TARGET
from .pairs import REMAPS
from .tables import Suite, Table

BASELINES = ("grey", "mean colour", "same position", "look-up table", "perfect match")
SUMMARY_COLUMNS = ("section", "features", "method", "smoother", "gamma", *REMAPS, "average", "seconds")
TARGET_COLUMNS = ("target", "value", "limit", "met")

# (features, method, remap, largest mean CIEDE2000 on the thorax)
ERROR_TARGETS = (
    ("vgg19", "full", "as it is", 4.0),
    ("vgg19", "balanced", "as it is", 2.8),
    ("vgg19", "balanced", "strong", 4.5),
    ("vgg19", "balanced", "inverted", 5.0),
    ("embedded", "balanced", "as it is", 3.5),
    ("embedded", "balanced", "strong", 5.5),
    ("embedded", "balanced", "inverted", 6.0),
)
FLICKER_TARGET = 1 / 3  # of the slices coloured one by one, on real volumes
NETWORK_TARGET = 1.5  # times the bare forward pass
# (features, method, largest seconds a slice of 512 x 512 where the processor has bfloat16, largest share of balanced, VGG-19)
SPEED_TARGETS = (
    ("vgg19", "balanced", 1.5, None),
    ("vgg19", "draft", 0.5, 1 / 3),
    ("embedded", "balanced", 0.375, 1 / 4),
)
COLOUR_SHARE_TARGET = 0.1
SLICE_TARGET_S = 0.1
ALL_TOGETHER = "all together"  # the default's line in the table of improvements
MEMORY_TARGET_MB = 16.0  # beyond input and output, from the fewest slices to the most
_SECONDS_TARGET = 3.0


def own_variant(preset: str) -> dict:
    """Columns of the errors table that tell a preset's own smoother and gamma."""
    return {"smoother": PRESETS[preset].smoother, "gamma": PRESETS[preset].gamma}


def summarise(errors: Table) -> Table:
    """Mean CIEDE2000 by remap: baselines and every method with its preset's smoother and gamma, a line each."""
    table = Table(SUMMARY_COLUMNS)
    lines: dict[tuple, dict] = {}
    for row in errors.where():
        if row["method"] not in BASELINES and not _is_own(row):
            continue
        key = tuple(row[name] for name in SUMMARY_COLUMNS[:5])
        line = lines.setdefault(key, {"seconds": row["seconds"]})
        line[row["remap"]] = row["mean"]
    for key, line in lines.items():
        values = [line.get(remap) for remap in REMAPS]
        average = sum(values) / len(values) if None not in values else None
        columns = dict(zip(SUMMARY_COLUMNS[:5], key))
        table.add(**columns, **dict(zip(REMAPS, values)), average=average, seconds=line["seconds"])
    return table


def _is_own(row: dict) -> bool:
    preset = row["method"].split(",")[0]
    own = own_variant(preset)
    return row["smoother"] == own["smoother"] and row["gamma"] == own["gamma"]


def all_targets(suites: dict[str, Suite]) -> Table:
    """The project's targets, as far as the suites that were run can tell."""
    table = targets(suites["pipeline"]) if "pipeline" in suites else Table(TARGET_COLUMNS)
    found: list[tuple[str, float, float]] = []
    tables = {name: table for suite in suites.values() for name, table in suite.tables.items()}
    if "beaten" in tables:
        lost = len(tables["beaten"].where(met=False))
        found.append(("pairs on which the default does not beat the paper's mode and every baseline", lost, 0))
    for row in tables["coherence"].where() if "coherence" in tables else ():
        if row["volume"] != "phantom":
            share = row["with_coherence"] / row["slice_by_slice"]
            found.append((f"{row['volume']}: flicker as a share of slices coloured one by one", share, FLICKER_TARGET))
    for row in tables["network"].where() if "network" in tables else ():
        if row["what"].startswith("extractor"):
            found.append(("VGG-19: times the bare forward pass", row["ratio"], NETWORK_TARGET))
    found += _speed(tables["volumes"]) if "volumes" in tables else []
    found += _outline(tables["outline"]) if "outline" in tables else []
    if "memory" in tables:
        grown = tables["memory"].where()[-1]
        name = f"memory of {grown['slices']} slices beyond input and output: growth in MB"
        found.append((name, grown["growth_mb"], MEMORY_TARGET_MB))
    for name, value, limit in found:
        table.add(target=name, value=value, limit=limit, met=value <= limit)
    if "seen" in tables:
        for row in tables["seen"].where():
            _add_seen(table, row)
        features = {row["features"] for row in tables["seen"].where(method=DEFAULT)}
        _add_slice_time(table, tables.get("improvements"), features)
    return table


def _add_seen(table: Table, row: dict) -> None:
    """The targets of the measures on real images: mean and, where it has a limit of its own, the worst."""
    if row["met"] is None:
        return
    name = f"{row['measure']}, {row['what']}" + ("" if row["method"] == DEFAULT else f", {row['method']}")
    upwards = row["measure"] in AT_LEAST
    value = float(row["value"])  # "nan" in the table where there is no number
    met = value >= row["limit"] if upwards else value <= row["limit"]
    table.add(target=f"{name}{', at least' if upwards else ''}", value=value, limit=row["limit"], met=met)
    if row["limit_worst"] is not None:
        met = row["worst"] <= row["limit_worst"]
        table.add(target=f"{name}, worst", value=row["worst"], limit=row["limit_worst"], met=met)


def _add_slice_time(table: Table, improvements: Table | None, features: set[str]) -> None:
    """Seconds a slice with the default's features and stages, where they were measured."""
    for row in improvements.where(method=ALL_TOGETHER) if improvements else ():
        if row["features"] in features and row["seconds"] is not None:
            name = f"default ({row['features']}): seconds a slice of 256 x 256"
            table.add(target=name, value=row["seconds"], limit=SLICE_TARGET_S, met=row["seconds"] <= SLICE_TARGET_S)
            return


def _outline(table: Table) -> list[tuple[str, float, float]]:
    """Targets of the body's outline on each volume: what, value, limit."""
    names = {
        "left_black": ("clear tissue left black", LEFT_BLACK_TARGET),
        "worst": ("clear tissue left black in the worst slice", WORST_TARGET),
        "beside_body": ("coloured voxels beside the body", BESIDE_TARGET),
    }
    return [
        (f"{row['volume']}: {text}", row[name], limit) for row in table.where() for name, (text, limit) in names.items()
    ]


def _speed(volumes: Table) -> list[tuple[str, float, float]]:
    """Targets of speed on each real volume: what, value, limit."""
    found = []
    for volume in dict.fromkeys(row["volume"] for row in volumes.where()):
        rows = {(row["features"], row["method"]): row for row in volumes.where(volume=volume)}
        whole = rows.get(("vgg19", "balanced"))
        for features, method, limit, share in SPEED_TARGETS:
            row = rows.get((features, method))
            if row:
                found.append((f"{volume}: {features} {method}, seconds a slice", row["seconds"], limit))
            if row and whole and share:
                name = f"{volume}: {features} {method}, time as a share of vgg19 balanced"
                found.append((name, row["seconds"] / whole["seconds"], share))
        if whole:
            found.append((f"{volume}: vgg19 balanced, matching over features", whole["matching_over_features"], 1.0))
            found.append((f"{volume}: vgg19 balanced, share of colour", whole["colour_share"], COLOUR_SHARE_TARGET))
    return found


def targets(suite: Suite) -> Table:
    """The targets of the suite pipeline, on the thorax; not measured where the section or the weights are not here."""
    table = Table(TARGET_COLUMNS)
    errors = suite.tables["errors"]
    for features, method, remap, limit in ERROR_TARGETS:
        found = errors.where(section="thorax", remap=remap, features=features, method=method, **own_variant(method))
        value = found[0]["mean"] if found else None
        name = f"{features} {method}, thorax {remap}: mean CIEDE2000"
        table.add(target=name, value=value, limit=limit, met=None if value is None else value <= limit)
    for features in ("vgg19", "embedded"):
        found = suite.tables["calls"].where(features=features, method="balanced")
        value = found[0]["seconds"] if found else None
        name = f"{features} balanced, one slice of 256 x 256 by colorize(): seconds"
        table.add(
            target=name, value=value, limit=_SECONDS_TARGET, met=None if value is None else value <= _SECONDS_TARGET
        )
    return table
