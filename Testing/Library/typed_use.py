"""How a program uses the library, for the type checker; `test_python_package` runs it. Not imported by any test."""

from __future__ import annotations

from MedColorLib import (
    ColorVolume,
    Guard,
    Plan,
    Resume,
    Settings,
    Volume,
    colorize,
    make_plan,
    read_color_volume,
    read_volume,
    run_batch,
    write_color_volume,
    write_confidence,
)


def colour(path: str, reference: str) -> ColorVolume:
    """Every public step, with the types a user would write."""
    volume: Volume = read_volume(path, volume=1)
    settings = Settings(preset="draft", luminance="natural", lightness=0.9, exposure="auto", confidence=True)
    plan: Plan = make_plan(volume, [reference], settings)
    print(plan.text(), volume.spacing_mm)
    guard = Guard(volume, groups={1: 1})
    result: ColorVolume = colorize(volume, [reference], settings, progress=report, resume=Resume(), guard=guard)
    write_color_volume(result, "colored.nrrd")
    write_confidence(result, "confidence.nrrd")
    print(run_batch("scans", [reference], "out", settings, workers=2).failed)
    return read_color_volume("colored.nrrd")


def report(fraction: float, text: str) -> None:
    """A progress callback."""
    print(fraction, text)


def wrong() -> None:
    """What a type checker must refuse."""
    Settings(preset="drafft")  # type: ignore[arg-type]
    Settings(luminance="bright")  # type: ignore[arg-type]
    read_volume(3)  # type: ignore[arg-type]
