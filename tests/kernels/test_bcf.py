"""BCf's sampler and network against float64, in all storages; storages against an independent decoder, bit for bit."""

import dataclasses
import functools

import numpy as np
import pytest
import warp as wp

from tests.fake_assets import random_bcf, random_blocks
from warp_neumat.kernels import bcf, bcf_storage, dispatch
from warp_neumat.kernels.bc6h_tables import MODES
from warp_neumat.materials.bcf import BCf
from warp_neumat.reference import bcf as reference
from warp_neumat.reference.bc6h import bc6h_decode

# Each row: signed, wrap, textures. Sides are odd, or not square, or one texel; the last has another number of textures.
CASES = {
    "repeat": {"signed": False, "wrap": "repeat", "features": (32, (30, 18), (9, 7), 4), "size": 64},
    "mirror": {"signed": True, "wrap": "mirror", "features": ((33, 20), 16, (5, 7), 1), "size": (66, 40)},
    "clamp": {"signed": False, "wrap": "clamp", "features": ((13, 6), 24), "size": 24, "channels": 16},
}


@functools.cache
def make_sample_kernel(layout: bcf.Layout, lanes: int):
    sample = bcf.make_sampler(layout.textures, layout.wrap, layout.signed, layout.storage, lanes)

    @wp.kernel(module="unique", module_options=dispatch.module_options())
    def sample_kernel(
        first: int,
        a: bcf.Arguments,
        u: wp.array(dtype=wp.float32),
        v: wp.array(dtype=wp.float32),
        lod: wp.array(dtype=wp.float32),
        count: int,
        x: wp.array(dtype=wp.float32),
    ):
        sample(a.texels, a.tables, a.levels, a.level_at, u, v, lod, count, x)

    return sample_kernel


def sample_features(material: BCf, uv, lod, *, lanes: int | None = None) -> np.ndarray:
    """Return the features [n, 3T] of ``material`` by calls of its sampler alone."""
    device, layout = material.device, material.layout
    lanes = lanes or dispatch.lanes(device)
    sample_kernel = make_sample_kernel(dataclasses.replace(layout, channels=1), lanes)
    rows = []
    for start in range(0, len(uv), lanes):
        part = [np.zeros(lanes, np.float32) for _ in range(3)]
        count = min(lanes, len(uv) - start)
        for target, values in zip(part, (uv[:, 0], uv[:, 1], lod), strict=True):
            target[:count] = values[start : start + count]
            target[count:] = np.nan  # what lies beyond the count must not matter
        x = wp.zeros(3 * layout.textures * lanes, dtype=wp.float32, device=device)
        arrays = [wp.array(p, device=device) for p in part]
        dispatch.launch(sample_kernel, 1, [material._arguments, *arrays, count], [x], device=device)
        values = x.numpy().reshape(-1, lanes).T
        assert np.isfinite(values).all()
        rows.append(values[:count])
    return np.concatenate(rows)


def inputs(rng, count):
    uv = (rng.random((count, 2)) * 5 - 2.5).astype(np.float32)
    lod = (rng.random(count) * 9 - 1.5).astype(np.float32)
    lod[::5] = np.floor(lod[::5])  # one mip alone
    lod[:64] = -1.0  # whole groups of lanes without a second mip
    near = slice(64, min(count, 256))  # neighbours, which share blocks
    uv[near] = uv[64] + np.arange(near.stop - 64)[:, None] * np.float32(0.004)
    lod[near] = 0.4
    return uv, lod


