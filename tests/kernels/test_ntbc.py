"""Inference of NTBC: blocks of all formats against networks and packing in float64, on the CPU and CUDA."""

import dataclasses

import numpy as np
import pytest
import warp as wp

from tests.ntbc_models import predict, random_model
from warp_neumat.kernels.bc1 import bc1_decode
from warp_neumat.kernels.bc4 import bc4_decode
from warp_neumat.kernels.bc7 import bc7_decode
from warp_neumat.kernels.ntbc import ModelShape, ntbc_blocks
from warp_neumat.kernels.ntbc_network import NetworkShape
from warp_neumat.reference import block_fit

ROWS, COLUMNS = 19, 27  # no multiple of a patch
PLANES = (("bc1", 3), ("bc4", 1), ("bc7", 4), ("bc7", 3))
MODEL = ModelShape(
    NetworkShape(((3, 2), (9, 19)), 22, hidden=(24, 20)), NetworkShape(((4, 4), (30, 9), (50, 70)), 11), PLANES
)
NAIVE = ModelShape(
    MODEL.endpoint, dataclasses.replace(MODEL.texel, outputs=len(PLANES), hidden=(16,)), PLANES, naive=True
)


def metrics(rng) -> np.ndarray:
    a = rng.standard_normal((len(PLANES), 4, 4))
    return (np.eye(4) + 0.2 * a @ a.swapaxes(1, 2)).astype(np.float32)


def decoded(name: str, channels: int, blocks: np.ndarray) -> np.ndarray:
    """Colours in [0, 1] of blocks (rows, columns, bytes), (blocks, 16, channels), by the renderer's decoders."""
    decode = {"bc1": bc1_decode, "bc4": bc4_decode, "bc7": bc7_decode}[name]
    texels = decode(np.ascontiguousarray(blocks.reshape(-1, blocks.shape[2])))
    scale = 255.0 if texels.dtype == np.uint8 else 1.0
    return texels.reshape(len(texels), 16, -1)[..., :channels] / scale


@pytest.mark.parametrize("shape", [MODEL, NAIVE], ids=["colours", "naive"])
def test_blocks_match_float64(shape, rng, device):
    arrays, metric = random_model(shape, rng), metrics(rng)
    with wp.ScopedDevice(device):
        written, shown = ntbc_blocks(shape, ROWS, COLUMNS, *arrays, metric=metric, predicted=True)
    ends, colours = predict(shape, arrays, ROWS, COLUMNS)
    assert abs(shown - colours).max() < 1e-5  # worst seen 7.3e-6, of selu's polynomial
    assert colours.std() > 0.05
    at = 0
    for plane, ((name, k), blocks) in enumerate(zip(shape.planes, written, strict=True)):
        e = ends[:, 2 * at : 2 * at + 2 * k].reshape(-1, 2, k)
        x = colours[:, at : at + k].swapaxes(1, 2)
        g = metric[plane, :k, :k].astype(np.float64)
        if name == "bc4":
            g, expected = np.eye(1), block_fit.bc4_pack(e[..., 0], x[..., 0])[0]
        else:
            expected = (block_fit.bc1_pack if name == "bc1" else block_fit.bc7_pack)(e, x, g)[0]
        expected = expected.reshape(blocks.shape)
        # BC4's entries may be equal where a block is flat, and other bits decode to the same colours: 15 % of blocks in
        # the naive model. Colours that differ, seen in no block, would be texels midway between two entries.
        texels = [decoded(name, k, given) for given in (blocks, expected)]
        assert (texels[0] != texels[1]).any((1, 2)).mean() < 0.005, name
        errors = [np.einsum("btk,kj,btj->b", t - x, g, t - x) for t in texels]
        assert errors[0].mean() == pytest.approx(errors[1].mean(), rel=1e-4)
        at += k


def test_every_grid_size_uses_one_kernel_and_fewer_blocks_are_a_mip(rng):
    """Blocks lie at the middle of their area: one block per 2 × 2 is where the four of them meet."""
    endpoint = dataclasses.replace(MODEL.endpoint, levels=((8, 5), (1, 1)))
    shape = dataclasses.replace(MODEL, endpoint=endpoint)
    arrays = random_model(shape, rng)
    for rows, columns in ((1, 1), (3, 5), (8, 2)):
        _, shown = ntbc_blocks(shape, rows, columns, *arrays, predicted=True)
        assert abs(shown - predict(shape, arrays, rows, columns)[1]).max() < 1e-5


def test_same_bits_on_any_number_of_cores_and_from_torch(rng, monkeypatch):
    torch = pytest.importorskip("torch")
    arrays = random_model(MODEL, rng)
    alone = []
    for threads in ("1", "2"):
        monkeypatch.setenv("NEUMAT_THREADS", threads)
        alone.append(ntbc_blocks(MODEL, ROWS, COLUMNS, *arrays))
    given = ntbc_blocks(MODEL, ROWS, COLUMNS, *(torch.from_numpy(a) for a in arrays))
    assert isinstance(given[0], torch.Tensor)
    for first, second, third in zip(*alone, given, strict=True):
        assert np.array_equal(first, second)
        assert np.array_equal(first, third.numpy())


@pytest.mark.parametrize(
    ("planes", "message"),
    [
        ((("bc1", 4),), "planes must be"),
        ((("bc2", 3),), "planes must be"),
        ((("bc4", 1),), "must have 2 and 1 outputs"),
    ],
)
def test_wrong_planes_are_explained(planes, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(MODEL, planes=planes)


def test_wrong_arrays_are_explained(rng):
    arrays = random_model(MODEL, rng)
    with pytest.raises(ValueError, match=r"texel_net must have shape \[\d+\], got \(3,\)"):
        ntbc_blocks(MODEL, 2, 2, *arrays[:3], arrays[3][:3])
    with pytest.raises(ValueError, match="rows and columns must be at least 1, got 0 and 2"):
        ntbc_blocks(MODEL, 0, 2, *arrays)
