"""BCf, the fitting side: four block-compressed feature pyramids and a network of one hidden layer (paper [bcf]).

G(u, v, s) = W₁ relu(W₀ [T₀(u, v, s₀), …, T₃(u, v, s₃)] + b₀) + b₁ (Eq. 3), each T sampled trilinearly (Eq. 10) at the
scale of Eq. 11. Texels come from one of two sets of parameters: *free* texels (the paper's unconstrained features), or
*blocks* of endpoints, positions, partition and mode (:mod:`warp_neumat.kernels.block_texture`).

Differs from the paper: features have mips down to 1×1 (``smallest_mip``; below 4×4 the paper's network sees the same
features for every scale and cannot tell the mips apart); free texels are kept within ``feature_range``, a few octaves
that BC6H resolves well; blocks may take any of the 14 modes.

:func:`reference_loss` is the plain torch version of one training step, which the kernels are tested against.
"""

from __future__ import annotations

import dataclasses
import difflib
import math

import numpy as np
import torch
from torch import nn
from torch.nn.functional import grid_sample

from warp_neumat.io.mipmaps import mip_sizes
from warp_neumat.kernels.bc6h_encode import bc6h_fit
from warp_neumat.kernels.bc6h_encode_pack import bc6h_pack, bc6h_unpack
from warp_neumat.kernels.bc6h_tables import ANCHOR, MODES, PARTITIONS
from warp_neumat.kernels.bcf_train import StepShape
from warp_neumat.kernels.block_texture import ONE_REGION
from warp_neumat.kernels.patches import Pyramids, stored_texels

DATA = "maps"
VERSION = 1

DEFAULT_STEPS = 8000
"""Optimiser steps of a fit where the caller names none."""

PRESETS = {
    "0.5k": (0.25, 0.125, 0.0625, 0.03125),
    "1k": (0.5, 0.25, 0.125, 0.0625),
    "2k": (1.0, 0.5, 0.25, 0.125),
    "2k++": (1.0, 1.0, 0.25, 0.125),
}
"""Sides of the four feature textures as fractions of the material's (Table 1 of the paper, for its 2048² materials)."""


@dataclasses.dataclass(frozen=True)
class BCfConfig:
    """Everything that decides the shape of a BCf material and how it is trained; defaults are the measured best."""

    features: tuple[tuple[int, int], ...]
    """(width, height) of each feature texture, multiples of 4."""
    width: int
    """Of the reference material [texel]."""
    height: int
    channels: tuple[dict, ...]
    """The network's outputs; see :class:`warp_neumat.io.texture_set.Channel`."""
    constants: dict
    """Maps kept as scalars."""
    smallest_mip: int = 1
    """Longer side of a feature texture's last mip. Paper: 4."""
    hidden: int = 16
    """Units of the hidden layer. Paper: 16."""
    signed: bool = False
    """Whether features are of the signed format."""
    wrap: str = "repeat"
    """``repeat``, ``clamp`` or ``mirror``, as the sampler will be set."""
    feature_range: tuple[float, float] = (0.25, 4.0)
    """Bounds of the free texels of the warm-up."""
    warmup: bool = True
    """Whether partitions come from free features that are trained first (paper §5.1); else they are drawn at random."""
    modes: str = "all"
    """``all``: every block takes the BC6H mode that fits it best; ``single``: mode 10, the paper's."""
    quantisation: str = "sequential"
    """How continuous blocks become real ones: ``sequential``, texture by texture, the rest making up for it;
    ``straight-through``, all at once and trained on through the rounding; ``once``, at the end (paper)."""
    repartition: int = 0
    """How often texels are set free for a moment and partitions chosen anew while blocks are trained."""
    sensitivity: bool = True
    """Whether encoding weighs each texel's error by how much the outputs care for it."""
    channel_weights: str = "uniform"
    """Weights of the channels in the loss: ``uniform`` (paper), or ``variance``: flat channels count more."""
    mip_decay: float = 0.5
    """Samples fall by 2^(−mip_decay) from mip to mip; weights in the loss make up for it. Paper: 0."""
    aligned: float = 0.5
    """Share of the samples that lie on texel centres of a mip. Paper: 0."""

    def __post_init__(self):
        _check(self)

    @property
    def mips(self) -> tuple[tuple[tuple[int, int], ...], ...]:
        """(width, height) of each mip of each feature texture."""
        return tuple(
            tuple(s for n, s in enumerate(mip_sizes(w, h)) if n == 0 or max(s) >= self.smallest_mip)
            for w, h in self.features
        )

    @property
    def pyramids(self) -> Pyramids:
        """Where features and reference lie in memory."""
        return Pyramids(self.mips, tuple(mip_sizes(self.width, self.height)), self.wrap == "repeat")

    @property
    def shape(self) -> StepShape:
        """What the training kernel is compiled for."""
        return StepShape(len(self.features), self.hidden, len(self.channels))


