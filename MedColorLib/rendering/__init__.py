"""Stage *rendering*: views, sections and the contact sheet of a coloured volume, without a display.

`presets` holds the numbers, `surface` makes luminance alpha, `grid` the voxels that the ray caster needs, `offscreen`
is all of VTK, `views` places cameras, `sections` makes the three planes, `sheet` puts grey beside colour on `layout`'s
paper, `lights` has the lamps, `turntable` makes films. VTK is imported when something is drawn.
"""

from .grid import Cut, grey_color_volume
from .lights import LIGHTS
from .presets import opacity_points
from .sections import sections
from .sheet import contact_sheet, png_target, render_to_png, write_png
from .turntable import turntable
from .views import VIEWS, corner_cut, render_view

__all__ = [
    "LIGHTS",
    "VIEWS",
    "Cut",
    "contact_sheet",
    "corner_cut",
    "grey_color_volume",
    "opacity_points",
    "png_target",
    "render_to_png",
    "render_view",
    "sections",
    "turntable",
    "write_png",
]
