"""The kernels of neural BTFs: quads, seams, partly lit blocks, and the plain C++ of CUDA, against float64."""

import functools

import numpy as np
import pytest
import warp as wp

from tests.fake_assets import random_btf
from warp_neumat.kernels import btf as kernels
from warp_neumat.kernels import btf_code, dispatch
from warp_neumat.materials.btf import BTF
from warp_neumat.reference import btf as reference

# Worst seen: 2e-6 of the largest value (Zen 3).
TOLERANCE = 1e-5


def directions(rng, n, least=0.05):
    """Return unit directions above the horizon, (n, 3) float32."""
    d = rng.normal(size=(n, 3))
    d[:, 2] = np.abs(d[:, 2]) + least
    return (d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32)


def quad_uv(rng, n, spread=0.05):
    """Return uv of quads of neighbouring texels of a 32 × 24 texture, (n, 4, 2) float32."""
    return (rng.uniform(-1, 2, (n, 1, 2)) + spread * rng.random((n, 4, 2))).astype(np.float32)


@functools.cache
def make_block_kernel(layout, lanes):
    """A kernel that calls view once and light for each list of lanes, block by block, as a shading kernel does."""
    evaluate = kernels.functions(layout, lanes)
    view, light = evaluate.view, evaluate.light
    L = SIZE = lanes
    FLOAT = wp.constant(wp.uint64(4))
    WORDS = layout.scratch(lanes)

    @wp.kernel(module="unique", module_options=dispatch.module_options())
    def block_kernel(
        first: int,
        material: kernels.Arguments,
        place: wp.array(dtype=wp.float32),
        wo: wp.array(dtype=wp.float32),
        wanted: wp.array(dtype=wp.int32),
        wanted_count: int,
        wi: wp.array(dtype=wp.float32),
        lit: wp.array(dtype=wp.int32),
        lit_count: wp.array(dtype=wp.int32),
        lights: int,
        scratch: wp.array(dtype=wp.float32),
        value: wp.array(dtype=wp.float32),
    ):
        own = scratch.ptr + wp.uint64(first) * wp.uint64(WORDS)  # first is 0
        nothing = wp.array(ptr=value.ptr, shape=(3 * L,), dtype=wp.float32)
        view(material, place, wo, wanted, wanted_count, own, nothing)
        for j in range(lights):
            at = wp.uint64(j) * wp.uint64(SIZE) * FLOAT
            I = wp.array(ptr=wi.ptr + at * wp.uint64(3), shape=(3 * L,), dtype=wp.float32)  # noqa: E741
            Y = wp.array(ptr=value.ptr + at * wp.uint64(3), shape=(3 * L,), dtype=wp.float32)
            A = wp.array(ptr=lit.ptr + at, shape=(L,), dtype=wp.int32)
            light(material, I, A, lit_count[j], own, Y)

    return block_kernel


def run_block(material, uv, lod, wo, wanted, wi, lit, device="cpu"):
    """Evaluate one block: uv (L, 2), lod (L,), wo (L, 3), wanted (L,), wi (J, L, 3), lit (J, L); returns (J, L, 3)."""
    lanes, lights = len(uv), len(wi)
    place = np.stack([*uv.T, lod]).astype(np.float32)
    order = np.argsort(~lit, axis=1, kind="stable").astype(np.int32)

    def array(x, dtype=wp.float32):
        return wp.array(np.ascontiguousarray(x).ravel(), dtype=dtype, device=device)

    scratch = wp.full(material.layout.scratch(lanes), np.nan, dtype=wp.float32, device=device)
    value = wp.full(3 * lanes * lights, -7.0, dtype=wp.float32, device=device)
    listed = np.argsort(~wanted, kind="stable").astype(np.int32)
    dispatch.launch(
        make_block_kernel(material.layout, lanes),
        1,
        inputs=[
            material.shader().arguments, array(place), array(wo.T), array(listed, wp.int32), int(wanted.sum()),
            array(wi.swapaxes(1, 2)), array(order, wp.int32), array(lit.sum(1), wp.int32), lights, scratch,
        ],
        outputs=[value],
        device=device,
    )  # fmt: skip
    return value.numpy().reshape(lights, 3, lanes).swapaxes(1, 2)