def _check(config: BCfConfig) -> None:
    rules = {
        "smallest_mip": (config.smallest_mip in (1, 2, 4), "must be 1, 2 or 4"),
        "hidden": (1 <= config.hidden <= 64, "must lie in 1 … 64"),
        "wrap": (config.wrap in ("repeat", "clamp", "mirror"), "must be repeat, clamp or mirror"),
        "modes": (config.modes in ("all", "single"), "must be all or single"),
        "channel_weights": (config.channel_weights in ("uniform", "variance"), "must be uniform or variance"),
        "quantisation": (
            config.quantisation in ("sequential", "straight-through", "once"),
            "must be sequential, straight-through or once",
        ),
        "repartition": (0 <= config.repartition <= 16, "must lie in 0 … 16"),
        "mip_decay": (0.0 <= config.mip_decay <= 2.0, "must lie in 0 … 2"),
        "aligned": (0.0 <= config.aligned <= 1.0, "must lie in 0 … 1"),
    }
    for name, (good, rule) in rules.items():
        if not good:
            raise ValueError(f"{name} {rule}, got {getattr(config, name)!r}")
    low, high = config.feature_range
    if not 2.0**-14 <= low < high <= 16384.0:
        raise ValueError(f"feature_range must lie in 2⁻¹⁴ … 16384, lower bound first, got {config.feature_range}")
    if not 1 <= len(config.features) <= 8:
        raise ValueError(f"features must name 1 to 8 sizes, got {len(config.features)}")
    for width, height in config.features:
        if width % 4 or height % 4 or not (4 <= width <= 16384 and 4 <= height <= 16384):
            raise ValueError(f"features must be multiples of 4 in 4 … 16384, got {width}x{height}")


def feature_sizes(width: int, height: int, features) -> tuple[tuple[int, int], ...]:
    """Return (width, height) of the feature textures of a material.

    Args:
        width: Of the material [texel].
        height: Of the material.
        features: A name of :data:`PRESETS`, or the longer side of each texture, as ``(256, 128, 64, 32)``.

    Textures have the material's proportions, rounded up to whole blocks, which Direct3D requires of a top mip.

    Raises: ValueError: If the preset is unknown or a side is no whole number.
    """
    longest = max(width, height)
    if isinstance(features, str):
        if features not in PRESETS:
            close = difflib.get_close_matches(features, PRESETS, n=1, cutoff=0.0)[0]
            raise ValueError(f"no preset {features!r}; nearest: {close}; known: {', '.join(PRESETS)}")
        features = tuple(fraction * longest for fraction in PRESETS[features])
    elif any(isinstance(f, bool) or not isinstance(f, int) or f < 1 for f in features):
        raise ValueError(f"features must be whole numbers above 0, as (256, 128, 64, 32), got {features!r}")

    def blocks(side: float) -> int:
        return 4 * max(1, math.ceil(round(side / 4, 6)))

    return tuple((blocks(side * width / longest), blocks(side * height / longest)) for side in features)


def sizes_for_bytes(width: int, height: int, budget: int, *, channels: int, hidden: int, smallest_mip: int):
    """Return the largest feature textures in the proportions of preset ``1k`` that fit, with the network, into bytes.

    Raises: ValueError: If not even the smallest fit; names the least that does.
    """
    longest, network = max(width, height), 2 * StepShape(len(PRESETS["1k"]), hidden, channels).weights

    def total(sizes) -> int:
        chains = (mip_sizes(*size) for size in sizes)
        return network + sum(
            stored_texels(mip) for mips in chains for n, mip in enumerate(mips) if n == 0 or max(mip) >= smallest_mip
        )

    best = None
    for side in range(4, 4 * longest + 1, 4):
        fractions = (fraction / PRESETS["1k"][0] for fraction in PRESETS["1k"])
        sizes = feature_sizes(width, height, tuple(max(4, 4 * round(side * f / 4)) for f in fractions))
        if total(sizes) > budget:
            if best is None:
                raise ValueError(f"bytes must be at least {total(sizes)} for {width}x{height}, got {budget}")
            break
        best = sizes
    return best


