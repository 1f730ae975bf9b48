"""Exported decoders run on a Vulkan device, through its own sampler, against the float64 reference.

All shaders run in one process of their own (wgpu_host.py), which may fail or hang without taking the suite along.
"""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.export import hosts
from tests.export.wgpu_host import MISSING
from tests.fake_assets import random_bcf
from warp_neumat.export.golden import decoded, golden_inputs, golden_vector
from warp_neumat.export.languages import LANGUAGES
from warp_neumat.export.shader_source import maps_of, shader_source
from warp_neumat.export.weight_layout import pack_weights
from warp_neumat.io.block_formats import BlockTexture
from warp_neumat.materials.bcf import BCf
from warp_neumat.reference import bcf as reference

QUERIES = 3072
EXACT = QUERIES // 3
DERIVATIVES = "narrow"
"""Shape whose cases call ``sample_grad``, too: drivers take seconds for every further copy of a large network."""
BASE_ROWS = 5
"""16-byte rows of another material before this one's weights."""

# Shapes that differ in what a decoder could get wrong.
SHAPES = {
    "plain": {"constants": {"specular": [0.5], "clearcoat_normal": [0.0, 0.6, 0.8]}},
    "signed": {
        "signed": True,
        "wrap": "mirror",
        "hidden": 10,
        "channels": 6,
        "features": (16, (8, 16)),
        "constants": {},
    },
    "narrow": {"wrap": "clamp", "size": (96, 48), "features": ((32, 16), (8, 8)), "hidden": 3, "channels": 3},
}
CASES = [
    ("plain", "wgsl", False),
    ("plain", "wgsl", True),
    ("plain", "glsl", False),
    ("plain", "hlsl", True),
    ("signed", "wgsl", False),
    ("narrow", "wgsl", False),
    ("narrow", "glsl", True),
    ("narrow", "hlsl", False),
]


class Asset:
    """A random asset, its decoded textures, and queries."""

    def __init__(self, name: str, seed: int):
        rng = np.random.default_rng(seed)
        self.tensors, header = random_bcf(rng, **SHAPES[name])
        self.header, self.config = header, header["config"]
        format = "bc6h_sf16" if self.config["signed"] else "bc6h_uf16"
        self.textures = []
        for t, entry in enumerate(self.config["textures"]):
            mips = [self.tensors[f"texture{t}.mip{m}"] for m in range(entry["mips"])]
            self.textures.append(decoded(BlockTexture(format, entry["width"], entry["height"], (mips,))))
        finest = max(t["width"] for t in self.config["textures"]), max(t["height"] for t in self.config["textures"])
        last = np.log2(max(self.config["width"], self.config["height"]))
        self.uv = rng.uniform(-1, 2, (QUERIES, 2)).astype(np.float32)
        self.lod = rng.uniform(-1, last + 1, QUERIES).astype(np.float32)
        # Texel centres of the finest texture and whole levels: every bilinear weight is a fraction of a power of two.
        self.uv[:EXACT] = (rng.integers(-finest[0], 2 * finest[0], (EXACT, 2)) + 0.5) / np.array(finest)
        self.lod[:EXACT] = np.round(self.lod[:EXACT])
        golden_uv, golden_lod = golden_inputs(self.config)
        self.uv = np.concatenate([self.uv, golden_uv])
        self.lod = np.concatenate([self.lod, golden_lod])

    @property
    def queries(self) -> np.ndarray:
        footprint = np.exp2(self.lod.astype(np.float64))
        footprint[::2] *= -1
        return np.column_stack([self.uv, self.lod, footprint]).astype(np.float32)

    def job(self) -> dict:
        job = {name: tensor for name, tensor in self.tensors.items() if name.startswith("texture")}
        sizes = [[t["width"], t["height"], t["mips"]] for t in self.config["textures"]]
        other = np.full((BASE_ROWS, 8), np.nan, np.float16)
        weights = np.concatenate([other, pack_weights(self.tensors)]).view(np.uint8)
        return job | {
            "sizes": sizes, "signed": self.config["signed"], "wrap": self.config["wrap"], "weights": weights,
            "queries": self.queries,
        }  # fmt: skip

    def network(self, features: np.ndarray) -> np.ndarray:
        """Return the outputs for ``features``, float64."""
        w = {name: tensor.astype(np.float64) for name, tensor in self.tensors.items()}
        hidden = np.maximum(features @ w["weight0"].T + w["bias0"], 0)
        return np.clip(hidden @ w["weight1"].T + w["bias1"], 0, 1)

    def rounding(self, features: np.ndarray) -> np.ndarray:
        """Return how far a float32 network may be off, per output: 2⁻²⁴ per operation on the sum of magnitudes."""
        w = {name: np.abs(tensor.astype(np.float64)) for name, tensor in self.tensors.items()}
        magnitude = (np.abs(features) @ w["weight0"].T + w["bias0"]) @ w["weight1"].T + w["bias1"]
        return 2.0**-24 * (sum(w["weight0"].shape) + 4) * magnitude