def block_error(material, tensors, uv, lod, wo, wanted, wi, lit):
    """Return the largest difference of lit lanes to float64, as a share of the largest value; and the values."""
    got = run_block(material, uv, lod, wo, wanted, wi, lit)
    quads = len(uv) // 4
    worst = scale = 0.0
    for j in range(len(wi)):
        expected = reference.btf_quads(
            tensors, material.config, uv.reshape(quads, 4, 2), wi[j].reshape(quads, 4, 3), wo.reshape(quads, 4, 3),
            lod.reshape(quads, 4), wanted=wanted.reshape(quads, 4), lit=lit[j].reshape(quads, 4),
        ).reshape(-1, 3)  # fmt: skip
        scale = max(scale, expected[lit[j]].max(initial=0.0))
        worst = max(worst, np.abs(got[j] - expected)[lit[j]].max(initial=0.0))
    return worst / scale, got


def block_of(rng, quads=64, apart=()):
    """Return uv, lod, ω_o and ω_i of two lights for a block; the quads listed in ``apart`` have seams."""
    uv = quad_uv(rng, quads)
    uv[list(apart), 2:] += 0.6
    lanes = 4 * quads
    lod = (rng.integers(-1, 4, quads).repeat(4) + rng.uniform(-0.3, 0.3, lanes)).astype(np.float32)
    middle = directions(rng, quads).repeat(4, 0) + 0.1 * rng.normal(size=(lanes, 3))
    middle[:, 2] = np.abs(middle[:, 2]) + 0.05
    wo = (middle / np.linalg.norm(middle, axis=1, keepdims=True)).astype(np.float32)
    wi = np.stack([directions(rng, lanes), directions(rng, lanes)])
    return uv.reshape(-1, 2), lod, wo, wi


@pytest.fixture(scope="module")
def asset():
    tensors, header = random_btf(np.random.default_rng(4))
    return tensors, BTF(tensors, header)


def test_a_block_of_whole_quads_matches_float64(rng, asset):
    uv, lod, wo, wi = block_of(rng)
    everything = np.ones(256, bool)
    error, got = block_error(asset[1], asset[0], uv, lod, wo, everything, wi, np.ones((2, 256), bool))
    assert error < TOLERANCE
    assert got.std() > 0.05


@pytest.mark.parametrize("share", [0.02, 0.3, 0.7, 0.97])
def test_partly_wanted_and_partly_lit_blocks_match_float64(rng, asset, share):
    """Quads of one to four wanted lanes, seams among them, and lights that reach some of the lanes."""
    for _ in range(8):
        uv, lod, wo, wi = block_of(rng, apart=rng.choice(64, 9, replace=False))
        wanted = rng.random(256) < share
        wanted[17] = True
        lit = wanted & (rng.random((2, 256)) < rng.choice([0.1, 0.5, 0.95], (2, 1)))
        lit[0] = wanted
        lit[1, np.flatnonzero(wanted)[0]] = True
        error, got = block_error(asset[1], asset[0], uv, lod, wo, wanted, wi, lit)
        assert error < TOLERANCE
        assert np.isfinite(got).all()


def test_what_lanes_hold_that_are_not_asked_for_does_not_matter(rng, asset):
    uv, lod, wo, wi = block_of(rng)
    wanted = rng.random(256) < 0.7
    lit = wanted & (rng.random((2, 256)) < 0.6)
    expected = run_block(asset[1], uv, lod, wo, wanted, wi, lit)
    uv[~wanted] = lod[~wanted] = wo[~wanted] = wi[~lit] = np.nan
    got = run_block(asset[1], uv, lod, wo, wanted, wi, lit)
    assert np.array_equal(got[lit], expected[lit])


