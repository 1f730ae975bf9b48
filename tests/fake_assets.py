"""Assets with random contents, for tests of what a material computes rather than of how well it was fitted."""

import copy
import zlib

import numpy as np

from warp_neumat.io.asset import KINDS, pack_bits, write_asset
from warp_neumat.io.block_formats import BlockTexture, mip_shape
from warp_neumat.kernels.bc6h_tables import MODES


def random_neubrdf(
    rng,
    *,
    nside=8,
    features=8,
    bits=6,
    hidden=(64, 64),
    frame="isotropic",
    symmetry="none",
    interpolation="bilinear",
    keep=None,
    texture=None,
):
    """Return (tensors, header) of a NeuBRDF whose values are of order one and vary with both directions.

    Args:
        rng: Generator.
        nside, features, bits, hidden, frame, symmetry, interpolation: As in the config.
        keep: Share of the grid points that are live; None = all are, and there is no ``live``.
        texture: (width, height, channels, mips) of a neural texture.
    """
    points = 6 * nside * nside + 6 * nside + 1
    channels = texture[2] if texture else 0
    widths = (2 * features + channels, *hidden, 3)
    stored, tensors = 2 * points, {}
    if keep is not None:
        live = rng.random(2 * points) < keep
        live[[0, points]] = True  # one of each side at least
        stored = int(live.sum())
        bytes_ = zlib.compress(np.packbits(live, bitorder="little").tobytes())
        tensors["live"] = np.frombuffer(bytes_, np.uint8)
    tensors["codebook"] = rng.normal(size=(2**bits, features)).astype(np.float16)
    tensors["indices"] = pack_bits(rng.integers(0, 2**bits, stored), bits)
    for n, (i, o) in enumerate(zip(widths[:-1], widths[1:], strict=True)):
        tensors[f"weight{n}"] = (rng.normal(size=(o, i)) * np.sqrt(1.5 / i)).astype(np.float16)
        tensors[f"bias{n}"] = np.full(o, 0.2, np.float16)
    config = {"nside": nside, "features": features, "bits": bits, "hidden": list(hidden), "frame": frame}
    config |= {"interpolation": interpolation, "symmetry": symmetry, "output": "expm1", "texture": None}
    if texture:
        config["texture"] = dict(zip(("width", "height", "channels", "mips"), texture, strict=True))
        for m in range(texture[3]):
            shape = (max(1, texture[1] >> m), max(1, texture[0] >> m), channels)
            tensors[f"texture.mip{m}"] = rng.normal(size=shape).astype(np.float16)
    return tensors, {"kind": "neubrdf", "version": KINDS["neubrdf"], "config": config}


CHANNELS = [
    *({"map": "base_color", "component": c, "encoding": "srgb", "range": [0.0, 1.0]} for c in "rgb"),
    *({"map": "normal", "component": c, "encoding": "normal", "range": [0.0, 1.0]} for c in "xy"),
    {"map": "roughness", "component": "value", "encoding": "linear", "range": [0.0, 1.0]},
    {"map": "metallic", "component": "value", "encoding": "linear", "range": [0.0, 1.0]},
    {"map": "occlusion", "component": "value", "encoding": "linear", "range": [0.0, 1.0]},
    {"map": "displacement", "component": "value", "encoding": "linear", "range": [0.25, 0.75]},
    *({"map": "emissive", "component": c, "encoding": "srgb", "range": [0.0, 1.0]} for c in "rgb"),
    {"map": "opacity", "component": "value", "encoding": "linear", "range": [0.0, 1.0]},
    *({"map": f"mask_{k}", "component": "value", "encoding": "linear", "range": [0.0, 1.0]} for k in "abc"),
]
"""The outputs of :func:`random_bcf`, as many as it is asked for from the front."""


