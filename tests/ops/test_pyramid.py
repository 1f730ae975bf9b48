"""Look-ups in a pyramid: the operator against plain torch in float64, that against grid_sample, and its contract."""

import numpy as np
import pytest
import warp as wp

torch = pytest.importorskip("torch")

from warp_neumat.io.mipmaps import mip_sizes  # noqa: E402
from warp_neumat.kernels import dispatch, pyramid  # noqa: E402
from warp_neumat.kernels.patches import stored_texels  # noqa: E402
from warp_neumat.models.bcf import _images, _trilinear  # noqa: E402
from warp_neumat.ops import pyramid_sample  # noqa: E402
from warp_neumat.ops.pyramid import pyramid_sample_reference, pyramid_scatter  # noqa: E402

WRAPS = ["repeat", "clamp", "mirror"]


def problem(rng, width=32, height=12, count=5000, *, mips=None, spread=2.0, dtype=torch.float32):
    """Return (texels, uv, lod, sizes); coordinates go ``spread`` beyond the texture on both sides."""
    sizes = tuple(mip_sizes(width, height))[:mips]
    texels = rng.normal(size=(sum(map(stored_texels, sizes)), 4))
    uv = rng.uniform(-spread, 1 + spread, (count, 2))
    lod = rng.uniform(-1, len(sizes), count)
    return *(torch.from_numpy(a).to(dtype) for a in (texels, uv, lod)), sizes


@pytest.mark.parametrize("wrap", WRAPS)
@pytest.mark.parametrize("shape", [(32, 12), (21, 6), (4, 4), (1, 1), (64, 1)], ids=str)
def test_pyramid_sample_matches_torch(rng, wrap, shape):
    *tensors, sizes = problem(rng, *shape)
    cotangent = torch.from_numpy(rng.normal(size=(len(tensors[1]), 3)).astype(np.float32))
    mine = [t.clone().requires_grad_() for t in tensors]
    exact = [t.double().requires_grad_() for t in tensors]
    got = pyramid_sample(*mine, sizes, wrap)
    want = pyramid_sample_reference(*exact, sizes, wrap)
    # Where a negative coordinate comes back into [0, 1] it is rounded, and W times that is the error of a weight.
    # Worst seen 2.5e-7 W, with texels of order 1.
    torch.testing.assert_close(got.detach().double(), want.detach(), rtol=0, atol=2e-6 + 4e-7 * max(shape))
    got.backward(cotangent)
    want.backward(cotangent.double())
    assert not mine[0].grad[:, 3].any()
    largest = pyramid_scatter(cotangent.abs(), *tensors[1:], [s for size in sizes for s in size], wrap).max()
    # Worst seen 1.0e-7; x 4.
    assert (mine[0].grad.double() - exact[0].grad).abs().max() < 4e-7 * largest
    # Slopes are constant between texel centres; a coordinate within rounding of one may fall on either side.
    for of, index in (("u", 1), ("lod", 2)):
        error = (mine[index].grad.double() - exact[index].grad).abs() / (1 + exact[index].grad.abs())
        close = near_border(exact[1].detach(), exact[2].detach(), sizes, wrap)
        assert error[~close].max() < 1e-4, of
        assert close.float().mean() < 0.05


def near_border(uv, lod, sizes, wrap, margin=1e-5) -> torch.Tensor:
    """Return which samples lie within ``margin`` of where a slope jumps: a texel centre or the end of a range."""
    close = (uv - uv.round()).abs().min(1).values < margin
    for size in sizes:
        at = uv * torch.tensor(size) - 0.5
        close |= ((at - at.round()).abs() < margin * max(size)).any(1)
    return close | ((lod - lod.round()).abs() < margin)


@pytest.mark.parametrize("wrap", ["repeat", "clamp"])
def test_reference_matches_grid_sample(rng, wrap):
    texels, uv, _, sizes = problem(rng, 24, 10, 400, spread=0.0, dtype=torch.float64)
    pictures = _images(texels, sizes)
    for s in (0.0, 0.3, 1.0, 2.75, len(sizes) - 1.0):
        want = _trilinear(pictures, uv, s, "bilinear", wrap == "repeat")
        got = pyramid_sample_reference(texels, uv, torch.full((len(uv),), s, dtype=torch.float64), sizes, wrap)
        torch.testing.assert_close(got, want, rtol=0, atol=1e-12)


def test_mirror_reflects(rng):
    texels, uv, lod, sizes = problem(rng, 8, 8, 500, spread=0.0)
    inside = pyramid_sample(texels, uv, lod, sizes, "mirror")
    torch.testing.assert_close(pyramid_sample(texels, -uv, lod, sizes, "mirror"), inside)
    torch.testing.assert_close(pyramid_sample(texels, 2.0 - uv, lod, sizes, "mirror"), inside, rtol=0, atol=1e-5)
    assert torch.equal(pyramid_sample(texels, uv, lod, sizes, "clamp"), inside)


