"""Which features are taken: MedColor's own unless others are asked for, the paper's for the paper's preset where they are."""

from __future__ import annotations

import json
import struct

import pytest
from weights_samples import random_tensors, write_quantised

from MedColorLib.errors import SettingsError, WeightsError
from MedColorLib.features import EXTRACTORS, OWN_WEIGHTS, choose_features, make_extractor, own_weights_sha256
from MedColorLib.parameters import PRESETS, Settings


class TestWithoutWeights:
    @pytest.fixture(autouse=True)
    def no_weights(self, cache):
        assert not cache.exists()

    @pytest.mark.parametrize("preset", PRESETS)
    def test_auto_is_the_own_network(self, preset):
        assert choose_features("auto", preset) == choose_features("embedded", preset) == "embedded"
        assert make_extractor("embedded").name == "embedded"

    @pytest.mark.parametrize("name", [n for n in EXTRACTORS if n != "embedded"])
    def test_a_named_network_says_what_to_do(self, name):
        with pytest.raises(
            WeightsError, match=f"features {name}: no weights found; run 'medcolor weights fetch {name}'"
        ):
            choose_features(name)

    def test_unknown_name(self):
        with pytest.raises(SettingsError, match="'resnet' is not one of auto, embedded, vgg19, gray-vgg19"):
            choose_features("resnet")


class TestWithWeights:
    @pytest.fixture(autouse=True)
    def weights(self, cache, tmp_path, monkeypatch):
        write_quantised(tmp_path / "narrow.safetensors", random_tensors("vgg19"))
        monkeypatch.setenv("MEDCOLOR_WEIGHTS", str(tmp_path / "narrow.safetensors"))

    @pytest.mark.parametrize(
        ("preset", "features"), [("draft", "embedded"), ("balanced", "embedded"), ("full", "vgg19")]
    )
    def test_auto_takes_vgg19_for_the_papers_preset_alone(self, preset, features):
        assert choose_features("auto", preset) == features

    def test_auto_of_the_defaults_is_the_own_network(self):
        assert (
            choose_features(Settings().features)
            == choose_features(Settings().features, Settings().preset)
            == "embedded"
        )

    @pytest.mark.parametrize("preset", PRESETS)
    def test_whoever_asks_by_name_gets_it(self, preset):
        assert choose_features("vgg19", preset) == "vgg19" and choose_features("embedded", preset) == "embedded"


def test_own_weights_are_known_by_their_content(monkeypatch, tmp_path):
    """Whoever keeps descriptors or matches tells them by this hash."""
    own = own_weights_sha256()
    assert make_extractor("embedded").provenance()["sha256"] == own
    changed = bytearray(OWN_WEIGHTS.read_bytes())
    length = struct.unpack("<Q", changed[:8])[0]
    assert json.loads(changed[8 : 8 + length])  # safetensors
    changed[-1] ^= 1
    (tmp_path / "other.safetensors").write_bytes(changed)
    monkeypatch.setattr("MedColorLib.features.OWN_WEIGHTS", tmp_path / "other.safetensors")
    own_weights_sha256.cache_clear()
    other = own_weights_sha256()
    own_weights_sha256.cache_clear()
    assert other != own


def test_missing_own_weights_are_named(monkeypatch, tmp_path):
    monkeypatch.setattr("MedColorLib.features.OWN_WEIGHTS", tmp_path / "none.safetensors")
    own_weights_sha256.cache_clear()
    with pytest.raises(WeightsError, match="weights of the own features cannot be read"):
        own_weights_sha256()
