"""What block compression of the maps themselves costs and keeps: BC and ASTC 12×12, as a game would store them.

Paper [bcf], Sec. 6.1: BC5 for normals and BC1 for all the rest, ASTC with 12×12 blocks, at full resolution and with the
finest mip left out (``half``), all mips counted, highest quality. Maps go into textures as a game packs them: colours
by themselves, normals as x and y, one-channel maps three by three in the order occlusion, roughness, metallic, then as
they come (the paper's ``arm`` texture), linear and sRGB ones never mixed. Constant maps are no channels and cost
nothing, as they cost the neural file nothing.

``bc_same`` is for materials that are BC textures themselves (ntbc): the formats that it writes, from an encoder that
sees the maps.

Differs from the paper: a one-channel texture is BC1 by its rule, with grey in all three components, though BC4 keeps
more at the same size; the ``bc7`` methods, BC7 for colours and triples, BC5 for pairs, BC4 for single maps, are there
to show the best that block compression does, at up to twice the size. A normal map's ASTC blocks hold x and y as
luminance and alpha and are optimised for angle, which also gave the best PSNR (by 0.3 dB or more).

The encoders are the best of those on PyPI that were tried on crops of real maps: quicktex for BC1, BC4 and BC5 (level
18; 3 to 10 dB over etcpak's), etcpak for BC7 (uber level 4, all partitions), astc-encoder-py for ASTC. They see what
the loss sees: encoded values, rounded to 8 bits for BC. Each is decoded by its own package, to 8 bits for BC.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import os

import numpy as np

ARM = ("occlusion", "roughness", "metallic")
"""One-channel maps that are packed first, in this order."""

METHODS = {
    "bc_same": ("same", 0),
    "bc_full": ("paper", 0),
    "bc_half": ("paper", 1),
    "bc7_full": ("bc7", 0),
    "bc7_half": ("bc7", 1),
    "astc12": ("astc12", 0),
    "astc12_half": ("astc12", 1),
}
"""Name → (rule, finest mips left out)."""

# Rule → format by (kind, number of channels) of a texture.
_RULES = {
    "paper": lambda kind, count: "bc5" if kind == "normal" else "bc1",
    "bc7": lambda kind, count: "bc5" if kind == "normal" else {1: "bc4", 2: "bc5"}.get(count, "bc7"),
    "astc12": lambda kind, count: "astc12",
}

_BLOCK = {"bc1": (4, 8), "bc4": (4, 8), "bc5": (4, 16), "bc7": (4, 16), "astc12": (12, 16)}  # side [texel], bytes

THOROUGH, EXHAUSTIVE = 98, 100
"""ASTC qualities: exhaustive gains 0.1 to 1.9 dB and takes 10 to 20 times as long, half a minute a million texels."""


@dataclasses.dataclass(frozen=True)
class Texture:
    """Which channels share a texture: their maps' names, what they are, and their numbers in the set."""

    name: str
    kind: str
    """``"colour"``, ``"normal"`` or ``"scalars"``."""
    channels: tuple[int, ...]


def pack(channels) -> list[Texture]:
    """Return how a game would pack ``channels`` (with ``map`` and ``encoding``) into textures of up to 3 channels."""
    maps: dict[str, list[int]] = {}
    for index, channel in enumerate(channels):
        maps.setdefault(channel.map, []).append(index)
    textures, scalars = [], {}
    for name, indices in maps.items():
        encoding = channels[indices[0]].encoding
        if encoding == "normal":
            textures.append(Texture(name, "normal", tuple(indices)))
        elif len(indices) > 1:
            parts = [tuple(indices[k : k + 3]) for k in range(0, len(indices), 3)]
            textures += [Texture(f"{name}.{k}" if k else name, "colour", part) for k, part in enumerate(parts)]
        else:
            scalars.setdefault(encoding, []).append(name)
    for names in scalars.values():
        names.sort(key=lambda name: ARM.index(name) if name in ARM else len(ARM))  # stable
        for k in range(0, len(names), 3):
            part = names[k : k + 3]
            textures.append(Texture("+".join(part), "scalars", tuple(maps[name][0] for name in part)))
    return textures