def configure(source, options: dict, preset: str | None = None) -> BCfConfig:
    """Return the configuration for a texture set; ``options`` are fields of :class:`BCfConfig`, or ``bytes``.

    ``features`` may be as :func:`feature_sizes` takes them; ``bytes`` is what the asset's tensors may take at most.

    Raises: ValueError: If an option is unknown or out of range, or the set has no channel to learn.
    """
    known = {f.name for f in dataclasses.fields(BCfConfig)} - {"width", "height", "channels", "constants"} | {"bytes"}
    for name in options:
        if name not in known:
            close = difflib.get_close_matches(name, known, n=1)
            nearest = f"nearest: {close[0]}; " if close else ""
            raise ValueError(f"no option {name!r} of bcf; {nearest}known: {', '.join(sorted(known))}")
    if not source.channels:
        raise ValueError(f"{source.name}: every map is constant, so there is nothing to learn; a renderer can use them")
    options = dict(options)
    if (preset is not None) + ("features" in options) + ("bytes" in options) > 1:
        raise ValueError("give a preset, features or bytes, not two of them")
    if "bytes" in options:
        shape = {name: options.get(name, getattr(BCfConfig, name)) for name in ("hidden", "smallest_mip")}
        budget = options.pop("bytes")
        if isinstance(budget, bool) or not isinstance(budget, int) or budget < 1:
            raise ValueError(f"bytes must be a whole number above 0, got {budget!r}")
        sizes = sizes_for_bytes(source.width, source.height, budget, channels=len(source.channels), **shape)
    else:
        sizes = feature_sizes(source.width, source.height, options.pop("features", preset or "1k"))
    if "feature_range" in options:
        options["feature_range"] = tuple(float(v) for v in options["feature_range"])
    channels = tuple(
        {"map": c.map, "component": c.component, "encoding": c.encoding, "range": [float(v) for v in c.range]}
        for c in source.channels
    )
    constants = {name: [float(v) for v in values] for name, values in source.constants.items()}
    return BCfConfig(sizes, source.width, source.height, channels, constants, **options)


