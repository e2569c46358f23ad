"""Stage *rendering*: views, sections and the contact sheet of a coloured volume, without a display.

`presets` holds the numbers, `surface` makes luminance alpha, `grid` the voxels that the ray caster needs, `offscreen`
is all of VTK, `views` places cameras, `sections` makes the three planes, `sheet` puts grey beside colour on `layout`'s
paper. VTK is imported when something is drawn.
"""

from .grid import Cut, grey_color_volume
from .presets import opacity_points
from .sections import sections
from .sheet import contact_sheet, render_to_png
from .views import VIEWS, corner_cut, render_view

__all__ = [
    "VIEWS",
    "Cut",
    "contact_sheet",
    "corner_cut",
    "grey_color_volume",
    "opacity_points",
    "render_to_png",
    "render_view",
    "sections",
]
