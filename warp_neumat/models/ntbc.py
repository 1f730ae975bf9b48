"""NTBC, the fitting side: networks that predict endpoints and colours of blocks from feature grids (paper [ntbc], §3).

Each model is two networks over grids: the *endpoint* network is looked up at blocks and predicts e₀ and e₁ of its
planes, the *texel* network at texels and predicts their colours ĉ (or, in the naive variant, their weights). A block is
what BC1, BC4 or BC7 make of both: rounded endpoints, and for each texel the palette entry that is nearest to ĉ (Eq. 9,
10). Places, palettes, packing of the weights and losses are as in :mod:`warp_neumat.kernels.ntbc_network` and
:mod:`warp_neumat.kernels.ntbc_train`.

Differs from the paper: e₀ of a reference block is always the brighter endpoint, because the order in which a file
stores them jumps from block to block; which of BC4's two palettes is used is decided when a block is written, from ĉ,
rather than by the predicted endpoints (Eq. 8); Eq. 5 is z = −⌊α/s⌉ as printed it would not represent α.

:mod:`warp_neumat.models.ntbc_plain` is the plain torch version of a training step.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import nn

from warp_neumat.io.asset import pack_bits
from warp_neumat.io.block_formats import to_blocks
from warp_neumat.io.mipmaps import unit_normals
from warp_neumat.kernels.colour_metric import plane_metrics
from warp_neumat.kernels.ntbc_network import NetworkShape
from warp_neumat.models.ntbc_config import Grids, Model, NTBCConfig, Plane, configure

__all__ = ["DATA", "DEFAULT_STEPS", "NTBC", "NTBCConfig", "PRESETS", "VERSION", "build", "configure"]

DATA = "block_maps"
VERSION = 1

DEFAULT_STEPS = 8000
"""Optimiser steps of each model where the caller names none. Paper: 20,000."""

PRESETS: dict = {}


def metrics(config: NTBCConfig, model: Model) -> torch.Tensor:
    """Return G of the squared difference δᵀGδ of each plane that a model writes, (planes, 4, 4) float32."""
    planes = [(plane.components, plane.channels) for plane in config.planes(model)]
    return torch.from_numpy(plane_metrics(config.metric, planes, config.channels))


def plane_colours(plane: Plane, pixels: np.ndarray) -> np.ndarray:
    """Return what a plane holds of a set's pixels, (H, W, components) float32: its channels, and z of a normal."""
    values = pixels[..., plane.channels]
    if plane.components > len(plane.channels):
        values = 0.5 + 0.5 * unit_normals(values)
    return np.ascontiguousarray(values, np.float32)


def block_colours(planes, pixels: np.ndarray) -> torch.Tensor:
    """Return the colours of all blocks of a picture, plane by plane, (blocks, components, 16) float32."""
    values = np.concatenate([plane_colours(plane, pixels) for plane in planes], axis=2)
    blocks = to_blocks(values)
    count = blocks.shape[0] * blocks.shape[1]
    return torch.from_numpy(np.ascontiguousarray(blocks.reshape(count, 16, -1).transpose(0, 2, 1)))


def _initial(shape: NetworkShape, generator: torch.Generator) -> torch.Tensor:
    """Return packed weights drawn after He et al. 2015, biases 0 (NTBC §3.4)."""
    net, widths = torch.zeros(shape.weights), (shape.inputs, *shape.hidden, shape.outputs)
    for n, (_, at) in enumerate(shape.offsets):
        rows, columns = shape.rows[n], shape.rows[n + 1]
        drawn = torch.randn(widths[n], widths[n + 1], generator=generator) * math.sqrt(2.0 / widths[n])
        net[at : at + rows * columns].view(rows, columns)[: widths[n], : widths[n + 1]] = drawn
    return net


def layers(shape: NetworkShape, net: torch.Tensor) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """Return (weight (out, in), bias (out,)) of every layer, views of packed weights without their padding."""
    widths, found = (shape.inputs, *shape.hidden, shape.outputs), []
    for n, (bias, at) in enumerate(shape.offsets):
        rows, columns = shape.rows[n], shape.rows[n + 1]
        weight = net[at : at + rows * columns].view(rows, columns)
        found.append((weight[: widths[n], : widths[n + 1]].T, net[bias : bias + widths[n + 1]]))
    return found


def level_views(shape: NetworkShape, grid: torch.Tensor) -> list[torch.Tensor]:
    """Return (height, width, features) of every level, views of flat grids."""
    sizes = zip(shape.levels, shape.grid_offsets, shape.grid_sizes, strict=True)
    return [grid[at : at + size].view(h, w, shape.features) for (w, h), at, size in sizes]


# --- quantisation -----------------------------------------------------------------------------------------------------


def quantiser(values: torch.Tensor, bits: int) -> tuple[float, int]:
    """Return (s, z) of asymmetric quantisation to ``bits`` over the range of ``values`` and 0 (NTBC Eq. 4, 5)."""
    low, high = min(float(values.min()), 0.0), max(float(values.max()), 0.0)
    scale = float(np.float32(max(high - low, 1e-12) / (2**bits - 1)))
    return scale, -round(low / scale)