class BCf(nn.Module):
    """A BCf material in training.

    Buffers, so that a checkpoint holds them all: ``texels`` (P, 4), ``net`` (weights,), ``endpoints`` (B, 4, 3),
    ``positions`` (B, 16), ``shapes`` (B,), ``modes`` (B,) int32; layouts as in the kernels.
    """

    def __init__(self, config: BCfConfig, mean: np.ndarray, seed: int = 0):
        super().__init__()
        self.config = config
        count, shape = config.pyramids.texel_count, config.shape
        generator = torch.Generator().manual_seed(seed)
        low, high = config.feature_range
        middle = math.sqrt(low * high)
        texels = torch.zeros(count, 4)
        texels[:, :3] = middle * (0.95 + 0.1 * torch.rand(count, 3, generator=generator))
        first = torch.randn(shape.inputs, shape.hidden, generator=generator) * math.sqrt(2 / shape.inputs) / middle
        offset = 0.1 * torch.rand(shape.hidden, generator=generator) - middle * first.sum(0)
        second = torch.randn(shape.hidden, shape.channels, generator=generator) / math.sqrt(shape.hidden)
        net = torch.cat([offset, first.reshape(-1), torch.from_numpy(mean).float(), second.reshape(-1)])
        blocks = count // 16
        self.register_buffer("texels", texels)
        self.register_buffer("net", net.contiguous())
        self.register_buffer("endpoints", torch.zeros(blocks, 4, 3))
        self.register_buffer("positions", torch.zeros(blocks, 16))
        self.register_buffer("shapes", torch.zeros(blocks, dtype=torch.int32))
        self.register_buffer("modes", torch.zeros(blocks, dtype=torch.int32))

    def layers(self, net: torch.Tensor | None = None) -> tuple[torch.Tensor, ...]:
        """Return (W₀ᵀ [3T, H], b₀ [H], W₁ᵀ [H, C], b₁ [C]), views of the packed weights."""
        net, shape = self.net if net is None else net, self.config.shape
        n, h, c = shape.inputs, shape.hidden, shape.channels
        sizes = [h, n * h, c, h * c]
        b0, w0, b1, w1 = torch.split(net, sizes)
        return w0.view(n, h), b0, w1.view(h, c), b1

    # --- blocks ---

    def random_blocks(self, generator: torch.Generator) -> None:
        """Draw blocks: random partitions, endpoints over the feature range (the paper's Fig. 15, "random")."""
        low, high = (math.log2(v) for v in self.config.feature_range)
        centre = ((low + high) / 2 + 15) / 31
        spread = torch.rand(self.endpoints.shape, generator=generator) - 0.5
        self.endpoints.copy_(centre + spread * (high - low) / 31)
        self.positions.copy_(torch.rand(self.positions.shape, generator=generator))
        self.shapes.copy_(torch.randint(0, 32, self.shapes.shape, generator=generator))
        self.modes.zero_()

    def encode(self, modes: str, sensitivity: torch.Tensor | None = None, part: tuple[int, int] | None = None) -> None:
        """Replace the blocks by the best BC6H encoding of the texels, in linear values, ready to train on.

        Args:
            modes: ``all`` or ``single``.
            sensitivity: (P, 4) weights of the squared error of each texel.
            part: First and last + 1 of the blocks to encode; default: all.
        """
        first, last = part or (0, len(self.shapes))
        targets = self.texels.view(-1, 16, 4)[first:last, :, :3].contiguous().cpu().numpy()
        if sensitivity is not None:
            rows = sensitivity.view(-1, 16, 4)[first:last, :, :3]
            # Relative to the block, and bounded: texels that no sample hits still have to land somewhere.
            rows = rows / rows.mean(dim=(1, 2), keepdim=True).clamp(min=1e-30) + 0.01
            sensitivity = rows.contiguous().cpu().numpy()
        blocks, _ = bc6h_fit(targets, weights=sensitivity, signed=self.config.signed, modes=modes, linear=True)
        self.load_blocks(blocks, first)

    def block_range(self, texture: int) -> tuple[int, int]:
        """Return the first and last + 1 of the blocks of a texture."""
        counts = [sum(stored_texels(size) // 16 for size in mips) for mips in self.config.mips]
        return sum(counts[:texture]), sum(counts[: texture + 1])

    def load_blocks(self, blocks: np.ndarray, first: int = 0) -> None:
        """Take over BC6H blocks (n, 16) uint8 as parameters from block ``first`` on, quantised to their modes."""
        parts, at = bc6h_unpack(blocks, self.config.signed), slice(first, first + len(blocks))
        one = np.array([False, *(m.regions == 1 for m in MODES)])[parts.mode]
        self.shapes[at] = torch.from_numpy(np.where(one, ONE_REGION, parts.partition).astype(np.int32))
        self.modes[at] = torch.from_numpy(parts.mode.astype(np.int32))
        full = 32768.0 if self.config.signed else 65536.0
        self.endpoints[at] = torch.from_numpy((parts.endpoints / full).astype(np.float32))
        steps = np.where(one, 15, 7)[:, None]
        self.positions[at] = torch.from_numpy((parts.indices / steps).astype(np.float32))

    def blocks(self) -> np.ndarray:
        """Return the BC6H blocks (B, 16) uint8 that the quantised parameters stand for, bit for bit."""
        codes, indices, shapes, modes = self.quantised()
        # Direct3D wants an anchor's index in the lower half: else its region's endpoints change places.
        for region, anchor in ((0, np.zeros(len(shapes), np.int64)), (1, ANCHOR[np.minimum(shapes, 31)].astype(int))):
            one = shapes == ONE_REGION
            half = np.where(one, 8, 4)
            turn = (indices[np.arange(len(shapes)), anchor] >= half) & ~(one & (region == 1))
            a, b = 2 * region, 2 * region + 1
            codes[np.ix_(turn, [a, b])] = codes[np.ix_(turn, [b, a])]
            masks = np.array([*PARTITIONS, 0])[shapes]
            inside = ((masks[:, None] >> np.arange(16)) & 1) == region
            flip = turn[:, None] & inside
            indices = np.where(flip, 2 * half[:, None] - 1 - indices, indices)
        partition = np.where(shapes == ONE_REGION, 0, shapes).astype(np.uint8)
        return bc6h_pack(
            modes.astype(np.uint8), partition, codes.astype(np.int32), indices.astype(np.uint8), self.config.signed
        )

    def quantised(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return (codes (B, 4, 3), indices (B, 16), shapes (B,), modes (B,)) by the arithmetic of the kernel."""
        shapes, modes = self.shapes.cpu().numpy(), self.modes.cpu().numpy()
        if not (modes > 0).all():
            raise ValueError("the blocks are continuous; encode them first")
        signed, e = self.config.signed, self.endpoints.cpu().numpy()
        precision = np.array([0, *(m.precision for m in MODES)])[modes][:, None, None]
        one = shapes == ONE_REGION
        steps = np.where(one, 15, 7)[:, None]
        indices = (self.positions.cpu().numpy().clip(0, 1) * steps.astype(np.float32) + np.float32(0.5)).astype(
            np.int32
        )
        most = (1 << (precision - signed)) - 1
        scaled = e * (1 << (precision - signed)).astype(np.float32)
        near = np.where(precision > 14, scaled + np.where(scaled < 0, np.float32(-0.5), np.float32(0.5)), scaled)
        codes = np.clip(near.astype(np.int32), -most if signed else 0, most)
        transformed = np.array([False, *(m.transformed for m in MODES)])[modes]
        reach = 1 << (np.array([(1, 1, 1), *(m.delta for m in MODES)])[modes][:, None, :] - 1)
        root = np.where(2 * indices[:, 0] > steps[:, 0], 1, 0)
        base = codes[np.arange(len(codes)), root][:, None, :]
        bounded = base + np.clip(codes - base, -reach, reach - 1)
        codes = np.where(transformed[:, None, None], bounded, codes)
        codes[one, 2:] = 0
        return codes, indices, shapes, modes

    # --- results ---

    def to_asset(self, blocks: np.ndarray) -> tuple[dict[str, np.ndarray], dict]:
        """Return (tensors, header) of the asset that holds ``blocks`` and the network, rounded to float16."""
        config, tensors, at = self.config, {}, 0
        for t, mips in enumerate(config.mips):
            for m, size in enumerate(mips):
                count = stored_texels(size) // 16
                tensors[f"texture{t}.mip{m}"] = blocks[at : at + count].reshape(-(-size[1] // 4), -(-size[0] // 4), 16)
                at += count
        w0, b0, w1, b1 = (p.detach().cpu().numpy().astype(np.float16) for p in self.layers())
        tensors |= {"weight0": w0.T.copy(), "bias0": b0.copy(), "weight1": w1.T.copy(), "bias1": b1.copy()}
        sizes = [{"width": mips[0][0], "height": mips[0][1], "mips": len(mips)} for mips in config.mips]
        header = {
            "kind": "bcf",
            "version": VERSION,
            "config": {
                "textures": sizes,
                "signed": config.signed,
                "hidden": config.hidden,
                "width": config.width,
                "height": config.height,
                "wrap": config.wrap,
                "channels": [dict(c) for c in config.channels],
                "constants": dict(config.constants),
            },
        }
        return tensors, header

    def statistics(self) -> dict:
        """Return facts for the header: how many blocks took each mode, and the range of the features."""
        used = torch.bincount(self.modes, minlength=15)[1:].tolist()
        values = self.texels[:, :3]
        return {
            "block_modes": used,
            "one_region": round(float((self.shapes == ONE_REGION).float().mean()), 4),
            "feature_range": [float(values.min()), float(values.max())],
        }


# --- the plain torch version --------------------------------------------------------------------------------------


def decode_reference(endpoints, positions, shapes) -> torch.Tensor:
    """Return the texels (B, 16, 3) of continuous blocks by Eq. 6–9, in plain torch; differentiable.

    Args:
        endpoints: (B, 4, 3) in (−1, 1).
        positions: (B, 16) in [0, 1].
        shapes: (B,) int32, 0 … 32.
    """
    masks = torch.tensor([*(int(m) for m in PARTITIONS), 0], device=endpoints.device)[shapes.long()]
    region = ((masks[:, None] >> torch.arange(16, device=endpoints.device)) & 1).bool()[:, :, None]
    low = torch.where(region, endpoints[:, None, 2], endpoints[:, None, 0])
    high = torch.where(region, endpoints[:, None, 3], endpoints[:, None, 1])
    y = 31744.0 * (low + (high - low) * positions[:, :, None])
    octave = torch.clamp(torch.floor(y.detach().abs() / 1024.0) - 1.0, min=0.0)
    return torch.sign(y) * torch.exp2(octave - 14.0) * (y.abs() / 1024.0 - octave)


def _images(texels: torch.Tensor, mips) -> list[torch.Tensor]:
    """Turn the rows of a pyramid, block by block, into pictures (1, 3, h, w)."""
    pictures, at = [], 0
    for width, height in mips:
        rows, columns = -(-height // 4), -(-width // 4)
        part = texels[at : at + 16 * rows * columns, :3].reshape(rows, columns, 4, 4, 3)
        picture = part.permute(4, 0, 2, 1, 3).reshape(1, 3, 4 * rows, 4 * columns)
        pictures.append(picture[:, :, :height, :width])
        at += 16 * rows * columns
    return pictures


def _sample(picture: torch.Tensor, uv: torch.Tensor, mode: str, repeat: bool) -> torch.Tensor:
    """Sample (1, C, h, w) at uv (N, 2); repetition by two texels of padding, which is all a footprint needs."""
    height, width = picture.shape[2:]
    if repeat:
        rows = torch.arange(-2, height + 2, device=picture.device) % height
        columns = torch.arange(-2, width + 2, device=picture.device) % width
        picture = picture[:, :, rows][:, :, :, columns]
        size = torch.tensor([width, height], dtype=uv.dtype, device=uv.device)
        uv = (uv * size + 2.0) / (size + 4.0)
    grid = (2.0 * uv - 1.0)[None, None]
    return grid_sample(picture, grid, mode=mode, padding_mode="border", align_corners=False)[0, :, 0].T


def _trilinear(pictures, uv, s: float, mode: str, repeat: bool) -> torch.Tensor:
    """Blend the two mips nearest scale ``s`` (Eq. 10)."""
    m = min(int(s), max(len(pictures) - 2, 0))
    share = s - m
    value = _sample(pictures[m], uv, mode, repeat)
    if share > 0:
        value = (1.0 - share) * value + share * _sample(pictures[m + 1], uv, mode, repeat)
    return value


def reference_loss(model: BCf, texels, net, reference, patches, uv, channel_weight) -> torch.Tensor:
    """Return the loss of one training step in plain torch, differentiable in ``texels`` and ``net``.

    Args:
        model: Gives sizes.
        texels: (P, 3 or 4), the rows the kernels sample.
        net: Packed weights.
        reference: Pictures (1, C, h, w) by mip.
        patches: (n, 8), as :func:`warp_neumat.kernels.patches.draw_patches` returns them.
        uv: (n, 256, 2) texture coordinates.
        channel_weight: (C,).
    """
    config = model.config
    pyramids, repeat = config.pyramids, config.wrap == "repeat"
    offsets = [row[0] for row in pyramids.feature_offsets] + [pyramids.texel_count]
    features = [_images(texels[offsets[t] : offsets[t + 1]], mips) for t, mips in enumerate(config.mips)]
    w0, b0, w1, b1 = model.layers(net)
    total = 0.0
    for patch, where in zip(patches.tolist(), uv, strict=True):
        s, weight = patch[0], patch[1]
        target = _trilinear(reference, where, s, "bicubic", repeat)
        inputs = [
            _trilinear(pictures, where, min(max(s + bias, 0.0), len(pictures) - 1.0), "bilinear", repeat)
            for pictures, bias in zip(features, pyramids.biases, strict=True)
        ]
        output = torch.relu(torch.cat(inputs, 1) @ w0 + b0) @ w1 + b1
        total = total + weight * (channel_weight * (output - target) ** 2).mean()
    return total / len(patches)


def build(config: BCfConfig, seed: int, mean: np.ndarray) -> BCf:
    """Return a model of ``config`` whose draws come from ``seed``; ``mean`` (C,) is the reference's."""
    return BCf(config, mean, seed)
