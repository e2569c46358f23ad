"""The tissues of the head made by formula, and what each looks like in CT, in MR and on a photograph."""

from __future__ import annotations

# tissue: (CT in HU, T1 MR signal, sRGB colour)
TISSUES = {
    "air": (-1000, 4, (0, 0, 0)),
    "skin": (40, 420, (206, 162, 128)),
    "fat": (-95, 900, (232, 206, 146)),
    "muscle": (55, 380, (112, 44, 38)),
    "bone": (1000, 60, (232, 220, 190)),
    "grey matter": (39, 400, (168, 118, 100)),
    "white matter": (29, 610, (220, 192, 160)),
    "fluid": (8, 120, (92, 60, 50)),
    "eye": (12, 160, (50, 48, 44)),
    "marrow": (260, 560, (186, 122, 90)),
    "mucosa": (45, 330, (160, 76, 70)),
    "lens": (85, 230, (176, 152, 70)),
    "fibrous tissue": (60, 220, (214, 196, 172)),
    "tooth": (2200, 20, (240, 232, 208)),
    "blood": (58, 170, (70, 22, 24)),
}
NUMBER = {name: number for number, name in enumerate(TISSUES)}