def test_every_lane_of_a_seam_is_evaluated_by_itself(rng, asset):
    """With all quads apart, a block holds as many items as lanes; each is what a row by itself is."""
    tensors, material = asset
    uv, lod, wo, wi = block_of(rng, apart=range(64))
    lit = np.ones((2, 256), bool)
    error, got = block_error(material, tensors, uv, lod, wo, lit[0], wi, lit)
    assert error < TOLERANCE
    rows = material.eval(uv, wi[0], wo, lod)
    assert np.abs(got[0] - rows).max() < TOLERANCE * rows.max()


def test_the_threshold_of_a_seam_counts_texels_of_the_mip(rng, asset):
    """Just below it a quad shares its coarse features, just above it does not, and one mip on it does again."""
    tensors, material = asset
    wi, wo = directions(rng, 40), directions(rng, 40)
    corner = rng.random((40, 1, 2)).astype(np.float32)
    for texels, lod, together in (
        (0.97, 0, True),
        (1.03, 0, False),
        (1.03, 1, True),
        (1.97, 1, True),
        (2.03, 1, False),
    ):
        uv = np.repeat(corner, 4, 1)
        uv[:, 3, 0] += texels * btf_code.SEAM / 32
        got = material.eval_quads(uv, wi, wo, float(lod))
        alone = material.eval(uv.reshape(-1, 2), wi.repeat(4, 0), wo.repeat(4, 0), float(lod)).reshape(-1, 4, 3)
        assert (np.abs(got - alone).max() < 1e-5) != together
        expected = reference.btf_quads(tensors, material.config, uv, wi, wo, lod)
        assert np.abs(got - expected).max() < TOLERANCE * expected.max()


def test_lanes_that_no_light_reaches_are_not_evaluated(rng, asset):
    """Rows without a lit lane are left as they were: a light costs what it reaches, in rows of 16 quads."""
    uv, lod, wo, wi = block_of(rng)
    lit = np.zeros((2, 256), bool)
    lit[0, :64], lit[1, 100] = True, True
    got = run_block(asset[1], uv, lod, wo, np.ones(256, bool), wi, lit)
    assert (got[0, :64] >= 0).all()
    assert (got[0, 64:] == -7).all()
    assert (got[1, 64:128] >= 0).any()
    assert (got[1, :64] == -7).all()
    assert (got[1, 128:] == -7).all()


@pytest.mark.parametrize("shape", [{}, {"coarse": None, "fine": 5, "half_vector": False}], ids=["quads", "single"])
def test_one_thread_of_cuda_computes_the_same(rng, shape):
    """The plain C++, compiled for the CPU: a block of one lane, and one of the four of a quad."""
    tensors, header = random_btf(rng, **shape)
    material = BTF(tensors, header)
    for quad in range(6):
        uv, lod, wo, wi = block_of(rng, 1, apart=(0,) if quad == 5 else ())
        wanted = np.ones(4, bool)
        wanted[1:] = rng.random(3) < 0.8
        lit = wanted & np.array([[True] * 4, [True, False, True, True]])
        error, _ = block_error(material, tensors, uv, lod, wo, wanted, wi, lit)
        assert error < TOLERANCE
    for lane in range(4):
        one = slice(lane, lane + 1)
        got = run_block(material, uv[one], lod[one], wo[one], wanted[:1], wi[:, one], lit[:, :1])
        assert np.abs(got[0] - material.eval(uv[one], wi[0, one], wo[one], lod[one])).max() < 1e-5


def test_weights_are_counted_and_packed():
    layout = kernels.Layout()
    assert layout.parameters == 779
    assert kernels.Layout(kernels.Net(30, (8,) * 7), None).parameters == 779
    assert kernels.Layout(kernels.Net(14, (25,) * 4), None).widths["fine"] == (23, 25, 25, 25, 25, 3)
    tensors, _ = random_btf(np.random.default_rng(0))
    weights, biases = (
        {name: [tensors[f"{name}.{part}{n}"] for n in range(4)] for name in ("fine", "coarse")}
        for part in ("weight", "bias")
    )
    packed = kernels.pack(layout, weights, biases)
    assert len(packed) == layout.parameters
    latent = packed[layout.at("latent") :][:64].reshape(8, 8)
    assert np.array_equal(latent, weights["fine"][0][:, :8].T.astype(np.float32))
