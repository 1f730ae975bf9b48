"""What decides the shape of an NTBC material and how it is trained: planes, networks, grids, and how many bytes.

A *plane* is what one kind of block holds (BC1: three channels, BC4: one, BC7: three or four); a *texture* is one or two
planes (BC5 is two of BC4); a *model* is the pair of networks that writes some planes (paper [ntbc], §3.4 and §4.1).
"""

from __future__ import annotations

import dataclasses
import difflib
import math

from warp_neumat.io.asset import packed_bytes
from warp_neumat.io.block_formats import mip_bytes, mip_limit
from warp_neumat.kernels.ntbc import MOST_NUMBERS
from warp_neumat.kernels.ntbc_network import NetworkShape
from warp_neumat.kernels.ntbc_train import StepShape

MODES = {"conservative": 0.64, "aggressive": 0.32}
"""Mode → share of the bytes of the textures that it writes, all mips, which its grids and networks may take."""

PALETTE = {"bc1": 4, "bc4": 8, "bc7": 16}
"""Entries of a plane's palette, by its format."""

COARSEST = 16
"""Longer side of the coarsest level (NTBC §3.4)."""

PAPER = {"texel": 1 / 2, "endpoint": 1 / 4}
"""Finest levels of the paper, as fractions of the texture: 2,048 and 1,024 of its 4,096²."""

LEAST_BITS = 4
"""Of a feature where every texel has a vertex of its own; below, coarser grids of 8 bits are worth more."""

FINEST = 0.71
"""Of grids that have no vertex for every texel: beyond, four bits a feature buy one."""

ENDPOINT_SHARE = 0.25
"""Of the bytes of a model's grids, what those of the endpoint network may take at most."""

HIDDEN = (64, 64, 64)


@dataclasses.dataclass(frozen=True)
class Plane:
    """What one kind of block holds: its format, and the numbers of its channels in the set."""

    format: str
    """``bc1``, ``bc4`` or ``bc7``."""
    channels: tuple[int, ...]
    """A BC1 of two channels holds a normal; its third component is z."""

    @property
    def components(self) -> int:
        """Numbers that the networks predict for a colour."""
        return 3 if self.format == "bc1" else len(self.channels)


@dataclasses.dataclass(frozen=True)
class Texture:
    """A texture that is written: name, a key of :data:`warp_neumat.io.block_formats.FORMATS`, planes."""

    name: str
    format: str
    planes: tuple[Plane, ...]


@dataclasses.dataclass(frozen=True)
class Grids:
    """The feature grids of a network."""

    levels: tuple[tuple[int, int], ...]
    """(width, height), coarsest first."""
    features: int = 2
    """Of a vertex. Paper: 2."""
    bits: int = 8
    """Of a stored feature. Paper: 8."""

    @property
    def bytes(self) -> int:
        """Size as stored, with the scale and zero of every level."""
        return sum(packed_bytes(w * h * self.features, self.bits) + 6 for w, h in self.levels)

    def shape(self, outputs: int, hidden: tuple[int, ...]) -> NetworkShape:
        """Return the network behind these grids."""
        return NetworkShape(self.levels, outputs, hidden, self.features)


@dataclasses.dataclass(frozen=True)
class Model:
    """A pair of networks and the planes that it writes, as (texture, plane) numbers."""

    planes: tuple[tuple[int, int], ...]
    texel: Grids
    endpoint: Grids