class Baseline:
    """A texture set under one of :data:`METHODS`; a level is encoded and decoded when it is asked for.

    Args:
        method: Name in :data:`METHODS`; ``bc_same`` needs ``written``.
        channels: The set's channels, each with ``map`` and ``encoding``.
        mips: The set's mips from the finest to 1×1, each (h, w, C) float32 in [0, 1], encoded.
        wrap: How the sampler sees past the edge when mip 0 is made from half resolution: repeat, clamp or mirror.
        astc_quality: 0 to 100, as :data:`THOROUGH`.
        written: The textures of a material's config (name, format, planes), for ``bc_same``.

    Raises:
        ValueError: If the method is unknown, or needs textures and has none.
        ImportError: If an encoder is missing; names the extra that brings it.
    """

    def __init__(
        self, method: str, channels, mips, *, wrap: str = "repeat", astc_quality: int = THOROUGH, written=None
    ):
        if method not in METHODS:
            raise ValueError(f"method must be one of {', '.join(METHODS)}, got {method!r}")
        if method == "bc_same" and written is None:
            raise ValueError("bc_same is for a material that writes BC textures; name another baseline")
        rule, self._dropped = METHODS[method]
        self.method, self.mips, self.wrap = method, mips, wrap
        self._dropped = min(self._dropped, len(mips) - 1)
        if method == "bc_same":
            self.textures, self.formats = _written(written)
        else:
            self.textures = pack(channels)
            self.formats = {t.name: _RULES[rule](t.kind, len(t.channels)) for t in self.textures}
        self._round_trips = {t.name: _round_trip(self.formats[t.name], t.kind, astc_quality) for t in self.textures}

    @property
    def bytes(self) -> int:
        """Size of all textures with all their mips, in whole blocks."""
        sizes = [mip.shape[:2] for mip in self.mips[self._dropped :]]
        return sum(texture_bytes(format, sizes) for format in self.formats.values())

    def level(self, mip: int) -> np.ndarray:
        """Return what a sampler reads at the texel centres of the reference's level ``mip``, (h, w, C) float32.

        Where that level is not stored, it is the finest stored one, filtered bilinearly.
        """
        height, width = self.mips[mip].shape[:2]
        stored = self.mips[max(mip, self._dropped)]
        result = np.empty((height, width, stored.shape[2]), np.float32)
        for texture in self.textures:
            part = self._round_trips[texture.name](stored[..., texture.channels])
            result[..., texture.channels] = upsample(part, height, width, self.wrap)
        return result


def _written(textures) -> tuple[list[Texture], dict[str, str]]:
    """Return the textures of an ntbc's config and their formats; BC3 counts as a BC1 and a BC4."""
    found, formats = [], {}
    for texture in textures:
        family, planes = texture["format"].partition("_")[0], texture["planes"]
        parts = planes if family == "bc3" else [{"channels": [k for plane in planes for k in plane["channels"]]}]
        for n, part in enumerate(parts):
            name = f"{texture['name']}.{n}" if n else texture["name"]
            found.append(Texture(name, "blocks", tuple(part["channels"])))
            formats[name] = part.get("format", family)
    return found, formats


