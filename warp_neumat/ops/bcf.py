"""One training step of a BCf material as a torch operator: loss and all gradients in one pass (BCf Eq. 3–5)."""

import torch
import warp as wp

from warp_neumat.kernels.bcf_train import StepShape, step_kernel
from warp_neumat.kernels.dispatch import Job, lanes
from warp_neumat.kernels.patches import PATCH, Pyramids
from warp_neumat.ops.block_texture import flat
from warp_neumat.ops.stream import torch_stream


def _check(name: str, tensor: torch.Tensor, dtype: torch.dtype, shape: tuple[int, ...]) -> None:
    if tensor.dtype != dtype or tuple(tensor.shape) != shape:
        raise ValueError(f"{name} must be {dtype} of shape {shape}, got {tensor.dtype} {tuple(tensor.shape)}")


class Step:
    """A training step with buffers of its own, recorded once and replayed without allocation.

    Args:
        pyramids: Sizes of features and reference.
        shape: Sizes of the network.
        texels: (P, 4) float32, read at each run.
        net: Packed weights, read at each run.
        reference: From :func:`warp_neumat.kernels.patches.pad_reference`, float16, flat.
        patch_count: Patches of 256 samples a step.
        parts: Buffers that gradients are summed in, one thread each. The same number gives the same bits.
        channel_weight: (C,) float32, factors of the channels' squared errors; default: ones.

    Attributes:
        patches: (patch_count, 8), to be filled before :meth:`run`.
        losses: (patch_count, C): weighted mean squared error of each patch and channel.
        texel_gradient: (parts, P, 4).
        weight_gradient: (parts, weights).
    """

    def __init__(
        self, pyramids: Pyramids, shape: StepShape, texels, net, reference, patch_count, parts, channel_weight=None
    ):
        wp.init()
        device = texels.device
        if channel_weight is None:
            channel_weight = torch.ones(shape.channels, device=device)
        words = pyramids.reference_offsets[-1] * shape.stride
        _check("texels", texels, torch.float32, (pyramids.texel_count, 4))
        _check("net", net, torch.float32, (shape.weights,))
        _check("reference", reference, torch.float16, (words,))
        _check("channel_weight", channel_weight, torch.float32, (shape.channels,))
        if len(pyramids.features) != shape.textures:
            raise ValueError(f"pyramids have {len(pyramids.features)} textures, the network takes {shape.textures}")
        table = torch.from_numpy(pyramids.table()).to(device)
        mips = torch.tensor([len(m) for m in pyramids.features], dtype=torch.int32, device=device)
        biases = torch.tensor(pyramids.biases, dtype=torch.float32, device=device)
        self.patches = torch.zeros(patch_count, 8, device=device)
        self.losses = torch.zeros(patch_count, shape.channels, device=device)
        self.texel_gradient = torch.zeros(parts, pyramids.texel_count, 4, device=device)
        self.weight_gradient = torch.zeros(parts, shape.weights, device=device)
        self.samples = torch.zeros(patch_count, 256, 2, device=device)
        scratch = torch.zeros(parts * shape.scratch, device=device)
        self._device, wide = wp.device_from_torch(device), lanes(wp.device_from_torch(device)) > 1
        if not wide and parts != 1:
            raise ValueError(f"parts must be 1 on {device}, which sums gradients by atomic additions, got {parts}")
        self._job = Job(
            step_kernel(shape, 256 if wide else 1),
            parts if wide else patch_count * PATCH,
            inputs=[
                parts, 0, int(pyramids.repeat), 0, flat(self.patches), patch_count, flat(table), flat(mips),
                flat(biases), len(pyramids.reference), flat(texels), pyramids.texel_count, flat(reference), flat(net),
                flat(channel_weight.contiguous()), flat(scratch),
            ],
            outputs=[flat(t) for t in (self.texel_gradient, self.weight_gradient, self.losses, self.samples)],
            device=self._device,
            grain=1,
        )  # fmt: skip
        self._keep = (table, mips, biases, scratch, reference, texels, net, channel_weight)

    def run(self, patches, key: int, *, probe: bool = False) -> None:
        """Fill losses and gradients for these patches; ``key`` decides the jitter of the samples.

        With ``probe`` the residuals are random signs: the squares of the texels' gradient average, over keys, to the
        diagonal of JᵀJ, how much the outputs care for each texel. Losses are left as they were.
        """
        if patches.shape != self.patches.shape:
            raise ValueError(f"patches must have shape {tuple(self.patches.shape)}, got {tuple(patches.shape)}")
        self.patches.copy_(patches)
        self.texel_gradient.zero_()
        self.weight_gradient.zero_()
        if not self._device.is_cpu and not probe:
            self.losses.zero_()
        self._job.set(1, key & 0x7FFFFFFF)
        self._job.set(3, int(probe))
        with torch_stream(self._device):
            self._job.run()