def random_blocks(rng, count: int, *, signed=False, modes=range(1, 15)) -> np.ndarray:
    """Return (count, 16) uint8 BC6H blocks of the listed modes: endpoints of size about 1/8 to 2, all else random.

    Stored differences are random bits, so where they are long, single endpoints go beyond.
    """
    bits = rng.integers(0, 2, (count, 128), dtype=np.uint8)
    chosen = rng.choice(list(modes), count)
    for mode in MODES:
        rows = np.flatnonzero(chosen == mode.number)
        bits[rows, : mode.mode_bits] = (mode.bits >> np.arange(mode.mode_bits)) & 1
        top = 1 << (mode.precision - 1 if signed else mode.precision)
        # The half float 1.0 lies at 15/31 of the endpoints' range, and a factor of 2 is 1/31 of it.
        ends = (rng.uniform(0.39, 0.52, (len(rows), 4, 3)) * top).astype(np.int64)
        if signed:
            ends *= rng.choice([-1, 1], ends.shape)
        for position, (channel, endpoint, bit) in enumerate(mode.fields, mode.mode_bits):
            if endpoint == 0 or not mode.transformed:
                bits[rows, position] = (ends[:, endpoint, channel] >> bit) & 1
    return np.packbits(bits, axis=1, bitorder="little")


