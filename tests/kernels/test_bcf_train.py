"""What a training step is told: layout of the pyramids, the padded reference, and the draw of the patches."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from warp_neumat.io.mipmaps import mip_sizes
from warp_neumat.kernels.bcf_train import StepShape
from warp_neumat.kernels.patches import PAD, SPACING, Pyramids, draw_patches, pad_reference, stored_texels


def pyramids(width=64, height=32, repeat=True, features=((32, 16), (8, 4))) -> Pyramids:
    return Pyramids(tuple(tuple(mip_sizes(*f)) for f in features), tuple(mip_sizes(width, height)), repeat)


def test_layout_leaves_no_gap_and_no_overlap():
    layout = pyramids(features=((32, 16), (20, 12), (4, 4)))
    sizes = [size for mips in layout.features for size in mips]
    offsets = [offset for row in layout.feature_offsets for offset in row]
    assert offsets == [sum(map(stored_texels, sizes[:n])) for n in range(len(sizes))]
    assert layout.texel_count == sum(map(stored_texels, sizes))
    assert [stored_texels(s) for s in ((4, 4), (5, 4), (1, 1), (12, 9))] == [16, 32, 16, 9 * 16]
    table = layout.table()
    assert table.shape == (64, 3)
    for t, mips in enumerate(layout.features):
        np.testing.assert_array_equal(table[16 * t : 16 * t + len(mips), 1:], mips)
    assert table[16 * 3, 0] == 0
    assert table[16 * 3 + 1].tolist() == [(64 + 2 * PAD) * (32 + 2 * PAD), 32, 16]
    # Eq. 11: a texture of half the material's size sees its mip 0 where the material's mip 1 is due.
    np.testing.assert_allclose(layout.biases, np.log2([1 / 2, max(12 / 32, 20 / 64), max(4 / 32, 4 / 64)]))


@pytest.mark.parametrize(("wrap", "mode"), [("repeat", "wrap"), ("clamp", "edge"), ("mirror", "symmetric")])
def test_reference_is_padded_as_it_wraps(rng, wrap, mode):
    layout = pyramids(6, 3, wrap == "repeat")
    mips = [rng.random((h, w, 5)).astype(np.float32) for w, h in layout.reference]
    flat = pad_reference(mips, 8, wrap)
    assert flat.dtype == np.float16
    assert len(flat) == 8 * layout.reference_offsets[-1]
    for mip, offset in zip(mips, layout.reference_offsets[:-1], strict=True):
        h, w, _ = mip.shape
        stored = flat[8 * offset :][: 8 * (h + 4) * (w + 4)].reshape(h + 4, w + 4, 8)
        expected = np.pad(mip, ((2, 2), (2, 2), (0, 0)), mode=mode)
        np.testing.assert_array_equal(stored[:, :, :5], expected.astype(np.float16))
        assert not stored[:, :, 5:].any()


@settings(deadline=None, max_examples=30)
@given(
    seed=st.integers(0, 2**31),
    step=st.integers(0, 2**31),
    count=st.integers(1, 300),
    side=st.sampled_from([(1, 1), (3, 1), (64, 32), (500, 300), (2048, 2048)]),
    repeat=st.booleans(),
    decay=st.just(0.0) | st.floats(0.01, 2.0),
    aligned=st.floats(0.0, 1.0),
)
def test_patches_lie_within_the_material(seed, step, count, side, repeat, decay, aligned):
    layout = pyramids(*side, repeat)
    patches = draw_patches(seed, step, count, layout, decay=decay, aligned=aligned)
    assert patches.shape == (count, 8)
    assert patches.dtype == np.float32
    assert np.isfinite(patches).all()
    s, weight, origin, extent, centres = patches[:, 0], patches[:, 1], patches[:, 2:4], patches[:, 4:6], patches[:, 6:]
    assert (s >= 0).all()
    assert (s <= len(layout.reference) - 1).all()
    assert (weight > 0).all()
    assert (origin >= 0).all()
    assert (origin <= 1).all()
    assert (extent <= 1).all()
    if not repeat:
        assert (origin + extent <= 1 + 1e-6).all()
    # One sample every SPACING texels of the patch's own mip, or the whole texture.
    size = np.array(layout.reference[0]) / 2.0 ** s[:, None]
    assert (np.minimum(extent * size / 16, SPACING) >= np.minimum(size / 16, SPACING) * 0.99 * 2.0**-0.5).all()
    on = centres[:, 0] > 0
    assert abs(on.sum() - aligned * count) <= 1 + 1e-6 * count
    np.testing.assert_array_equal(s[on], np.rint(s[on]))
    sizes = np.array(layout.reference)
    np.testing.assert_array_equal(centres[on], sizes[s[on].astype(int)])
    assert not centres[~on].any()


def mip_share(patches, count: int) -> np.ndarray:
    """Return the weighted share of each mip: a sample at s counts for the two mips it is mixed from."""
    s, weight = patches[:, 0].astype(np.float64), patches[:, 1].astype(np.float64)
    low = np.minimum(s.astype(int), max(count - 2, 0))
    rest = s - low
    share = np.zeros(count)
    np.add.at(share, low, weight * (1 - rest))
    if count > 1:
        np.add.at(share, low + 1, weight * rest)
    return share / len(patches)


@pytest.mark.parametrize("aligned", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("decay", [0.0, 0.5, 1.0])
def test_every_mip_counts_the_same(decay, aligned):
    layout = pyramids(256, 64)
    draws = [draw_patches(5, step, 256, layout, decay=decay, aligned=aligned) for step in range(200)]
    count = len(layout.reference)
    patches = np.concatenate(draws)
    share = mip_share(patches, count)
    met = np.bincount(np.rint(patches[:, 0]).astype(int), minlength=count)
    assert (np.abs(share * count - 1) < 3 / np.sqrt(met)).all()
    assert share[:3] == pytest.approx(1 / count, rel=0.01)
    if decay and not aligned:
        # From half a mip below 0 to half a one past the last, s falls by 2^(−decay s).
        assert (patches[:, 0] < 1).mean() == pytest.approx(
            (1 - 2 ** (-1.5 * decay)) / (1 - 2 ** (-count * decay)), abs=0.01
        )


def test_same_seed_and_step_same_patches():
    layout = pyramids()
    first = draw_patches(1, 2, 64, layout)
    np.testing.assert_array_equal(draw_patches(1, 2, 64, layout), first)
    for other in (draw_patches(2, 2, 64, layout), draw_patches(1, 3, 64, layout)):
        assert (other[:, 2:4] != first[:, 2:4]).all()


def test_patches_cover_the_texture_evenly():
    layout = pyramids()
    place = draw_patches(3, 4, 1024, layout)[:, 2:4]
    cells = np.histogram2d(*place.T, bins=8, range=((0, 1), (0, 1)))[0]
    assert cells.min() >= 12  # 16 each; of random ones the worst of 64 would have 7


def test_step_shape_sizes():
    shape = StepShape(4, 16, 9)
    assert (shape.inputs, shape.stride, shape.weights) == (12, 16, 13 * 16 + 17 * 9)
    assert StepShape(1, 8, 8).stride == 8
    rows = 12 + 2 * 16 + 2 * 9 + 12
    assert shape.scratch >= 256 * rows + 16 + 16 * 9 + 12 + 12 * 16
