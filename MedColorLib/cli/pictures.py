"""`medcolor render`: the sheet, a single view, or a turn."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from ..errors import SettingsError

if TYPE_CHECKING:
    from ..rendering import Cut
    from ..volume import ColorVolume

SIDES = {  # what --cut takes away -> the axis (R, A, S) and the sign of it
    "left": (0, -1),
    "right": (0, 1),
    "front": (1, 1),
    "back": (1, -1),
    "top": (2, 1),
    "bottom": (2, -1),
}


def render(arguments, bar, say_notes) -> list:
    """Draw what was asked for and return the paths written.

    `bar` makes a progress bar, `say_notes` prints what the reader of the grey volume decided.
    """
    from ..io.files import read_color_volume, read_volume

    if not arguments.output and not arguments.turntable:
        raise SettingsError("render: name the picture with -o OUT.png, or a turn with --turntable OUT.mp4")
    color = read_color_volume(arguments.volume)
    look = {"light": arguments.light}
    if arguments.opacity is not None:
        look["opacity"] = arguments.opacity
    if arguments.view or arguments.cut or arguments.turntable:
        return _single(arguments, color, look, bar)
    from ..rendering import render_to_png

    left = read_volume(arguments.grey, volume=arguments.number) if arguments.grey else None
    if left:
        say_notes(left)
    if arguments.beside:
        left = read_color_volume(arguments.beside)
    titles = tuple(arguments.titles or ("Other" if arguments.beside else "Scan", "Coloured"))
    size = tuple(arguments.size or (1600, 1200))
    with bar("rendering") as progress:
        render_to_png(arguments.output, color, left, size=size, titles=titles, progress=progress, **look)
    return [arguments.output]


def _single(arguments, color, look: dict, bar) -> list:
    """A view, and a turn where one was asked for."""
    from ..rendering import png_target, render_view, turntable, write_png

    if arguments.grey or arguments.beside or arguments.titles:
        raise SettingsError(
            "render: --grey, --beside and --titles belong to the sheet; leave out --view, --cut, --turntable"
        )
    view = arguments.view or "oblique"
    written: list = []
    look["cut"] = cut_from(arguments.cut, color) if arguments.cut else None
    if arguments.output:
        target, size = png_target(arguments.output), tuple(arguments.size or (1600, 1600))
        with bar("rendering") as progress:
            progress(0.1, view)
            picture = render_view(color, view, size, **look)
        write_png(target, picture)
        written.append(target)
    if arguments.turntable:
        size = tuple(arguments.size or (800, 800))
        with bar("turning") as progress:
            written.append(turntable(arguments.turntable, color, view, size, progress=progress, **look))
    return written


def cut_from(sides: Sequence[str], color: ColorVolume) -> Cut | None:
    """The `Cut` through the middle of the body that takes the given sides away: one a half, two a quarter, three an eighth."""
    from ..rendering import corner_cut
    from ..rendering.sections import section_frame

    towards = [0, 0, 0]
    for side in sides:
        axis, sign = SIDES[side]
        if towards[axis] == -sign:
            raise SettingsError(f"render: --cut {' '.join(sides)} takes both sides away; name one of them")
        towards[axis] = sign
    frame = section_frame(color)
    return None if frame is None else corner_cut(tuple(frame.centre), tuple(towards))
