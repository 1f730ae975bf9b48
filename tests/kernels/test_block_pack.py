"""Blocks written from endpoints and colours: beside the twin in float64, and decoded by ours and others."""

import functools

import numpy as np
import pytest
import warp as wp

from tests.block_oracles import bcdec, check_cuda, texture2d
from warp_neumat.kernels import dispatch
from warp_neumat.kernels.bc1 import bc1_decode
from warp_neumat.kernels.bc4 import bc4_decode
from warp_neumat.kernels.bc7 import bc7_decode
from warp_neumat.kernels.block_pack import pack_code
from warp_neumat.reference import block_fit as twin

FORMATS = {  # name → (channels, bytes, the call for block b)
    "bc1": (3, 8, "Pack::write_bc1(ends, ends + 3, colour, metric.data, out)"),
    "bc4": (1, 8, "Pack::write_bc4(ends[0], ends[1], colour, out)"),
    "bc7": (3, 16, "Pack::write_bc7(ends, ends + 3, colour, 3, metric.data, out)"),
    "bc7_alpha": (4, 16, "Pack::write_bc7(ends, ends + 4, colour, 4, metric.data, out)"),
}
METRIC = np.array([[0.5, 0.3, 0.1, 0.0], [0.3, 1.0, 0.2, 0.1], [0.1, 0.2, 0.4, 0.0], [0.0, 0.1, 0.0, 0.6]])


@functools.cache
def make_pack_kernel(lanes: int, name: str):
    """Return a kernel that writes blocks: endpoints and planar colours in, blocks and errors out."""
    channels, size, call = FORMATS[name]
    code = f"""{pack_code()}
    for (int b = start; b < start + {lanes} && b < count; ++b) {{
        const float* ends = endpoints.data + {2 * channels} * (long long)b;
        const float* colour = colours.data + {16 * channels} * (long long)b;
        unsigned char* out = blocks.data + {size} * (long long)b;
        errors.data[b] = {call};
    }}"""
    L = lanes

    @wp.func_native(code)
    def write(
        start: int,
        count: int,
        endpoints: wp.array(dtype=wp.float32),
        colours: wp.array(dtype=wp.float32),
        metric: wp.array(dtype=wp.float32),
        blocks: wp.array(dtype=wp.uint8),
        errors: wp.array(dtype=wp.float32),
    ): ...

    @wp.kernel(module="unique", module_options=dispatch.module_options())
    def pack_kernel(
        first: int,
        count: int,
        endpoints: wp.array(dtype=wp.float32),
        colours: wp.array(dtype=wp.float32),
        metric: wp.array(dtype=wp.float32),
        blocks: wp.array(dtype=wp.uint8),
        errors: wp.array(dtype=wp.float32),
    ):
        b = first + wp.tid()
        write(b * L, count, endpoints, colours, metric, blocks, errors)

    return pack_kernel


def pack(name: str, endpoints: np.ndarray, colours: np.ndarray, metric=None, device="cpu"):
    """Write blocks from endpoints (N, 2, k) and colours (N, 16, k): (N, bytes) uint8 and errors (N,)."""
    channels, size, _ = FORMATS[name]
    count = len(endpoints)
    # Where nothing reads, a number that would show.
    words = np.full((4, 4), 1e6)
    words[:channels, :channels] = np.eye(channels) if metric is None else metric
    source = [
        wp.array(np.ascontiguousarray(x, np.float32).ravel(), dtype=wp.float32, device=device)
        for x in (endpoints, np.swapaxes(colours, 1, 2), words)
    ]
    blocks = wp.zeros(count * size, dtype=wp.uint8, device=device)
    errors = wp.zeros(count, dtype=wp.float32, device=device)
    lanes = 16 if blocks.device.is_cpu else 1
    dispatch.launch(
        make_pack_kernel(lanes, name),
        dispatch.blocks(count, lanes),
        inputs=[count, *source],
        outputs=[blocks, errors],
        device=device,
    )
    return blocks.numpy().reshape(count, size), errors.numpy()