def texture_bytes(format: str, sizes) -> int:
    """Return the bytes of a texture whose levels have the given (height, width), each in whole blocks."""
    side, size = _BLOCK[format]
    return sum(-(-height // side) * -(-width // side) * size for height, width in sizes)


def upsample(pixels: np.ndarray, height: int, width: int, wrap: str = "repeat") -> np.ndarray:
    """Return ``pixels`` (h, w, k) sampled bilinearly at the texel centres of a (height, width) grid.

    Texel i lies at (i + 0.5)/w; ``wrap`` is repeat, clamp or mirror.
    """
    if pixels.shape[:2] == (height, width):
        return pixels
    for axis, size in enumerate((height, width)):
        low, high, weight = _taps(pixels.shape[axis], size, wrap)
        weight = weight.reshape((-1, 1, 1) if axis == 0 else (1, -1, 1))
        first, second = np.take(pixels, low, axis), np.take(pixels, high, axis)
        pixels = first + weight * (second - first)
    return pixels


def _taps(source: int, target: int, wrap: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    position = (np.arange(target) + 0.5) * (source / target) - 0.5
    low = np.floor(position).astype(np.int64)
    weight = (position - low).astype(np.float32)
    return _wrapped(low, source, wrap), _wrapped(low + 1, source, wrap), weight


def _wrapped(index: np.ndarray, size: int, wrap: str) -> np.ndarray:
    if wrap == "repeat":
        return index % size
    if wrap == "clamp":
        return np.clip(index, 0, size - 1)
    if wrap == "mirror":
        index = index % (2 * size)
        return np.where(index < size, index, 2 * size - 1 - index)
    raise ValueError(f"wrap must be repeat, clamp or mirror, got {wrap!r}")


def _package(module: str, package: str):
    try:
        return importlib.import_module(module)
    except ImportError as error:
        if (error.name or "").split(".")[0] != module.split(".")[0]:
            raise
        message = f"{package} is not installed, which encodes the baselines; pip install 'warp-neumat[bench]' brings it"
        raise ImportError(message) from None


def _round_trip(format: str, kind: str, astc_quality: int):
    """Return ``f(pixels (h, w, k)) -> (h, w, k)``, encoding and decoding; a missing package shows here."""
    if format == "astc12":
        return functools.partial(_astc, _astc_context(kind == "normal", astc_quality), kind == "normal")
    encode, decode = _bc_coder(format)

    def round_trip(pixels):
        height, width, count = pixels.shape
        padded, size = _rgba8(pixels)
        data = decode(encode(padded, *size), *size)
        bgra = np.frombuffer(data, np.uint8).reshape(size[1], size[0], 4)
        return bgra[:height, :width, [2, 1, 0, 3]][..., :count].astype(np.float32) / np.float32(255)

    return round_trip


def _rgba8(pixels: np.ndarray) -> tuple[bytes, tuple[int, int]]:
    """Return 8-bit RGBA rows of whole blocks, edges repeated, and (width, height); one channel becomes grey."""
    height, width, count = pixels.shape
    rgba = np.zeros((-(-height // 4) * 4, -(-width // 4) * 4, 4), np.uint8)
    rgba[..., 3] = 255
    values = np.rint(np.clip(pixels, 0, 1) * 255).astype(np.uint8)
    values = np.pad(values, ((0, len(rgba) - height), (0, rgba.shape[1] - width), (0, 0)), mode="edge")
    rgba[..., : 3 if count == 1 else count] = values
    return rgba.tobytes(), (rgba.shape[1], rgba.shape[0])


@functools.cache
def _bc_coder(format: str):
    """Return ``encode(rgba, width, height) -> blocks`` and ``decode(blocks, width, height) -> bgra`` of a BC format."""
    decode = getattr(_package("texture2ddecoder", "texture2ddecoder"), f"decode_{format}")
    if format == "bc7":
        etcpak = _package("etcpak", "etcpak")
        parameters = etcpak.BC7CompressBlockParams()
        parameters.init_linear_weights()
        parameters.m_uber_level, parameters.m_max_partitions = 4, 64
        parameters.m_mode17_partition_estimation_filterbank = False
        return lambda rgba, width, height: etcpak.compress_bc7(rgba, width, height, parameters), decode
    quicktex = _package("quicktex", "quicktex")
    codec = importlib.import_module(f"quicktex.s3tc.{format}")
    if format == "bc1":
        encoder = codec.BC1Encoder(18, codec.BC1Encoder.ColorMode.ThreeColor)
    else:
        encoder = codec.BC4Encoder(0) if format == "bc4" else codec.BC5Encoder(0, 1)

    def encode(rgba, width, height):
        return encoder.encode(quicktex.RawTexture.frombytes(rgba, width, height)).tobytes()

    return encode, decode


@functools.cache
def _astc_context(normal: bool, quality: int):
    astc = _package("astc_encoder", "astc-encoder-py")
    flags = astc.ASTCConfigFlags.MAP_NORMAL if normal else 0
    config = astc.ASTCConfig(astc.ASTCProfile.LDR, 12, 12, 1, quality, flags)
    return astc.ASTCContext(config, os.cpu_count() or 1)


def _astc(context, normal: bool, pixels: np.ndarray) -> np.ndarray:
    astc = _package("astc_encoder", "astc-encoder-py")
    height, width, count = pixels.shape
    rgba = np.ones((height, width, 4), np.float32)
    rgba[..., :count] = pixels
    order = "rrrg" if normal else {1: "rrr1", 2: "rg01", 3: "rgb1"}[count]
    picture = astc.ASTCImage(astc.ASTCType.F32, width, height, 1, rgba.tobytes())
    data = context.compress(picture, _swizzle(astc, order))
    back = _swizzle(astc, "ra01" if normal else "rgba")
    decoded = context.decompress(data, astc.ASTCImage(astc.ASTCType.F32, width, height), back)
    return np.frombuffer(decoded.data, np.float32).reshape(height, width, 4)[..., :count]


def _swizzle(astc, order: str):
    """Return ``order`` as the package's swizzle: of a copy, as it writes capitals into the very string it is given."""
    return astc.ASTCSwizzle.from_str(order.encode().decode())
