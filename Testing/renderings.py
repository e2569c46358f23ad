"""Makes the renderings in Resources/Screenshots anew: colours three volumes of the data folder, draws them.

    python Testing/renderings.py COLOURED_FOLDER [PICTURE_FOLDER]

A volume already in COLOURED_FOLDER (NAME.nrrd) is not coloured again. Data: MEDCOLOR_DATA, else ../shared/data.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import cv2

from MedColorLib import colorize, read_color_volume, read_volume, write_color_volume
from MedColorLib.rendering import contact_sheet, corner_cut, render_view
from MedColorLib.rendering.sections import section_frame
from MedColorLib.rendering.sheet import write_png

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("MEDCOLOR_DATA") or ROOT / ".." / "shared" / "data")
HEAD, THORAX = "vhf_head_cryosection.png", "vhf_thorax_cryosection.png"

# Name, scan, photograph, corner that is taken away (R, A, S), where (fractions of the body along R, A, S), sheet.
PICTURES = [
    ("head_ct", "vhf_head_ct.nrrd", HEAD, (-1, 1, 1), None, "ct_head.png"),
    ("head_mr", "head_mr_t1_3d.nii.gz", HEAD, (-1, 1, 1), None, "mr_head.png"),
    ("chest_ct", "chest_ct.nrrd", THORAX, (-1, 1, 1), (0.5, 0.35, 0.4), None),
]
SIDE, DRAWN = 480, 960  # pixels: as kept, and as drawn, for smooth edges


def colored(name: str, scan: Path, photograph: Path, folder: Path):
    """The coloured volume, from the folder or made now."""
    path = folder / f"{name}.nrrd"
    if not path.exists():
        write_color_volume(colorize(read_volume(scan), [photograph]), path)
    return read_color_volume(path)


def main(colored_folder: Path, pictures: Path) -> None:
    """Draw all that is in `PICTURES`."""
    colored_folder.mkdir(parents=True, exist_ok=True)
    pictures.mkdir(parents=True, exist_ok=True)
    for name, scan, photograph, corner, centre, sheet in PICTURES:
        volume = colored(name, DATA / scan, DATA / photograph, colored_folder)
        cut = corner_cut(tuple(section_frame(volume, centre).centre), corner)
        large = render_view(volume, "oblique", (DRAWN, DRAWN), light="realistic", cut=cut)
        write_png(pictures / f"cut_open_{name}.png", cv2.resize(large, (SIDE, SIDE), interpolation=cv2.INTER_AREA))
        print(f"cut_open_{name}.png", flush=True)
        if sheet:
            write_png(pictures / sheet, contact_sheet(read_volume(DATA / scan), volume, size=(840, 504)))
            print(sheet, flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]) if len(sys.argv) > 2 else ROOT / "Resources" / "Screenshots")
