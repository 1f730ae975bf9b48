"""The sheet of a BTF asset: each texel of a slice and of an apparent BRDF is the asset's own value there."""

import numpy as np
import pytest

from tests.fake_assets import random_btf
from tests.training.test_btf_slices import Waves
from warp_neumat.materials.btf import BTF
from warp_neumat.training import btf_sheet
from warp_neumat.training.btf_pictures import apparent_brdf
from warp_neumat.training.btf_sheet import asset_brdf, asset_slices


def made(width, height, **shape):
    source = Waves(width, height)
    source.lights, source.views = source.lights[::16], source.views[::9]
    return source, BTF(*random_btf(np.random.default_rng(2), width=width, height=height, **shape))


def test_slices_of_a_single_level_are_its_rows():
    """Without a coarse network quads share nothing, so rows by themselves say where each texel belongs."""
    for width, height in ((8, 6), (7, 5)):
        source, material = made(width, height, mips=2, coarse=None, fine=30, hidden=(8,) * 7)
        pairs = np.array([[3, 1], [0, 0], [5, 2]])
        got = asset_slices(source, material)(pairs)
        assert got.shape == (3, height, width, 3)
        y, x = np.mgrid[:height, :width]
        uv = np.stack([(x + 0.5) / width, (y + 0.5) / height], -1).reshape(-1, 2).astype(np.float32)
        for (light, view), picture in zip(pairs, got, strict=True):
            wi, wo = (np.repeat(d[None], len(uv), 0) for d in (source.lights[light], source.views[view]))
            np.testing.assert_allclose(picture.reshape(-1, 3), material.eval(uv, wi, wo), atol=1e-5)
        assert got.std() > 0.05


@pytest.mark.parametrize("uv", [(0.5, 0.5), (0.0, 0.99), (0.2, 0.3), (0.45, 0.1)])
def test_the_apparent_brdf_is_a_texel_of_the_slices(uv):
    source, material = made(8, 6, mips=2)
    expected = apparent_brdf(source, uv, eval_slices=asset_slices(source, material))
    np.testing.assert_allclose(asset_brdf(source, material, uv), expected, atol=1e-6)


def test_large_sources_are_read_under_fewer_directions(monkeypatch):
    source, material = made(16, 12)
    whole = btf_sheet.btf_sheet(source, material)
    # 6 lights, 3 × 3 views and two gaps of 4 columns, enlarged 5 times.
    assert whole.shape == (3 * 12 + btf_sheet.GAP + 6 * 5, 6 * 16, 3)
    monkeypatch.setattr(btf_sheet, "MOST_TEXELS", 2 * 2 * 16 * 12)
    fewer = btf_sheet._fewer(source)
    assert len(fewer.lights) == len(fewer.views) == 2
    np.testing.assert_array_equal(fewer.lights, source.lights[[0, -1]])
    np.testing.assert_array_equal(fewer.slices(np.array([[1, 1]])), source.slices(np.array([[5, 2]])))
    assert len(btf_sheet.btf_sheet(source, material)) < len(whole)
