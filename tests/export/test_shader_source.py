"""Decoder source: numbers survive, names are valid everywhere, and the three languages compile."""

import re

import numpy as np
import pytest

from tests.export import hosts
from tests.fake_assets import random_bcf
from warp_neumat.export.languages import LANGUAGES, field_names, literal
from warp_neumat.export.shader_source import lod_bias, maps_of, prefix_of, shader_source

AWKWARD = ["filter", "sample", "mask dirt", "mask-dirt", "Größe", "影", "2nd", "float3", 'a"\\', "line\nbreak"]
"""Map names that are reserved, collide, or are no identifiers."""


def awkward_asset(rng):
    """Return (name, tensors, config) with every awkward name, all encodings and constants of every width."""
    tensors, header = random_bcf(rng, features=(16, 8, 4), channels=15, hidden=10)
    config = header["config"]
    channels = [dict(channel) for channel in config["channels"]]
    for channel, name in zip(channels[5:9] + channels[12:], AWKWARD, strict=False):
        channel |= {"map": name, "encoding": "linear", "range": [-1.5, 0.1]}
    constants = {name: [0.25, 0.5, 0.75, 1.0][: n + 1] for n, name in enumerate(AWKWARD[7:])}
    return "3 Grün\\", tensors, config | {"channels": channels, "constants": constants}


@pytest.mark.parametrize("value", [0.1, -1 / 3, 5.960464477539063e-08, 65504, 1e-30, -0.0, 16777216])
def test_literals_read_back_exactly(value):
    text = literal(value)
    assert np.float32(float(text)) == np.float32(value)
    assert re.fullmatch(r"-?\d+(\.\d+)?(e[-+]?\d+)?", text)
    assert "." in text or "e" in text  # a literal without them would be an integer


def test_a_constant_that_no_literal_can_be_is_refused():
    with pytest.raises(ValueError, match="a shader constant must be finite, got inf"):
        literal(np.inf)


@pytest.mark.parametrize("language", LANGUAGES)
def test_baked_weights_are_the_assets(rng, language):
    tensors, header = random_bcf(rng)
    text = shader_source(language, "m", header["config"], tensors, baked=True)
    body = re.search(r"(?s)_network\(.*?\n}", text)[0]
    number = r"-?\d+\.?\d*(?:e[-+]\d+)?"
    rows = re.findall(rf"dot\(\w+\(({number}), ({number}), ({number}), ({number})\)", body)
    found = np.array(rows, np.float64)
    for layer, (name, inputs) in enumerate((("weight0", 12), ("weight1", 16))):
        expected = tensors[name].astype(np.float64)
        count = expected.size // 4
        part = found[:count] if layer == 0 else found[-count:]
        np.testing.assert_array_equal(part.reshape(-1, inputs), expected)
    assert len(found) == (tensors["weight0"].size + tensors["weight1"].size) // 4


def test_fields_are_identifiers_and_distinct():
    fields = field_names(AWKWARD)
    assert list(fields) == AWKWARD
    assert len(set(fields.values())) == len(AWKWARD)
    assert all(re.fullmatch(r"[a-z][a-z0-9]*(_[a-z0-9]+)*", field) for field in fields.values()), fields
    assert fields["filter"] == "map_filter"
    assert {fields["mask dirt"], fields["mask-dirt"]} == {"mask_dirt", "mask_dirt_2"}


def test_components_are_ordered_whatever_the_order_of_the_channels(rng):
    config = random_bcf(rng, channels=5)[1]["config"]
    config = config | {"channels": [config["channels"][n] for n in (4, 2, 0, 3, 1)]}
    found = {m.name: m.channels for m in maps_of(config)}
    assert found == {"normal": (3, 0), "base_color": (2, 4, 1), "specular": ()}


def test_bias_is_that_of_equation_11():
    config = {"width": 2048, "height": 1024}
    assert lod_bias(config, {"width": 256, "height": 256}) == -2  # max(256/1024, 256/2048) = 1/4


def test_prefix_is_an_identifier_for_any_file_name():
    assert prefix_of("Bricks 097-2K") == "bcf_Bricks_097_2K"
    assert prefix_of("3__Grün") == "bcf_3_Gr_n"
    assert prefix_of("影") == "bcf_material"


@pytest.mark.parametrize("baked", [False, True], ids=["buffer", "baked"])
@pytest.mark.parametrize("language", ["glsl", "hlsl"])
def test_fragment_shaders_compile(rng, tmp_path, language, baked):
    name, tensors, config = awkward_asset(rng)
    decoder = shader_source(language, name, config, tensors, baked=baked)
    assert decoder.isascii()
    host = hosts.fragment_host(language, name, config, decoder, baked=baked)
    assert len(hosts.spirv(language, "frag", host, tmp_path)) > 1000


def test_a_broken_shader_does_not_compile(rng, tmp_path):
    name, tensors, config = awkward_asset(rng)
    decoder = shader_source("glsl", name, config, tensors).replace("_lo(uint row)", "_low(uint row)")
    host = hosts.fragment_host("glsl", name, config, decoder, baked=False)
    with pytest.raises(AssertionError, match="no matching overloaded function"):
        hosts.spirv("glsl", "frag", host, tmp_path)


def test_two_materials_fit_into_one_shader(rng, tmp_path):
    tensors, header = random_bcf(rng)
    decoders = [shader_source("hlsl", name, header["config"], tensors) for name in ("one", "two")]
    host = hosts.fragment_host("hlsl", "two", header["config"], "\n".join(decoders), baked=False)
    assert hosts.spirv("hlsl", "frag", host, tmp_path)
