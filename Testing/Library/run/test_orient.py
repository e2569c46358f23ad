"""Which way up a reference lies: the same wherever a slab ends, and sure where the picture lies on its side."""

from __future__ import annotations

from dataclasses import replace

import cv2
import pytest

from MedColorLib import Settings, read_volume
from MedColorLib.matching.orientation import laid
from MedColorLib.progress import Run
from MedColorLib.run.engine import Engine
from MedColorLib.run.prepare import prepare

OWN = Settings(features="embedded")


def test_a_chest_that_begins_two_slices_higher_is_not_mirrored(shared_data):
    """The first slab by itself says by 0.014 of similarity that the photograph is mirrored, the other by 0.012."""
    volume, photograph = read_volume(shared_data / "chest_ct.nrrd"), str(shared_data / "vhf_thorax_cryosection.png")
    for slices in ((20, 50), (22, 48)):
        prepared = prepare(volume, [photograph], replace(OWN, slices=slices))
        assert Engine(prepared, Run(None, None)).references[0].way == "turned by half"


@pytest.mark.parametrize("way", ["turned left", "turned right and mirrored"])
def test_a_photograph_on_its_side_is_no_guess(shared_data, way):
    """Of left and right nothing is known, and then it counts as not mirrored."""
    volume = read_volume(shared_data / "mr_head_t1_dicom")
    photograph = cv2.imread(str(shared_data / "vhf_head_cryosection.png"))[..., ::-1]
    lie = Engine(prepare(volume, [laid(photograph, way)], OWN), Run(None, None)).references[0].lie
    assert lie.way == way.partition(" and ")[0] and not lie.guess