@pytest.mark.parametrize("signed", [False, True])
def test_storages_hold_what_the_reference_decodes(rng, signed):
    blocks = rng.integers(0, 256, (20_000, 16), dtype=np.uint8)  # all modes, reserved ones too
    wide = bcf_storage.unquantise(blocks, signed)
    words = np.ascontiguousarray(wide[:, :32]).view(np.int16).reshape(-1, 2, 8)[:, :, :6].astype(np.int64)
    pair = words[np.arange(len(blocks))[:, None], (wide[:, 33::2] + 2 * np.arange(16) - 32) // 16]
    factor = bcf_storage.weights().astype(np.int64)[wide[:, 32::2] // 2]
    value = pair.reshape(-1, 16, 3, 2) @ factor[:, :, :, None]
    value = value[..., 0]
    if signed:
        value = (value + 32) >> 6
        halves = np.where(value < 0, (-value * 31 >> 5) | 0x8000, value * 31 >> 5).astype(np.uint16)
    else:
        halves = (((value + 64 * 32768 + 32) >> 6) * 31 >> 6).astype(np.uint16)
    expected = bc6h_decode(blocks, signed).reshape(-1, 16, 3)
    assert (halves.view(np.float16) == expected).all()
    assert (bcf_storage.overflows(wide) >= np.isinf(expected).any(axis=(1, 2))).all()


EVERY = [(case, storage) for case in CASES for storage in bcf.STORAGES if case != "clamp" or storage == "unquantised"]


@pytest.mark.parametrize(("case", "storage"), EVERY)
def test_features_match_float64(rng, device, case, storage):
    tensors, header = random_bcf(rng, **CASES[case])
    uv, lod = inputs(rng, 3 * 256 + 77)
    got = sample_features(BCf(tensors, header, device=device, storage=storage), uv, lod)
    textures = reference.decoded(tensors, header["config"])
    expected = reference.features(textures, header["config"], uv, lod)
    # What float32 leaves of a coordinate of 2.5 is 1.2e-7, and the level's fraction is as coarse: both move a weight
    # by less than 4e-6 of a texel. Worst seen: 1.9e-6 of the largest texel of the texture (Zen 3).
    largest = np.repeat([max(np.abs(m).max() for m in mips) for mips in textures], 3)
    assert (np.abs(got - expected) / largest).max() < 4e-6
    assert np.abs(expected).max() > 1


@pytest.mark.parametrize("case", ["repeat", "mirror"])
def test_storages_give_the_same_bits(rng, device, case):
    tensors, header = random_bcf(rng, **CASES[case])
    uv, lod = inputs(rng, 600)
    first, *others = (
        sample_features(BCf(tensors, header, device=device, storage=s), uv, lod).view(np.uint32) for s in bcf.STORAGES
    )
    for other in others:
        assert (first == other).all()


@pytest.mark.parametrize("mode", MODES, ids=lambda m: f"mode{m.number}")
def test_every_mode_is_fetched_from_its_bits(rng, mode):
    # At texel centres of the finest mip nothing is filtered: the sampler gives the decoder's half floats.
    tensors, header = random_bcf(rng, features=(16,), mips=[1], size=16, modes=[mode.number])
    y, x = np.divmod(np.arange(256), 16)
    uv = ((np.stack([x, y], axis=1) + 0.5) / 16).astype(np.float32)
    got = sample_features(BCf(tensors, header, device="cpu", storage="blocks"), uv, np.zeros(256, np.float32))
    expected = reference.decoded(tensors, header["config"])[0][0].reshape(256, 3)
    assert (got == expected).all()


@pytest.mark.parametrize(
    ("case", "storage"), [("repeat", "half"), ("repeat", "blocks"), ("mirror", "blocks"), ("mirror", "unquantised")]
)
def test_scalar_and_vector_code_agree(rng, case, storage):
    # One lane runs the plain C++ that CUDA gets, on the CPU.
    tensors, header = random_bcf(rng, **CASES[case])
    uv, lod = inputs(rng, 90)
    uv, lod = uv[50:], lod[50:]
    material = BCf(tensors, header, device="cpu", storage=storage)
    one, many = sample_features(material, uv, lod, lanes=1), sample_features(material, uv, lod, lanes=256)
    assert np.allclose(one, many, rtol=1e-5, atol=1e-5 * np.abs(one).max())


def test_srgb_to_linear_matches_float64():
    v = np.concatenate([np.linspace(-0.2, 1, 100_003), np.geomspace(1, 100, 1000)]).astype(np.float32)

    @wp.kernel(module="unique", module_options=dispatch.module_options())
    def decode_kernel(first: int, xs: wp.array(dtype=wp.float32), ys: wp.array(dtype=wp.float32)):
        b = first + wp.tid()
        ys[b] = bcf.srgb_to_linear(xs[b])

    ys = wp.zeros(len(v), dtype=wp.float32, device="cpu")
    dispatch.launch(decode_kernel, len(v), [wp.array(v, device="cpu")], [ys], device="cpu")
    x = v.astype(np.float64)
    expected = np.where(x <= 0.04045, x / 12.92, ((np.maximum(x, 0) + 0.055) / 1.055) ** 2.4)
    assert (np.abs(ys.numpy() - expected) / np.maximum(np.abs(expected), 1e-6)).max() < 1e-6


def test_random_blocks_have_their_modes(rng):
    blocks = random_blocks(rng, 500, modes=[3, 10])
    assert set(blocks[:, 0] & 31) == {MODES[2].bits, MODES[9].bits}


@pytest.mark.parametrize("storage", bcf.STORAGES)
def test_evaluation_compiles_for_cuda(storage, tmp_path):
    wp.init()
    kernel = bcf.make_eval_kernel(bcf.Layout(storage=storage, signed=storage != "half"), 1)
    wp.compile_aot_module(kernel.module, arch=80, module_dir=tmp_path, use_ptx=True)
    assert ".entry" in "".join(f.read_text(errors="replace") for f in tmp_path.glob("*.ptx"))