@pytest.mark.parametrize("wrap", WRAPS)
def test_reference_passes_gradcheck(rng, wrap):
    texels, uv, lod, sizes = problem(rng, 8, 4, 40, dtype=torch.float64)
    keep = ~near_border(uv, lod, sizes, wrap, 1e-4)
    assert keep.sum() > 20
    tensors = [t.requires_grad_() for t in (texels, uv[keep], lod[keep])]
    assert torch.autograd.gradcheck(lambda *t: pyramid_sample_reference(*t, sizes, wrap), tensors)


def test_numbers_that_are_not_finite_stay_inside(rng):
    texels, _, _, sizes = problem(rng, 8, 8, 1)
    odd = torch.tensor([float("nan"), float("inf"), -float("inf"), 3e38, -3e38, 0.5])
    uv = torch.cartesian_prod(odd, odd).contiguous()
    for wrap in WRAPS:
        for level in odd:
            lod = level.expand(len(uv)).contiguous()
            colours = pyramid_sample(texels, uv, lod, sizes, wrap)
            assert torch.isfinite(colours).all()
            flat = [s for size in sizes for s in size]
            assert torch.isfinite(pyramid_scatter(colours, uv, lod, flat, wrap)).all()
    zero = pyramid_sample(texels, torch.zeros(1, 2), torch.zeros(1), sizes)
    assert torch.equal(pyramid_sample(texels, odd[:1].expand(1, 2), odd[:1], sizes), zero)


def test_pyramid_gradient_is_the_same_on_any_number_of_cores(rng):
    *tensors, sizes = problem(rng, 16, 16, 3001)
    tensors[0].requires_grad_()
    results = []
    try:
        for count in (1, 2, 3):
            dispatch.set_worker_count(count)
            tensors[0].grad = None
            pyramid_sample(*tensors, sizes).square().sum().backward()
            results.append(tensors[0].grad)
    finally:
        dispatch.set_worker_count(None)
    assert results[0].abs().max() > 0
    assert torch.equal(results[0], results[1])
    assert torch.equal(results[0], results[2])


def test_pyramid_operators_pass_opcheck(rng):
    *tensors, sizes = problem(rng, 8, 8, 60)
    flat = [s for size in sizes for s in size]
    gradient = torch.from_numpy(rng.normal(size=(60, 3)).astype(np.float32))
    needing = [t.clone().requires_grad_() for t in tensors]
    torch.library.opcheck(torch.ops.neumat.pyramid_sample, (*needing, flat, "mirror"))
    torch.library.opcheck(torch.ops.neumat.pyramid_scatter, (gradient, *tensors[1:], flat, "clamp"))
    torch.library.opcheck(torch.ops.neumat.pyramid_slope, (gradient, *tensors, flat, "repeat"))


def test_strided_and_empty_input(rng):
    *tensors, sizes = problem(rng, 8, 8, 64)
    want = pyramid_sample(*tensors, sizes)[::2]
    strided = [tensors[0], *(t[::2] for t in tensors[1:])]
    assert torch.equal(pyramid_sample(*strided, sizes), want)
    empty = [tensors[0].clone().requires_grad_(), tensors[1][:0], tensors[2][:0]]
    out = pyramid_sample(*empty, sizes)
    assert out.shape == (0, 3)
    out.sum().backward()
    assert not empty[0].grad.any()


def test_wrong_arguments_are_named(rng):
    texels, uv, lod, sizes = problem(rng, 8, 8, 5)
    with pytest.raises(ValueError, match=r"texels must be float32 of shape \(112, 4\), got torch.float32 \(111, 4\)"):
        pyramid_sample(texels[1:], uv, lod, sizes)
    with pytest.raises(ValueError, match=r"lod must be float32 of shape \(5,\), got torch.float64"):
        pyramid_sample(texels, uv, lod.double(), sizes)
    with pytest.raises(ValueError, match="wrap must be one of repeat, clamp, mirror, got 'border'"):
        pyramid_sample(texels, uv, lod, sizes, "border")
    with pytest.raises(ValueError, match="sizes must list"):
        pyramid_sample(texels, uv, lod, ())
    with pytest.raises(ValueError, match="at most 16 mips"):
        pyramid_sample(texels, uv, lod, [(1, 1)] * 17)


def test_pyramid_kernels_compile_for_cuda(tmp_path):
    wp.init()
    wp.compile_aot_module(wp.get_module(pyramid.__name__), arch=80, module_dir=tmp_path, use_ptx=True)
    code = "".join(f.read_text(errors="replace") for f in tmp_path.glob("*.ptx"))
    for name in ("pyramid_sample_kernel", "pyramid_scatter_kernel", "pyramid_slope_kernel"):
        assert name in code
    assert "red.global.add" in code or "atom.global.add" in code