@pytest.fixture(scope="module")
def assets() -> dict[str, Asset]:
    return {name: Asset(name, seed) for seed, name in enumerate(SHAPES)}


@pytest.fixture(scope="module")
def results(assets, tmp_path_factory) -> dict:
    """What every case of CASES wrote, split into features, outputs, maps by lod (and maps by derivatives)."""
    folder = tmp_path_factory.mktemp("device")
    cases = [case for case in CASES if case[1] == "wgsl" or not hosts.missing_tool()]
    for shape, language, baked in cases:
        asset = assets[shape]
        decoder = shader_source(language, shape, asset.config, asset.tensors, baked=baked)
        base = None if baked else BASE_ROWS
        text, floats = hosts.compute_host(
            language, shape, asset.config, decoder, len(asset.lod), base, shape == DERIVATIVES
        )
        if language != "wgsl":
            binary = hosts.spirv(language, "comp", text, folder, inline=True)
            text = np.frombuffer(binary, np.uint32)
        np.savez(folder / f"{shape}-{language}-{baked}.npz", shader=text, floats=floats, **asset.job())
    for shape, asset in assets.items():
        for baked in (False, True):
            decoder = shader_source("wgsl", shape, asset.config, asset.tensors, baked=baked)
            text = hosts.fragment_host("wgsl", shape, asset.config, decoder, baked=baked)
            np.savez(folder / f"fragment-{shape}-{baked}.npz", shader=text)
    command = [sys.executable, Path(__file__).with_name("wgpu_host.py"), folder]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=180)
    except subprocess.TimeoutExpired:
        pytest.fail("the Vulkan device did not answer within 180 s; it takes about 10 s on two idle cores")
    if done.returncode == MISSING:
        pytest.skip(done.stdout.strip())
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    found = {"device": done.stdout.strip()}
    for shape, language, baked in cases:
        config = assets[shape].config
        components = sum(found.width for found in maps_of(config))
        cuts = np.cumsum([3 * len(config["textures"]), len(config["channels"]), components])
        written = np.load(folder / f"{shape}-{language}-{baked}.npy").astype(np.float64)
        found[shape, language, baked] = np.split(written, cuts, axis=1)[: 4 if shape == DERIVATIVES else 3]
    return found


@pytest.fixture(params=CASES, ids=lambda case: f"{case[0]}-{case[1]}-{'baked' if case[2] else 'buffer'}")
def case(request, assets, results):
    if request.param not in results:
        pytest.skip(hosts.missing_tool())
    return assets[request.param[0]], results[request.param], results["device"]