def cases(rng, channels: int, count: int = 6000):
    """Return endpoints (N, 2, k) and colours (N, 16, k) of every kind; no endpoint's code depends on rounding.

    Endpoints are multiples of 1/4096, whose products with 31, 63 and 255 are exact in float32.
    """
    ends = rng.integers(0, 4097, (count, 2, channels)) / 4096
    near = np.clip(ends[:, :1] + rng.integers(-40, 41, ends.shape) / 4096, 0, 1)
    ends[: count // 3] = near[: count // 3]  # short lines, many of them points in BC1
    place = rng.random((count, 16, 1))
    colours = ends[:, :1] * (1 - place) + ends[:, 1:] * place + rng.normal(0, 0.03, (count, 16, channels))
    colours[count // 2 : count * 3 // 4] = rng.random((count * 3 // 4 - count // 2, 16, channels))
    odd_ends = [[0, 0], [1, 1], [0, 1], [1, 0], [np.nan, 0.5], [0.5, np.nan], [np.nan, np.nan], [-3, 7], [7, -3]]
    odd_ends += [[np.inf, -np.inf], [0.5, 0.5], [0.25, 0.25], [1 / 4096, 0]]
    odd_colours = [np.zeros(16), np.ones(16), np.arange(16) / 15, np.full(16, np.nan), np.linspace(-2, 3, 16)]
    odd_colours += [np.where(np.arange(16) == 5, np.nan, 0.5), np.where(np.arange(16) % 2, np.inf, -np.inf)]
    e, x = (np.repeat(np.array(v)[..., None], channels, -1) for v in (odd_ends, odd_colours))
    e, x = np.repeat(e, len(x), 0), np.tile(x, (len(e), 1, 1))
    ends, colours = np.concatenate([ends, e]), np.concatenate([colours, x])
    return ends, colours.astype(np.float32)


def decode(name: str, blocks: np.ndarray) -> np.ndarray:
    """Decode with our kernels: (N, 16, channels) uint8."""
    decoder = {"bc1": bc1_decode, "bc4": bc4_decode, "bc7": bc7_decode, "bc7_alpha": bc7_decode}[name]
    return decoder(blocks).reshape(len(blocks), 16, -1)


def assert_same_everywhere(name: str, blocks: np.ndarray) -> None:
    """Check that our decoder and the outside ones agree, and that no block is punched through."""
    ours = decode(name, blocks)
    format = name.removesuffix("_alpha")
    np.testing.assert_array_equal(ours, bcdec(format, blocks).reshape(ours.shape))
    other = texture2d(format, blocks).reshape(len(blocks), 16, 4)
    if format == "bc4":
        np.testing.assert_array_equal(ours[..., 0], other[..., 0])
    elif format == "bc7":
        np.testing.assert_array_equal(ours, other)
        assert (blocks[:, 0] & 127 == 64).all()
    else:  # it widens endpoints before it interpolates, and truncates
        assert np.abs(ours[..., :3].astype(int) - other[..., :3]).max() <= 1
        assert (other[..., 3] == 255).all()
        ends = blocks[:, :4].copy().view("<u2")
        assert (ends[:, 0] > ends[:, 1]).all()
    if name in ("bc1", "bc7"):
        assert (ours[..., 3] == 255).all()


def palette(name: str, blocks: np.ndarray) -> np.ndarray:
    """Return the palettes of blocks as the float64 twin defines them: (N, entries, channels) in [0, 1]."""
    if name == "bc1":
        ends = blocks[:, :4].copy().view("<u2").astype(int)
        return twin.bc1_palette(np.stack([ends >> 11, ends >> 5 & 63, ends & 31], axis=2))
    if name == "bc4":
        return twin.bc4_palette(blocks[:, 0], blocks[:, 1])[..., None] / 255
    # All sixteen entries by our decoder: texel t with index t, which the anchor's 0 allows.
    every = blocks.copy().view("<u8")
    every[:, 1] = (every[:, 1] & np.uint64(1)) | sum(np.uint64(t) << np.uint64(4 * t) for t in range(16))
    return decode(name, every.view(np.uint8))[..., : FORMATS[name][0]] / 255


def own_error(name: str, blocks: np.ndarray, colours: np.ndarray, metric) -> np.ndarray:
    """Return the squared error (N,) in float64 of the entries that the blocks' indices choose."""
    channels = FORMATS[name][0]
    if name == "bc1":
        index = blocks[:, 4:].copy().view("<u4") >> (2 * np.arange(16, dtype=np.uint32)) & 3
        chosen = np.take_along_axis(palette(name, blocks), index[..., None].astype(int), 1)
    else:
        chosen = decode(name, blocks)[..., :channels] / 255
    d = twin._clean(colours) - chosen
    return np.einsum("ntc,cd,ntd->n", d, np.eye(channels) if metric is None else metric, d)


@pytest.mark.parametrize(
    ("name", "metric"), [(n, m) for n in FORMATS for m in (False, True) if n != "bc4" or not m], ids=str
)
def test_written_blocks_are_the_twins(rng, device, name, metric):
    channels = FORMATS[name][0]
    metric = METRIC[:channels, :channels] if metric else None
    ends, colours = cases(rng, channels)
    blocks, errors = pack(name, ends, colours, metric, device)
    assert_same_everywhere(name, blocks)
    if name == "bc4":
        want, want_errors = twin.bc4_pack(ends[..., 0], colours[..., 0])
    else:
        want, want_errors = (twin.bc1_pack if name == "bc1" else twin.bc7_pack)(ends, colours, metric)
    same = (decode(name, blocks) == decode(name, want)).all((1, 2))
    assert same.mean() > 0.999  # of entries as near as each other either may be taken; here none differ
    np.testing.assert_allclose(errors, want_errors, rtol=1e-5, atol=2e-6)
    if name == "bc1":
        np.testing.assert_array_equal(blocks[:, :4], want[:, :4])


@pytest.mark.parametrize(
    ("name", "metric"), [(n, m) for n in FORMATS for m in (False, True) if n != "bc4" or not m], ids=str
)
def test_indices_are_the_best_there_are(rng, name, metric):
    channels = FORMATS[name][0]
    metric = METRIC[:channels, :channels] if metric else None
    ends, colours = cases(rng, channels)
    blocks, errors = pack(name, ends, colours, metric)
    actual = own_error(name, blocks, colours, metric)
    best = twin.nearest(twin._clean(colours), palette(name, blocks), metric)[1].sum(1)
    np.testing.assert_allclose(actual, best, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(errors, actual, rtol=1e-4, atol=1e-6)


def test_bc4_takes_the_better_palette(rng):
    # Values in the middle with some at 0 and 1 need the six-entry ramp, values spread evenly the other.
    middle = rng.integers(100, 140, (500, 16)) / 255
    middle[:, ::4] = rng.integers(0, 2, (500, 4))
    even = rng.uniform(0.2, 0.8, (500, 16))
    colours = np.concatenate([middle, even])[..., None]
    ends = np.stack([np.where(colours < 0.9, colours, 0).max(1), np.where(colours > 0.1, colours, 1).min(1)], axis=1)
    blocks, _ = pack("bc4", ends, colours)
    six = blocks[:, 0] <= blocks[:, 1]
    assert six[:500].mean() > 0.95
    assert six[500:].mean() < 0.3
    swapped, _ = pack("bc4", ends[:, ::-1], colours)
    np.testing.assert_array_equal(swapped, blocks)


@pytest.mark.parametrize("name", FORMATS)
def test_order_of_endpoints_does_not_matter(rng, name):
    ends, colours = cases(rng, FORMATS[name][0])
    a, error = pack(name, ends, colours)
    b, swapped_error = pack(name, ends[:, ::-1], colours)
    np.testing.assert_allclose(swapped_error, error, rtol=1e-4, atol=1e-6)
    if name in ("bc1", "bc4"):
        np.testing.assert_array_equal(a, b)
    else:  # ties of nearly equal entries
        assert (decode(name, a) == decode(name, b)).mean() > 0.999


def test_equal_endpoints_keep_their_colour():
    # Every colour of 565 with itself; the other endpoint is a step of blue away.
    words = np.arange(65536)
    ends = np.stack([words >> 11, words >> 5 & 63, words & 31], axis=1) / np.array([31, 63, 31])
    colours = np.repeat(ends[:, None], 16, 1)
    blocks, errors = pack("bc1", np.repeat(ends[:, None], 2, 1), colours)
    assert errors.max() < 1e-10
    chosen = bc1_decode(blocks).reshape(-1, 16, 4)
    np.testing.assert_array_equal(chosen[..., :3], np.floor(colours * 255 + 0.5))
    stored = blocks[:, :4].copy().view("<u2").astype(int)
    np.testing.assert_array_equal(stored[:, 0] - stored[:, 1], 1)
    np.testing.assert_array_equal(stored[:, 0] >> 5, stored[:, 1] >> 5)


def test_opaque_stays_opaque(rng):
    ends, colours = cases(rng, 4)
    ends[..., 3] = 1
    colours[..., 3] = 1
    blocks, _ = pack("bc7_alpha", ends, colours)
    assert (decode("bc7_alpha", blocks)[..., 3] == 255).all()


@pytest.mark.parametrize("name", FORMATS)
def test_kernel_compiles_for_cuda(name, tmp_path):
    check_cuda(make_pack_kernel(1, name), tmp_path)