def quantise(values: torch.Tensor, scale: float, zero: int, bits: int) -> torch.Tensor:
    """Return integers 0 … 2ᵇ − 1 of values, as floats (NTBC Eq. 1)."""
    return (torch.round(values / scale) + zero).clamp_(0, 2**bits - 1)


def rounded_grid(shape: NetworkShape, grid: torch.Tensor, bits: int, out: torch.Tensor) -> None:
    """Write grids as they will be read back from the file into ``out``, level by level (NTBC Eq. 3)."""
    for level, target in zip(level_views(shape, grid), level_views(shape, out), strict=True):
        scale, zero = quantiser(level, bits)
        target.copy_((quantise(level, scale, zero, bits) - zero) * scale)


# --- the model --------------------------------------------------------------------------------------------------------


class Pair(nn.Module):
    """The two networks of one model; buffers ``endpoint_grid``, ``endpoint_net``, ``texel_grid``, ``texel_net``."""

    def __init__(self, config: NTBCConfig, model: Model, generator: torch.Generator):
        super().__init__()
        self.model, self.shape = model, config.shape(model)
        for name, shape in (("endpoint", self.shape.endpoint), ("texel", self.shape.texel)):
            # Paper: uniform in ±10⁻⁴.
            grid = (2.0 * torch.rand(shape.grid_words, generator=generator) - 1.0) * 1e-4
            self.register_buffer(f"{name}_grid", grid)
            self.register_buffer(f"{name}_net", _initial(shape, generator))

    def networks(self):
        """Yield (name, shape, grids, grid values, packed weights) of both networks."""
        yield "endpoint", self.shape.endpoint, self.model.endpoint, self.endpoint_grid, self.endpoint_net
        yield "texel", self.shape.texel, self.model.texel, self.texel_grid, self.texel_net


class NTBC(nn.Module):
    """An NTBC material in training: a :class:`Pair` for each model of its config."""

    def __init__(self, config: NTBCConfig, seed: int = 0):
        super().__init__()
        self.config = config
        generator = torch.Generator().manual_seed(seed)
        self.pairs = nn.ModuleList(Pair(config, model, generator) for model in config.models)

    def to_asset(self) -> tuple[dict[str, np.ndarray], dict]:
        """Return (tensors, header): grids as integers with scale and zero by level, weights in float16."""
        config, tensors = self.config, {}
        for number, pair in enumerate(self.pairs):
            for name, shape, grids, grid, net in pair.networks():
                if name == "endpoint" and config.endpoints == "fitted":
                    continue
                key, scales, zeros = f"model{number}.{name}", [], []
                for n, level in enumerate(level_views(shape, grid.cpu())):
                    scale, zero = quantiser(level, grids.bits)
                    codes = quantise(level, scale, zero, grids.bits).numpy().astype(np.uint8)
                    tensors[f"{key}.grid{n}"] = pack_bits(codes, grids.bits)
                    scales.append(scale)
                    zeros.append(zero)
                tensors[f"{key}.scale"] = np.array(scales, np.float32)
                tensors[f"{key}.zero"] = np.array(zeros, np.int16)
                for n, (weight, bias) in enumerate(layers(shape, net.cpu())):
                    tensors[f"{key}.weight{n}"] = weight.numpy().astype(np.float16)
                    tensors[f"{key}.bias{n}"] = bias.numpy().astype(np.float16)
        return tensors, {"kind": "ntbc", "version": VERSION, "config": self._header_config()}

    def _header_config(self) -> dict:
        config = self.config
        fitted = config.endpoints == "fitted"
        return {
            "width": config.width,
            "height": config.height,
            "wrap": config.wrap,
            "mode": config.mode,
            "variant": config.variant,
            "endpoints": config.endpoints,
            "metric": config.metric,
            "channels": [dict(c) for c in config.channels],
            "constants": dict(config.constants),
            "textures": [
                {
                    "name": texture.name,
                    "format": texture.format,
                    "planes": [{"format": p.format, "channels": list(p.channels)} for p in texture.planes],
                }
                for texture in config.textures
            ],
            "models": [
                {
                    "planes": [list(pair) for pair in model.planes],
                    "endpoint": None if fitted else _header_grids(model.endpoint),
                    "texel": _header_grids(model.texel),
                }
                for model in config.models
            ],
            "hidden": list(config.hidden),
        }

    def statistics(self) -> dict:
        """Return facts for the header: the largest feature and weight, and bytes by network."""
        used = [
            entry
            for pair in self.pairs
            for entry in pair.networks()
            if entry[0] == "texel" or self.config.endpoints == "network"
        ]
        return {
            "feature_range": [min(float(g.min()) for *_, g, _ in used), max(float(g.max()) for *_, g, _ in used)],
            "weight_range": [min(float(n.min()) for *_, n in used), max(float(n.max()) for *_, n in used)],
            "grid_bytes": sum(grids.bytes for _, _, grids, _, _ in used),
        }


def _header_grids(grids: Grids) -> dict:
    return {"levels": [list(size) for size in grids.levels], "features": grids.features, "bits": grids.bits}


def build(config: NTBCConfig, seed: int) -> NTBC:
    """Return a model of ``config`` whose draws come from ``seed``."""
    return NTBC(config, seed)