@torch.library.custom_op("neumat::bcf_loss", mutates_args=())
def _bcf_loss(
    texels: torch.Tensor,
    net: torch.Tensor,
    reference: torch.Tensor,
    patches: torch.Tensor,
    sizes: list[int],
    channels: int,
    hidden: int,
    key: int,
    repeat: bool,
    parts: int,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    pyramids = _pyramids(sizes, repeat)
    shape = StepShape(len(pyramids.features), hidden, channels)
    texels, net, reference = texels.detach().contiguous(), net.detach().contiguous(), reference.contiguous()
    step = Step(pyramids, shape, texels, net, reference, patches.shape[0], parts)
    step.run(patches, key)
    return step.losses.mean(), step.texel_gradient.sum(0), step.weight_gradient.sum(0), step.samples


def _sizes(pyramids: Pyramids) -> list[int]:
    """Flatten the sizes: number of textures, then of each pyramid its mips and their widths and heights."""
    result = [len(pyramids.features)]
    for mips in (*pyramids.features, pyramids.reference):
        result += [len(mips), *(side for size in mips for side in size)]
    return result


def _pyramids(sizes: list[int], repeat: bool) -> Pyramids:
    at, chains = 1, []
    for _ in range(sizes[0] + 1):
        count = sizes[at]
        values = sizes[at + 1 : at + 1 + 2 * count]
        chains.append(tuple(zip(values[::2], values[1::2], strict=True)))
        at += 1 + 2 * count
    return Pyramids(tuple(chains[:-1]), chains[-1], repeat)


@_bcf_loss.register_fake
def _(texels, net, reference, patches, sizes, channels, hidden, key, repeat, parts):
    samples = texels.new_empty((patches.shape[0], 256, 2))
    return texels.new_empty(()), torch.empty_like(texels), torch.empty_like(net), samples


def _keep(ctx, inputs, output):
    ctx.save_for_backward(output[1], output[2])
    ctx.mark_non_differentiable(*output[1:])


def _backward(ctx, gradient, *_):
    texels, net = ctx.saved_tensors
    return gradient * texels, gradient * net, *([None] * 8)


_bcf_loss.register_autograd(_backward, setup_context=_keep)


def bcf_loss(
    texels,
    net,
    reference,
    patches,
    pyramids: Pyramids,
    *,
    channels: int,
    hidden: int = 16,
    key: int = 0,
    parts: int = 1,
):
    """Return the loss of one training step and its samples (n, 256, 2); differentiable in ``texels`` and ``net``.

    Args:
        texels: (P, 4) float32, rows of the feature pyramids, block by block.
        net: Packed weights float32.
        reference: Flat float16, from :func:`warp_neumat.kernels.patches.pad_reference`.
        patches: (n, 8) float32, from :func:`warp_neumat.kernels.patches.draw_patches`.
        pyramids: Sizes of features and reference.
        channels: C.
        hidden: Units of the hidden layer.
        key: Decides the jitter of the samples.
        parts: Threads.

    The loss is the mean over patches, samples and channels of weight × squared error. :class:`Step` is the same
    without allocation, for loops.

    Error: gradients 1e-5 of the largest against torch in float64; held by test_step_matches_torch.
    """
    loss, _, _, samples = _bcf_loss(
        texels, net, reference, patches, _sizes(pyramids), channels, hidden, key, pyramids.repeat, parts
    )
    return loss, samples