def test_samplers_read_the_features_of_the_reference(case):
    asset, (features, *_), device = case
    expected = reference.features(asset.textures, asset.config, asset.uv, asset.lod)
    spread = np.concatenate([np.ptp(np.concatenate([m.reshape(-1, 3) for m in t]), axis=0) for t in asset.textures])
    # llvmpipe filters in float32, u · W with |u| ≤ 2, W ≤ 32 leaves weights good to 2^-18; worst seen 3e-7 of the
    # spread of a texture's values. GPUs have weights of 8 bits on each of three axes.
    weights = 3e-6 if device.startswith("CPU") else 3 * 2.0**-8
    assert np.all(np.abs(features - expected) <= weights * spread)
    # Where all weights are sums of powers of two, what is left is rounding of the sums: within an ulp or two.
    assert np.all(np.abs(features - expected)[:EXACT] <= 2.0**-22 * spread)


def test_network_matches_float64_on_the_features_that_were_sampled(case):
    asset, (features, outputs, *_), _ = case
    error = np.abs(outputs - asset.network(features))
    assert np.all(error <= asset.rounding(features))
    assert outputs.std(axis=0).min() > 0.01  # not all clamped


def stacked(maps: dict) -> np.ndarray:
    return np.concatenate(list(maps.values()), axis=1)


def test_maps_are_the_outputs_decoded(case):
    asset, (_, outputs, maps, *_), _ = case
    expected = stacked(reference.maps(outputs, asset.config))
    np.testing.assert_allclose(maps, expected, rtol=0, atol=2e-6)  # worst seen 6e-7, of sRGB and of a normal's z


def test_maps_match_the_reference_from_end_to_end(case):
    asset, (_, _, maps, *_), device = case
    weights = [asset.tensors["weight0"], asset.tensors["weight1"]]
    biases = [asset.tensors["bias0"], asset.tensors["bias1"]]
    outputs = reference.encoded(asset.textures, weights, biases, asset.config, asset.uv, asset.lod)
    expected = stacked(reference.maps(outputs, asset.config))
    np.testing.assert_allclose(maps, expected, rtol=0, atol=2e-5 if device.startswith("CPU") else 0.1)  # worst 5e-6


def test_device_agrees_with_the_warp_kernel_and_the_golden_vector(assets, results):
    asset = assets["plain"]
    material = BCf(asset.tensors, asset.header, device="cpu")
    expected, golden = stacked(material.maps(asset.uv, asset.lod)), golden_vector(material)
    count, software = len(golden["lod"]), results["device"].startswith("CPU")
    for case in (case for case in results if case[0] == "plain"):
        features, outputs, maps = results[case]
        np.testing.assert_allclose(maps, expected, rtol=0, atol=2e-5 if software else 0.1)
        np.testing.assert_allclose(maps[-count:], stacked(golden["maps"]), rtol=0, atol=2e-5 if software else 0.1)
        np.testing.assert_allclose(outputs[-count:], golden["outputs"], rtol=0, atol=2e-5 if software else 0.1)
        exact = np.array(golden["exact"])
        assert exact.sum() == 5
        sampled = features[-count:][exact]
        np.testing.assert_allclose(sampled, np.array(golden["features"])[exact], rtol=2e-6, atol=0)


@pytest.mark.parametrize("language", LANGUAGES)
def test_derivatives_choose_the_level_of_equation_11(results, language):
    found = [parts for case, parts in results.items() if case[:2] == (DERIVATIVES, language)]
    if not found:
        pytest.skip(hosts.missing_tool())
    _, _, by_lod, by_derivatives = found[0]
    assert by_derivatives.shape == by_lod.shape
    assert by_lod[:, :3].std(axis=0).min() > 0.01  # what follows is a constant
    np.testing.assert_allclose(by_derivatives, by_lod, rtol=0, atol=1e-5)  # worst seen 1e-6: log2 of the device


def test_all_languages_give_the_same(results):
    everything = [parts for case, parts in results.items() if case[0] == "plain"]
    for parts in everything[1:]:
        for one, other in zip(everything[0], parts, strict=True):
            np.testing.assert_allclose(other, one, rtol=0, atol=2e-6 * max(1, np.abs(one).max()))
