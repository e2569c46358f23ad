"""Which way up a reference lies does not hang on where a slab ends."""

from __future__ import annotations

from MedColorLib import Settings, read_volume
from MedColorLib.progress import Run
from MedColorLib.run.engine import Engine
from MedColorLib.run.prepare import prepare


def test_a_chest_that_begins_two_slices_higher_is_not_mirrored(shared_data):
    """The first slab by itself says by 0.014 of similarity that the photograph is mirrored, the other by 0.012."""
    volume, photograph = read_volume(shared_data / "chest_ct.nrrd"), str(shared_data / "vhf_thorax_cryosection.png")
    for slices in ((20, 50), (22, 48)):
        prepared = prepare(volume, [photograph], Settings(features="embedded", slices=slices))
        assert Engine(prepared, Run(None, None)).references[0].way == "turned by half"