@dataclasses.dataclass(frozen=True)
class NTBCConfig:
    """Everything that decides the shape of an NTBC material and how it is trained; defaults are the measured best."""

    width: int
    """Of the textures [texel]."""
    height: int
    channels: tuple[dict, ...]
    """The set's channels; see :class:`warp_neumat.io.texture_set.Channel`."""
    constants: dict
    """Maps kept as scalars."""
    textures: tuple[Texture, ...]
    """What is written."""
    models: tuple[Model, ...]
    """What writes it."""
    mode: str = "conservative"
    """``conservative``: one model for colours and one for single channels; ``aggressive``: one for all (§4.1)."""
    variant: str = "ntbc"
    """``ntbc``: the texel network predicts colours (§3.2); ``naive``: weights (§3.1)."""
    endpoints: str = "fitted"
    """``fitted``: to the predicted colours, at load, without a second network; ``network``: predicted, as in the paper.
    In the same bytes the first keeps 1.4 to 2.5 dB more (docs/papers.md). The naive variant has its network."""
    metric: str = "rgb"
    """What a colour's squared error is measured in: ``rgb`` (paper) or ``luma``, luminance and chrominance."""
    wrap: str = "repeat"
    """``repeat``, ``clamp`` or ``mirror``, as the sampler will be set; grids always repeat."""
    hidden: tuple[int, ...] = HIDDEN
    """Widths of the hidden layers. Paper: 3 × 64."""
    temperature: float = 0.01
    """T of the softmax of Eq. 13."""
    joint: float = 0.5
    """Share of the steps, the last ones, in which both networks see what they write together. Paper: 0."""
    quantised: float = 0.5
    """Share of the steps, the last ones, with grids rounded as they are stored. Paper: 1/11, "10 % more steps"."""
    rates: tuple[float, float] = (0.01, 0.01)
    """Learning rates of grids and of networks at the beginning. Paper: 0.01, 0.005."""

    def __post_init__(self):
        _check(self)

    @property
    def rows(self) -> int:
        """Rows of blocks of the finest mip."""
        return -(-self.height // 4)

    @property
    def columns(self) -> int:
        """Columns of blocks."""
        return -(-self.width // 4)

    @property
    def block_bytes(self) -> int:
        """Size of the textures that are written, all mips."""
        return block_bytes(self.textures, self.width, self.height)

    @property
    def bytes(self) -> int:
        """Size of the grids and networks as stored."""
        total = 0
        for model in self.models:
            shape = self.shape(model)
            pairs = [(model.texel, shape.texel)]
            if self.endpoints == "network":
                pairs.append((model.endpoint, shape.endpoint))
            total += sum(grids.bytes + _network_bytes(net.inputs, net.hidden, net.outputs) for grids, net in pairs)
        return total

    def planes(self, model: Model) -> tuple[Plane, ...]:
        """Return the planes that a model writes."""
        return tuple(self.textures[t].planes[p] for t, p in model.planes)

    def shape(self, model: Model) -> StepShape:
        """Return what a model's training kernel is compiled for."""
        planes = self.planes(model)
        count = sum(plane.components for plane in planes)
        naive = self.variant == "naive"
        return StepShape(
            model.endpoint.shape(2 * count, self.hidden),
            model.texel.shape(len(planes) if naive else count, self.hidden),
            tuple((PALETTE[plane.format], plane.components) for plane in planes),
            naive,
        )


def _within(value, low: float, high: float) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and low <= value <= high


def _check(config: NTBCConfig) -> None:
    rules = {
        "mode": (config.mode in MODES, f"must be {' or '.join(MODES)}"),
        "variant": (config.variant in ("ntbc", "naive"), "must be ntbc or naive"),
        "endpoints": (config.endpoints in ("network", "fitted"), "must be network or fitted"),
        "metric": (config.metric in ("rgb", "luma"), "must be rgb or luma"),
        "wrap": (config.wrap in ("repeat", "clamp", "mirror"), "must be repeat, clamp or mirror"),
        "temperature": (_within(config.temperature, 1e-4, 1.0), "must lie in 0.0001 … 1"),
        "joint": (_within(config.joint, 0.0, 1.0), "must lie in 0 … 1"),
        "quantised": (_within(config.quantised, 1e-6, 1.0), "must be above 0, at most 1"),
        "rates": (
            len(config.rates) == 2 and all(_within(r, 1e-6, 1.0) for r in config.rates),
            "must be two numbers in 0 … 1",
        ),
        "hidden": (
            1 <= len(config.hidden) <= 4 and all(h in range(8, 129, 8) for h in config.hidden),
            "must be one to four multiples of 8 up to 128",
        ),
    }
    for name, (good, rule) in rules.items():
        if not good:
            raise ValueError(f"{name} {rule}, got {getattr(config, name)!r}")
    if config.variant == "naive" and config.endpoints == "fitted":
        raise ValueError("endpoints must be network for variant naive, which predicts no colours to fit them to")


def block_bytes(textures, width: int, height: int) -> int:
    """Return the bytes of textures with all their mips."""
    return sum(mip_bytes(t.format, width, height, m) for t in textures for m in range(mip_limit(width, height)))


def levels(width: int, height: int, fraction: float) -> tuple[tuple[int, int], ...]:
    """Return (width, height) of the levels of grids whose finest is ``fraction`` of a texture's sides, coarsest first.

    Each is half the next, down to a longer side of about :data:`COARSEST`, as the paper's are.
    """
    found, longest = [], max(width, height)
    while not found or fraction * longest >= 0.75 * COARSEST:
        found.append(tuple(max(1, round(side * fraction)) for side in (width, height)))
        fraction /= 2
    return tuple(found[::-1])


def _network_bytes(inputs: int, hidden: tuple[int, ...], outputs: int) -> int:
    """Return the bytes of a network's weights in float16."""
    widths = (inputs, *hidden, outputs)
    return sum(2 * (a * b + b) for a, b in zip(widths[:-1], widths[1:], strict=True))


@dataclasses.dataclass(frozen=True)
class _Budget:
    """What the grids and weights of a network may take, and what decides that."""

    size: tuple[int, int]
    """Of the texture in whole blocks, which is what networks see."""
    outputs: int
    hidden: tuple[int, ...]
    bytes: float

    def grids(self, fraction: float, bits: int = 8) -> Grids:
        """Return grids whose finest level is ``fraction`` of the texture."""
        return Grids(levels(*self.size, fraction), 2, bits)

    def cost(self, grids: Grids) -> int:
        """Return the bytes of grids and weights."""
        return grids.bytes + _network_bytes(2 * len(grids.levels), self.hidden, self.outputs)

    def least(self) -> Grids:
        """Return the smallest grids."""
        return self.grids(min(1.0, COARSEST / max(self.size)))

    def finest(self, most: float) -> Grids | None:
        """Return the finest 8-bit grids that fit, up to a fraction of ``most``; None if none does."""
        low, high = min(most, COARSEST / max(self.size)), most
        if self.cost(self.grids(most)) <= self.bytes:
            return self.grids(most)
        found = self.grids(low)
        if self.cost(found) > self.bytes:
            return None
        for _ in range(32):  # bytes grow with the fraction
            middle = 0.5 * (low + high)
            grids = self.grids(middle)
            if self.cost(grids) <= self.bytes:
                found, low = grids, middle
            else:
                high = middle
        return found

    def best(self) -> Grids | None:
        """Return the grids of a texel network that are worth most; None if not even the smallest fit.

        A vertex for every texel, with as many bits as fit, if that is at least :data:`LEAST_BITS`; else as fine as fits
        at 8 bits (measured; ``docs/papers.md``).
        """
        for bits in range(8, LEAST_BITS - 1, -1):
            if self.cost(self.grids(1.0, bits)) <= self.bytes:
                return self.grids(1.0, bits)
        return self.finest(FINEST)


def _model(planes, config: dict, rate: float | None) -> Model:
    """Return the model that writes ``planes``, of (texture, plane) numbers, in a share of their bytes.

    Without a rate grids are as fine as the paper's, whatever that takes.
    """
    width, height, hidden = config["width"], config["height"], config["hidden"]
    members = [config["textures"][t].planes[p] for t, p in planes]
    numbers = sum(plane.components for plane in members)
    size = 4 * -(-width // 4), 4 * -(-height // 4)
    if size[0] * size[1] * numbers >= MOST_NUMBERS:
        raise ValueError(
            f"{width}x{height} with {numbers} channels in one model has {size[0] * size[1] * numbers} numbers, of at "
            f"most {MOST_NUMBERS - 1}; use mode=conservative, or fit to a part of the maps"
        )
    ends = _Budget(size, 2 * numbers, hidden, 0.0)
    texels = _Budget(size, len(members) if config["variant"] == "naive" else numbers, hidden, 0.0)
    if rate is None:
        return Model(tuple(planes), texels.grids(PAPER["texel"]), ends.grids(PAPER["endpoint"]))
    blocks = sum(mip_bytes(f"{plane.format}_unorm", width, height, m) for plane in members for m in _mips(config))
    budget, fitted = rate * blocks, config["endpoints"] == "fitted"
    weights = 0 if fitted else ends.cost(ends.least()) - ends.least().bytes
    spent = weights + texels.cost(texels.least()) - texels.least().bytes
    endpoint = ends.least()
    if not fitted:
        share = ENDPOINT_SHARE * (budget - spent)
        endpoint = dataclasses.replace(ends, bytes=weights + share).finest(PAPER["endpoint"])
        budget -= ends.cost(endpoint) if endpoint else 0
    texel = dataclasses.replace(texels, bytes=budget).best() if endpoint else None
    if texel is None:
        least = texels.cost(texels.least()) + (0 if fitted else ends.cost(ends.least()) / ENDPOINT_SHARE)
        raise ValueError(
            f"{_asked(config, rate)} is too little for {width}x{height}: the networks alone take {spent} of {blocks} "
            f"bytes; give at least rate={math.ceil(100 * least / blocks) / 100:g}, or fit to a larger part of the maps"
        )
    return Model(tuple(planes), texel, endpoint)


def _asked(config: dict, rate: float) -> str:
    return f"rate={rate:g}" if config.get("bytes") is None else f"bytes={config['bytes']}"


def _mips(config: dict) -> range:
    return range(mip_limit(config["width"], config["height"]))


def _textures(source, normals: str, colours: str) -> tuple[Texture, ...]:
    """Return the textures that a set's maps are written to: BC1 or BC7 for colours, BC5 for pairs, BC4 for the rest."""
    maps: dict[str, list[int]] = {}
    for number, channel in enumerate(source.channels):
        maps.setdefault(channel.map, []).append(number)
    found = []
    for name, own in maps.items():
        suffix = "_srgb" if source.channels[own[0]].encoding == "srgb" else "_unorm"
        single = [Plane("bc4", (k,)) for k in own]
        if len(own) == 1:
            found.append(Texture(name, "bc4_unorm", tuple(single)))
        elif len(own) == 2 and normals == "bc1" and source.channels[own[0]].encoding == "normal":
            found.append(Texture(name, "bc1_unorm", (Plane("bc1", tuple(own)),)))
        elif len(own) == 2:
            found.append(Texture(name, "bc5_unorm", tuple(single)))
        elif colours == "bc7":
            found.append(Texture(name, f"bc7{suffix}", (Plane("bc7", tuple(own)),)))
        elif len(own) == 3:
            found.append(Texture(name, f"bc1{suffix}", (Plane("bc1", tuple(own)),)))
        else:
            found.append(Texture(name, f"bc3{suffix}", (Plane("bc1", tuple(own[:3])), single[3])))
    return tuple(found)


def configure(source, options: dict, preset: str | None = None) -> NTBCConfig:
    """Return the configuration for a texture set.

    Args:
        source: As :func:`warp_neumat.io.texture_set.open_texture_set` returns it.
        options: Fields of :class:`NTBCConfig`, and

            - ``mode``: ``conservative`` or ``aggressive``;
            - ``rate``: share of the bytes of the textures, all mips, that the file may take, between the modes' or
              beyond; ``paper``: grids as fine and as deep as the paper's, whatever they take. Default: the mode's, or
              the paper's grids where maps are so small that the networks alone take more;
            - ``bytes``: the same in bytes;
            - ``normals``: ``bc5`` or, as in the paper, ``bc1``; ``colours``: ``bc1`` or ``bc7``.
        preset: None; a length of training is the caller's.

    Raises: ValueError: If an option is unknown or out of range, or the set has no channel to learn.
    """
    own = {"mode", "rate", "bytes", "normals", "colours"}
    derived = {"width", "height", "channels", "constants", "textures", "models"}
    known = own | {f.name for f in dataclasses.fields(NTBCConfig)} - derived
    for name in options:
        if name not in known:
            close = difflib.get_close_matches(name, known, n=1)
            nearest = f"nearest: {close[0]}; " if close else ""
            raise ValueError(f"no option {name!r} of ntbc; {nearest}known: {', '.join(sorted(known))}")
    if not source.channels:
        raise ValueError(f"{source.name}: every map is constant, so there is nothing to learn; a renderer can use them")
    if preset is not None:
        raise ValueError(f"ntbc has no preset of sizes; give a mode or a rate, got {preset!r}")
    options = dict(options)
    for name, choices in (("normals", ("bc5", "bc1")), ("colours", ("bc1", "bc7"))):
        if options.get(name, choices[0]) not in choices:
            raise ValueError(f"{name} must be {' or '.join(choices)}, got {options[name]!r}")
    textures = _textures(source, options.pop("normals", "bc5"), options.pop("colours", "bc1"))
    for name in ("hidden", "rates"):
        if name in options:
            options[name] = tuple(options[name]) if isinstance(options[name], (list, tuple)) else (options[name],)
    config = {
        "width": source.width,
        "height": source.height,
        "channels": tuple(
            {"map": c.map, "component": c.component, "encoding": c.encoding, "range": [float(v) for v in c.range]}
            for c in source.channels
        ),
        "constants": {name: [float(v) for v in values] for name, values in source.constants.items()},
        "textures": textures,
        "mode": "conservative",
        "endpoints": "network" if options.get("variant") == "naive" else "fitted",
        "variant": "ntbc",
        "hidden": HIDDEN,
        **options,
    }
    rate = _rate(config)
    _check(NTBCConfig(**{k: v for k, v in config.items() if k not in ("rate", "bytes")}, models=()))
    every = [(t, p) for t, texture in enumerate(textures) for p in range(len(texture.planes))]
    colours = [(t, p) for t, p in every if textures[t].planes[p].format != "bc4"]
    groups = [every] if config["mode"] == "aggressive" else [colours, [pair for pair in every if pair not in colours]]
    try:
        models = tuple(_model(group, config, rate) for group in groups if group)
    except ValueError:
        if config.get("rate") is not None or config.get("bytes") is not None:
            raise
        # Of small maps the networks alone take more than a mode's share: the paper's grids then, which cost little.
        models = tuple(_model(group, config, None) for group in groups if group)
    return NTBCConfig(**{k: v for k, v in config.items() if k not in ("rate", "bytes")}, models=models)


def _rate(config: dict) -> float | None:
    """Return the share of the textures' bytes that was asked for, None for the paper's grids."""
    if config["mode"] not in MODES:
        raise ValueError(f"mode must be {' or '.join(MODES)}, got {config['mode']!r}")
    rate, count = config.get("rate"), config.get("bytes")
    if rate is not None and count is not None:
        raise ValueError("give rate or bytes, not both")
    if count is not None:
        if isinstance(count, bool) or not isinstance(count, int) or count < 1:
            raise ValueError(f"bytes must be a whole number above 0, got {count!r}")
        return count / block_bytes(config["textures"], config["width"], config["height"])
    if rate == "paper":
        return None
    rate = MODES[config["mode"]] if rate is None else rate
    if isinstance(rate, bool) or not isinstance(rate, (int, float)) or not 0.0 < rate <= 4.0:
        raise ValueError(f"rate must lie above 0, at most 4, or be paper, got {rate!r}")
    return float(rate)
