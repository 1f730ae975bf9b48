"""Trilinear look-ups in a feature pyramid as a torch operator (BCf Eq. 10), and the same in plain torch."""

import torch
import warp as wp

from warp_neumat.kernels import pyramid as kernels
from warp_neumat.kernels.dispatch import launch
from warp_neumat.kernels.filter import MOST_MIPS, WRAPS
from warp_neumat.kernels.patches import Pyramids
from warp_neumat.ops.stream import torch_stream

PARTS = 4
"""Buffers that the texels' gradient is summed in on a CPU: as many on every machine, so that rounding is the same."""


def _pyramid(sizes) -> Pyramids:
    """Return the layout of one texture; ``sizes`` are (width, height) by mip."""
    mips = tuple(tuple(int(side) for side in size) for size in sizes)
    if not mips or any(len(size) != 2 or min(size) < 1 for size in mips):
        raise ValueError(f"sizes must list (width, height) of at least one mip, each at least 1, got {mips}")
    if len(mips) > MOST_MIPS:
        raise ValueError(f"sizes may list at most {MOST_MIPS} mips, got {len(mips)}")
    return Pyramids((mips,), mips)


class _Launch:
    """Checked arguments of the kernels."""

    def __init__(self, uv, lod, sizes, wrap, texels=None, gradient=None):
        wp.init()  # at no cost but the first time; mapping a torch device to Warp's needs it
        if wrap not in WRAPS:
            raise ValueError(f"wrap must be one of {', '.join(WRAPS)}, got {wrap!r}")
        self.layout = _pyramid(zip(sizes[::2], sizes[1::2], strict=True))
        self.mips, self.count = len(sizes) // 2, uv.shape[0]
        expected = {"uv": (uv, (self.count, 2)), "lod": (lod, (self.count,))}
        expected |= {"texels": (texels, (self.layout.texel_count, 4)), "gradient": (gradient, (self.count, 3))}
        for name, (tensor, shape) in expected.items():
            if tensor is not None and (tensor.dtype != torch.float32 or tuple(tensor.shape) != shape):
                raise ValueError(f"{name} must be float32 of shape {shape}, got {tensor.dtype} {tuple(tensor.shape)}")
        self.device = wp.device_from_torch(uv.device)
        table = torch.from_numpy(self.layout.table()[: self.mips].ravel()).to(uv.device)
        self.samples = [_rows(uv, wp.vec2), _rows(lod, wp.float32), wp.from_torch(table)]
        self.samples += [self.mips, WRAPS.index(wrap)]
        self.run = kernels.CPU_RUN if self.device.is_cpu else 1
        self.blocks = -(-self.count // self.run)


def _rows(tensor: torch.Tensor, dtype) -> wp.array:
    if not tensor.numel():  # may have any strides and still count as contiguous
        tensor = torch.empty_like(tensor, memory_format=torch.contiguous_format)
    return wp.from_torch(tensor.detach().contiguous(), dtype=dtype)


@torch.library.custom_op("neumat::pyramid_sample", mutates_args=())
def _sample(texels: torch.Tensor, uv: torch.Tensor, lod: torch.Tensor, sizes: list[int], wrap: str) -> torch.Tensor:
    call = _Launch(uv, lod, sizes, wrap, texels=texels)
    colours = texels.new_empty((call.count, 3))
    inputs = [call.run, _rows(texels, wp.vec4), *call.samples]
    outputs = [wp.from_torch(colours, dtype=wp.vec3)]
    with torch_stream(call.device):
        launch(kernels.pyramid_sample_kernel, call.blocks, inputs, outputs, device=call.device)
    return colours


@_sample.register_fake
def _(texels, uv, lod, sizes, wrap):
    return texels.new_empty((uv.shape[0], 3))


@torch.library.custom_op("neumat::pyramid_scatter", mutates_args=())
def pyramid_scatter(
    gradient: torch.Tensor, uv: torch.Tensor, lod: torch.Tensor, sizes: list[int], wrap: str
) -> torch.Tensor:
    """Return the gradient (P, 4) of the texels from that of the samples (N, 3): the transpose of the look-up.

    On a CPU the same bits for the same input on any number of cores; on CUDA sums are in no fixed order.

    Error: 4e-7 of the largest Σ|weight·gradient| against float64, held by test_pyramid_sample_matches_torch.
    """
    call = _Launch(uv, lod, sizes, wrap, gradient=gradient)
    texel_count = call.layout.texel_count
    parts, buffers = (PARTS, PARTS) if call.device.is_cpu else (max(1, call.count), 1)
    sums = gradient.new_zeros((buffers, texel_count, 4))
    inputs = [parts, buffers, _rows(gradient, wp.vec3), *call.samples, texel_count]
    outputs = [wp.from_torch(sums.view(-1, 4), dtype=wp.vec4)]
    with torch_stream(call.device):
        launch(kernels.pyramid_scatter_kernel, parts, inputs, outputs, device=call.device, grain=1)
    return sums.sum(0)


@pyramid_scatter.register_fake
def _(gradient, uv, lod, sizes, wrap):
    return gradient.new_empty((_pyramid(zip(sizes[::2], sizes[1::2], strict=True)).texel_count, 4))


@torch.library.custom_op("neumat::pyramid_slope", mutates_args=())
def pyramid_slope(
    gradient: torch.Tensor, texels: torch.Tensor, uv: torch.Tensor, lod: torch.Tensor, sizes: list[int], wrap: str
) -> torch.Tensor:
    """Return the gradients (N, 3) of u, v and level from that of the samples (N, 3)."""
    call = _Launch(uv, lod, sizes, wrap, texels=texels, gradient=gradient)
    slopes = gradient.new_empty((call.count, 3))
    inputs = [call.run, _rows(gradient, wp.vec3), _rows(texels, wp.vec4), *call.samples]
    outputs = [wp.from_torch(slopes, dtype=wp.vec3)]
    with torch_stream(call.device):
        launch(kernels.pyramid_slope_kernel, call.blocks, inputs, outputs, device=call.device)
    return slopes


@pyramid_slope.register_fake
def _(gradient, texels, uv, lod, sizes, wrap):
    return gradient.new_empty((uv.shape[0], 3))


def _keep(ctx, inputs, output):
    texels, uv, lod, ctx.sizes, ctx.wrap = inputs
    ctx.save_for_backward(texels, uv, lod)


def _backward(ctx, gradient):
    texels, uv, lod = ctx.saved_tensors
    of_texels = of_uv = of_lod = None
    if ctx.needs_input_grad[0]:
        of_texels = pyramid_scatter(gradient, uv, lod, ctx.sizes, ctx.wrap)
    if ctx.needs_input_grad[1] or ctx.needs_input_grad[2]:
        slopes = pyramid_slope(gradient, texels, uv, lod, ctx.sizes, ctx.wrap)
        of_uv, of_lod = slopes[:, :2], slopes[:, 2]
    return of_texels, of_uv, of_lod, None, None


_sample.register_autograd(_backward, setup_context=_keep)


def pyramid_sample(texels, uv, lod, sizes, wrap: str = "repeat") -> torch.Tensor:
    """Return the colours (N, 3) of a pyramid at ``uv``, trilinear (Eq. 10); differentiable in all three tensors.

    Args:
        texels: (P, 4) float32: r, g, b, unused; 4 × 4 blocks row by row, mips one after another, as
            :class:`warp_neumat.kernels.patches.Pyramids` lays them out.
        uv: (N, 2) float32, origin top left, texel centres at (i + 0.5)/W.
        lod: (N,) float32, the level of each sample in this pyramid; limited to the mips there are.
        sizes: (width, height) of each mip, finest first.
        wrap: ``repeat``, ``clamp`` or ``mirror``.

    The gradient of ``lod`` is the difference of the two mips it lies between; of ``uv`` that of the bilinear weights.

    Raises: ValueError: If a shape, type, size or wrap mode does not fit.

    Error: values 2e-6 + 4e-7 W of the texels' size, W the longer side (rounding of coordinates outside [0, 1]);
    gradients of texels 4e-7 of the largest sum of magnitudes, against float64; held by
    test_pyramid_sample_matches_torch.
    """
    return _sample(texels, uv, lod, [int(side) for size in sizes for side in size], wrap)


def pyramid_sample_reference(texels, uv, lod, sizes, wrap: str = "repeat") -> torch.Tensor:
    """Return what :func:`pyramid_sample` does, in plain torch and in any float type."""
    layout = _pyramid(sizes)
    table = torch.from_numpy(layout.table()[: len(sizes)]).long().to(uv.device)
    top = len(sizes) - 1
    if wrap == "clamp":
        place = uv.clamp(0.0, 1.0)
    elif wrap == "mirror":
        place = 1.0 - (torch.remainder(uv, 2.0) - 1.0).abs()
    else:
        place = torch.remainder(uv, 1.0)
    s = lod.clamp(0.0, top)
    mip = s.detach().long().clamp(0, max(top - 1, 0))
    total = 0.0
    for side in (0, 1):
        offset, *size = table[(mip + side).clamp(max=top)].unbind(1)
        size = torch.stack(size, 1)
        at = place * size - 0.5
        near = at.detach().floor()
        weight = at - near
        near = near.long()
        far = near + 1
        near, far = (near % size, far % size) if wrap == "repeat" else (near.clamp(min=0), torch.minimum(far, size - 1))
        share = s - mip if side else 1.0 - (s - mip)
        for right in (0, 1):
            x, wx = far[:, 0] if right else near[:, 0], weight[:, 0] if right else 1.0 - weight[:, 0]
            for below in (0, 1):
                y, wy = far[:, 1] if below else near[:, 1], weight[:, 1] if below else 1.0 - weight[:, 1]
                block = (y // 4) * ((size[:, 0] + 3) // 4) + x // 4
                row = offset + 16 * block + 4 * (y % 4) + x % 4
                total = total + (share * wx * wy)[:, None] * texels[row, :3]
    return total
