"""Segments become tissues by what they are called: their terminology entries, else their names.

A segmentation of TotalSegmentator has a hundred segments; what is coloured alike is one group. The words are those of
Slicer's and of TotalSegmentator's terminologies, which are English whatever the language of the window.
"""

from __future__ import annotations

import re

# Group: words that begin a word of the name; the first group that has one wins, so that "pulmonary artery" is a vessel.
_WORDS = {
    "vessels": ("arter", "vein", "vena", "aorta", "vessel", "vascul", "sinus_venosus", "carotid", "portal", "jugular"),
    "heart": ("heart", "atri", "ventricle_of_heart", "myocard", "cardiac"),
    "airways and lungs": ("lung", "trachea", "bronch", "airway", "nasal", "sinus", "pulmonary"),
    "bone": (
        "bone", "skull", "vertebra", "rib", "costa", "sternum", "clavic", "scapula", "humerus", "femur", "hip", "sacrum",
        "tibia", "fibula", "radius", "ulna", "mandible", "maxilla", "pelvi", "patella", "carpal", "tarsal", "phalan",
        "tooth", "teeth", "spine", "cortical",
    ),
    "cartilage and ligament": ("cartilage", "ligament", "tendon", "disc", "disk", "menisc"),
    "muscle": ("musc", "gluteus", "autochthon", "iliopsoas", "psoas", "quadriceps", "masseter", "tongue", "diaphragm"),
    "fat": ("fat", "adipos", "subcutan"),
    "skin": ("skin", "scalp", "cutis"),
    "brain and nerves": ("brain", "cerebr", "cerebell", "white", "gray", "grey", "nerve", "spinal", "cord", "thalam", "eye"),
    "fluid": ("fluid", "csf", "ventric", "bladder", "gallbladder", "urine", "bile"),
    "tumour": ("tumor", "tumour", "neoplasm", "lesion", "mass", "cancer", "metasta", "edema", "oedema"),
    "liver and spleen": ("liver", "spleen", "hepat"),
    "kidneys and glands": ("kidney", "adrenal", "pancrea", "thyroid", "gland", "prostate", "renal", "thymus"),
    "bowel and stomach": ("stomach", "bowel", "colon", "duoden", "intestin", "esophag", "oesophag", "rect", "gastr"),
}  # fmt: skip
OTHERS = "others"


def tissue_of(name: str, terminology: str = "") -> str:
    """The group of one segment.

    Args:
        name: of the segment.
        terminology: the value of its tag "TerminologyEntry": parts between "~", each "scheme^code^meaning".
    """
    parts = [part.split("^")[-1] for part in terminology.split("~")]
    # context ~ category ~ type ~ modifier ~ region ~ modifier: the type says most, "Tissue" as a type says nothing
    meanings = [*parts[2:4], name, *parts[4:5]] if len(parts) > 2 else [name]
    for text in meanings:
        words = [word for word in re.split(r"[^a-z]+", text.lower()) if word]
        for group, beginnings in _WORDS.items():
            if any(word.startswith(beginning) for word in words for beginning in beginnings):
                return group
    return OTHERS


def groups_of(segmentation) -> dict[int, str]:
    """Label -> group for the labels 1, 2, ... of a segmentation node's segments in their order."""
    import vtk

    segments, groups = segmentation.GetSegmentation(), {}
    for n in range(segments.GetNumberOfSegments()):
        segment, tag = segments.GetNthSegment(n), vtk.mutable("")
        entry = str(tag) if segment.GetTag("TerminologyEntry", tag) else ""
        groups[n + 1] = tissue_of(segment.GetName() or "", entry)
    return groups