def random_bcf(
    rng,
    *,
    size=64,
    features=(32, 16, 8, 4),
    mips=None,
    channels=9,
    hidden=16,
    signed=False,
    wrap="repeat",
    modes=range(1, 15),
    constants=None,
):
    """Return (tensors, header) of a BCf whose textures are random blocks and whose outputs vary around 1/2.

    Args:
        rng: Generator.
        size: Side of the reference material, or (width, height).
        features: Sides of the textures, or (width, height) each.
        mips: Mips of each texture; all of them by default.
        channels: Network outputs, the first so many of :data:`CHANNELS`.
        hidden: Hidden width.
        signed: Whether the blocks are BC6H_SF16.
        wrap: Wrap mode.
        modes: BC6H modes that occur.
        constants: Maps that are stored as scalars.
    """

    def pair(n):
        return (n, n) if isinstance(n, int) else tuple(n)

    tensors, textures = {}, []
    for t, (w, h) in enumerate(map(pair, features)):
        count = mips[t] if mips else max(w, h).bit_length()
        textures.append({"width": w, "height": h, "mips": count})
        for m in range(count):
            rows, columns = -(-max(1, h >> m) // 4), -(-max(1, w >> m) // 4)
            blocks = random_blocks(rng, rows * columns, signed=signed, modes=modes)
            tensors[f"texture{t}.mip{m}"] = blocks.reshape(rows, columns, 16)
    inputs = 3 * len(textures)
    tensors["weight0"] = (rng.normal(size=(hidden, inputs)) * np.sqrt(1 / inputs)).astype(np.float16)
    tensors["bias0"] = np.full(hidden, 0.2, np.float16)
    tensors["weight1"] = (rng.normal(size=(channels, hidden)) * 0.15).astype(np.float16)
    tensors["bias1"] = np.full(channels, 0.5, np.float16)
    width, height = pair(size)
    config = {
        "textures": textures, "signed": signed, "hidden": hidden, "width": width, "height": height, "wrap": wrap,
        "channels": copy.deepcopy(CHANNELS[:channels]),
        "constants": {"specular": [0.5]} if constants is None else constants,
    }  # fmt: skip
    return tensors, {"kind": "bcf", "version": 1, "config": config}


def fake_bcf(path, *, seed=0, **shape) -> dict:
    """Write a :func:`random_bcf` to ``path`` and return its header."""
    tensors, header = random_bcf(np.random.default_rng(seed), **shape)
    write_asset(path, tensors, header)
    return header


def random_btf(
    rng,
    *,
    width=32,
    height=24,
    mips=3,
    fine=16,
    hidden=(8, 8, 8),
    coarse=(14, (8, 8, 8), 8),
    half_vector=True,
    activation="hardswish",
    features="half",
):
    """Return (tensors, header) of a neural BTF whose values are mostly positive and vary with everything.

    Args:
        rng: Generator.
        width, height, mips, half_vector, activation, features: As in the config.
        fine, hidden: Channels and hidden widths of the fine network.
        coarse: (channels, hidden widths, latent) of the coarse network; None = a single level.
    """
    config = {
        "width": width, "height": height, "mips": mips, "half_vector": half_vector, "features": features,
        "fine": {"channels": fine, "hidden": list(hidden)}, "coarse": None, "activation": activation,
    }  # fmt: skip
    entering = 9 if half_vector else 6
    plans = {"fine": (fine, (entering + fine, *hidden, 3))}
    if coarse:
        channels, inner, latent = coarse
        config["coarse"] = {"channels": channels, "hidden": list(inner), "latent": latent}
        plans = {
            "fine": (fine, (latent + fine, *hidden, 3)),
            "coarse": (channels, (entering + channels, *inner, latent)),
        }
    tensors = {}
    for name, (channels, widths) in plans.items():
        for n, (i, o) in enumerate(zip(widths[:-1], widths[1:], strict=True)):
            tensors[f"{name}.weight{n}"] = (rng.normal(size=(o, i)) * np.sqrt(2.2 / i)).astype(np.float16)
            tensors[f"{name}.bias{n}"] = np.full(o, 0.6 if o == 3 else 0.2, np.float16)
        for m in range(mips):
            w, h = max(1, width >> m), max(1, height >> m)
            if name == "coarse":
                w, h = max(1, w // 2), max(1, h // 2)
            if features == "half":
                tensors[f"{name}.mip{m}"] = rng.normal(size=(h, w, channels)).astype(np.float16)
                continue
            rows, columns = -(-h // 4), -(-w // 4)
            for t in range(-(-channels // 3)):
                blocks = random_blocks(rng, rows * columns, signed=True, modes=(10,))
                tensors[f"{name}.block{t}.mip{m}"] = blocks.reshape(rows, columns, 16)
    return tensors, {"kind": "btf", "version": 1, "config": config}


def random_block_maps(rng, width, height, *, wrap="repeat"):
    """Return (textures, sources, config) of ``BlockMaps`` with nine channels of random blocks in BC1, BC5, BC7, BC4.

    The nine are the first of :data:`CHANNELS`, displacement with its range, so that every encoding occurs.
    """
    mips = max(width, height).bit_length()

    def texture(format):
        levels = [rng.integers(0, 256, mip_shape(format, width, height, m), dtype=np.uint8) for m in range(mips)]
        if format.startswith("bc7"):  # a first byte of 0 is reserved
            for level in levels:
                level[..., 0] |= 0x40
        return BlockTexture(format, width, height, [levels])

    textures = [texture("bc1_srgb"), texture("bc5_unorm"), texture("bc7_unorm"), texture("bc4_unorm")]
    sources = [(0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (2, 1), (2, 0), (2, 3), (3, 0)]
    config = {"width": width, "height": height, "wrap": wrap, "channels": copy.deepcopy(CHANNELS[:9])}
    return textures, sources, {**config, "constants": {"specular": [0.5]}}


NTBC_TEXTURES = {
    "bc1": [
        {"name": "base_color", "format": "bc1_srgb", "planes": [{"format": "bc1", "channels": [0, 1, 2]}]},
        {"name": "normal", "format": "bc5_unorm", "planes": [{"format": "bc4", "channels": [k]} for k in (3, 4)]},
        {"name": "roughness", "format": "bc4_unorm", "planes": [{"format": "bc4", "channels": [5]}]},
        {"name": "metallic", "format": "bc4_unorm", "planes": [{"format": "bc4", "channels": [6]}]},
    ],
    "bc7": [
        {"name": "base_color", "format": "bc7_srgb", "planes": [{"format": "bc7", "channels": [0, 1, 2]}]},
        {
            "name": "rest",
            "format": "bc3_unorm",
            "planes": [{"format": "bc1", "channels": [5]}, {"format": "bc4", "channels": [6]}],
        },
        {"name": "normal", "format": "bc1_unorm", "planes": [{"format": "bc1", "channels": [3, 4]}]},
    ],
}
"""Textures of :func:`random_ntbc`: what a fit makes by default, and one of everything else."""


def random_ntbc(
    rng,
    *,
    size=64,
    wrap="repeat",
    textures="bc1",
    mode="conservative",
    variant="ntbc",
    endpoints="network",
    metric="rgb",
    hidden=(16, 16, 16),
    levels=((4, 4), (8, 8), (16, 16)),
    bits=8,
):
    """Return (tensors, header) of an NTBC of seven channels whose colours and endpoints vary around 1/2.

    Args:
        rng: Generator.
        size: Side of the textures, or (width, height).
        wrap, mode, variant, endpoints, metric, hidden: As in the config.
        textures: A key of :data:`NTBC_TEXTURES`.
        levels: Sizes of the grids of each network.
        bits: Of each of their two features.
    """
    width, height = (size, size) if isinstance(size, int) else size
    listed = copy.deepcopy(NTBC_TEXTURES[textures])
    planes = [(t, p, plane) for t, texture in enumerate(listed) for p, plane in enumerate(texture["planes"])]
    colours = [plane for plane in planes if plane[2]["format"] != "bc4"]
    single = [plane for plane in planes if plane[2]["format"] == "bc4"]
    models, tensors = [], {}
    for i, served in enumerate([colours, single] if mode == "conservative" else [planes]):
        components = sum(3 if p["format"] == "bc1" else len(p["channels"]) for _, _, p in served)
        outputs = {"endpoint": 2 * components, "texel": len(served) if variant == "naive" else components}
        model = {"planes": [[t, p] for t, p, _ in served], "endpoint": None, "texel": None}
        for network in ("endpoint", "texel")[endpoints == "fitted" :]:
            name, model[network] = (
                f"model{i}.{network}",
                {"levels": [list(level) for level in levels], "features": 2, "bits": bits},
            )
            for n, (w, h) in enumerate(levels):
                codes = rng.integers(0, 1 << bits, (h, w, 2), dtype=np.uint8)
                tensors[f"{name}.grid{n}"] = pack_bits(codes, bits)
            half = 1 << (bits - 1)
            tensors[f"{name}.scale"] = (rng.uniform(0.8, 1.6, len(levels)) / half).astype(np.float32)
            tensors[f"{name}.zero"] = (half * rng.uniform(0.85, 1.1, len(levels))).astype(np.int16)
            widths = (2 * len(levels), *hidden, outputs[network])
            for n, (a, b) in enumerate(zip(widths[:-1], widths[1:], strict=True)):
                tensors[f"{name}.weight{n}"] = (rng.normal(size=(b, a)) * np.sqrt(1.4 / a)).astype(np.float16)
                tensors[f"{name}.bias{n}"] = (0.2 * rng.normal(size=b)).astype(np.float16)
        models.append(model)
    config = {
        "width": width, "height": height, "wrap": wrap, "mode": mode, "variant": variant, "endpoints": endpoints,
        "metric": metric, "channels": copy.deepcopy(CHANNELS[:7]), "constants": {"specular": [0.5]}, "textures": listed,
        "models": models, "hidden": list(hidden),
    }  # fmt: skip
    return tensors, {"kind": "ntbc", "version": 1, "config": config}


def fake_ntbc(path, *, seed=0, **shape) -> dict:
    """Write a :func:`random_ntbc` to ``path`` and return its header."""
    tensors, header = random_ntbc(np.random.default_rng(seed), **shape)
    write_asset(path, tensors, header)
    return header
