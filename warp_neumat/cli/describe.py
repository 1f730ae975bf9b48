"""What ``neumat info`` prints of an asset below its first line."""

import math

from warp_neumat.io.block_formats import mip_bytes, mip_limit


def describe(header: dict, tensors: dict) -> list[str]:
    """Return the lines of an asset's header and tensors (name → dtype, shape, bytes), by kind."""
    if header["kind"] == "btf":
        return _btf(header, tensors)
    makers = {"bcf": _features, "ntbc": _blocks}
    config = header.get("config", {})
    if header["kind"] in makers:
        lines = [_material(config, tensors), *makers[header["kind"]](config, tensors), *_channels(config)]
    else:
        lines = _fields(header, "config")
    for part in ("group", "source", "training", "metrics"):
        lines += _fields(header, part)
    for name, file in header.get("maps", {}).get("files", {}).items():
        lines.append(f"  maps.{name}: {file}")
    lines += [f"  note: {note}" for note in header.get("maps", {}).get("notes", [])]
    if header["kind"] not in makers:
        lines += [f"  {name}: {t['dtype']} {t['shape']}, {t['bytes']} bytes" for name, t in tensors.items()]
    return lines


def _fields(header: dict, part: str) -> list[str]:
    found = header.get(part, {}).items()
    return [
        f"  {part}.{key}: {value:.6g}" if isinstance(value, float) else f"  {part}.{key}: {value}"
        for key, value in found
        if value is not None
    ]


def _btf(header: dict, tensors: dict) -> list[str]:
    """Return what a btf is made of: size, networks from input to output, textures; where it comes from; how close."""
    config, source, training = header["config"], header.get("source", {}), header.get("training", {})
    width, height, angles = config["width"], config["height"], 9 if config["half_vector"] else 6
    size = sum(t["bytes"] for t in tensors.values())
    lines = [f"  material: {width}×{height}, {config['mips']} mips, {8 * size / (width * height):.4g} bit/texel"]
    coarse, fine = config["coarse"], config["fine"]
    nets = {"fine": [(coarse["latent"] if coarse else angles) + fine["channels"], *fine["hidden"], 3]}
    if coarse:
        nets = {"coarse": [angles + coarse["channels"], *coarse["hidden"], coarse["latent"]]} | nets
    for name, widths in nets.items():
        own = {key: sum(t["bytes"] for n, t in tensors.items() if n.startswith(f"{name}.{key}")) for key in _PARTS}
        weights = sum(i * o + o for i, o in zip(widths[:-1], widths[1:], strict=True))
        lines.append(
            f"  {name}: {'→'.join(map(str, widths))}, {weights} weights, {own['weight'] + own['bias']} bytes; "
            f"{config[name]['channels']} features a texel, {config['features']}, {own['mip'] + own['block']} bytes"
        )
    if "spec" in source:
        lines.append(f"  source: {source['spec']}")
    taught = training.get("teacher")
    if isinstance(taught, dict):
        lines.append("  teacher: " + ", ".join(f"{k} {_short(v)}" for k, v in taught.items()))
    history = training.get("test_l1") or []
    if history:
        lines.append(f"  test l1: {_short(history[0])} → {_short(history[-1])} [1/sr] in {len(history)} epochs")
    kept = {k: v for k, v in training.items() if k not in ("teacher", "test_l1")}
    for part, fields in (("training", kept), ("metrics", header.get("metrics", {}))):
        lines += [f"  {part}.{name}: {_short(value)}" for name, value in fields.items() if value is not None]
    return lines + [f"  note: {note}" for note in source.get("notes", [])]


_PARTS = ("weight", "bias", "mip", "block")
"""How names of a network's tensors go on after its own."""


def _short(value) -> str:
    if isinstance(value, (list, tuple)):
        return ", ".join(map(_short, value))
    if isinstance(value, dict):
        return ", ".join(f"{name} {_short(part)}" for name, part in value.items())
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _material(config: dict, tensors: dict) -> str:
    """Return the size of a set of maps, and what a texel of a channel takes."""
    width, height, channels = config["width"], config["height"], config["channels"]
    bits = 8 * sum(t["bytes"] for t in tensors.values()) / (width * height * len(channels))
    size = f"{width}×{height}, {len(channels)} channels, wrap {config['wrap']}"
    return f"  material: {size}, {bits:.3g} bit/texel/channel"


def _features(config: dict, tensors: dict) -> list[str]:
    """Return what a bcf is made of: textures with their mips, and the network."""
    lines = []
    for number, texture in enumerate(config["textures"]):
        size = sum(t["bytes"] for name, t in tensors.items() if name.startswith(f"texture{number}.mip"))
        level = max(0.0, math.log2(max(config["width"] / texture["width"], config["height"] / texture["height"])))
        kind = "bc6h_sf16" if config["signed"] else "bc6h_uf16"
        lines.append(
            f"  texture{number}: {kind} {texture['width']}×{texture['height']}, {texture['mips']} mips, {size} bytes, "
            f"sharp from mip {level:.3g} of the material on"
        )
    hidden, size = config["hidden"], sum(t["bytes"] for name, t in tensors.items() if not name.startswith("texture"))
    widths = f"{3 * len(config['textures'])}→{hidden}→{len(config['channels'])}"
    return [*lines, f"  network: {widths}, float16, {size} bytes"]


def _blocks(config: dict, tensors: dict) -> list[str]:
    """Return what an ntbc is made of: the textures that it writes, and the networks of each model."""
    names = [f"{channel['map']}.{channel['component']}" for channel in config["channels"]]
    width, height = config["width"], config["height"]
    fields = ("mode", "variant", "endpoints", "metric")
    lines = ["  " + ", ".join(f"{name} {config[name]}" for name in fields)]
    total = 0
    for texture in config["textures"]:
        held = ", ".join(names[k] for plane in texture["planes"] for k in plane["channels"])
        mips = mip_limit(width, height)
        size = sum(mip_bytes(texture["format"], width, height, mip) for mip in range(mips))
        total += size
        lines.append(f"  texture {texture['name']}: {texture['format']}, {mips} mips, {size} bytes ({held})")
    stored = sum(t["bytes"] for t in tensors.values())
    lines.append(f"  textures: {total} bytes at load, {stored} here: {stored / total:.1%}")
    for i, model in enumerate(config["models"]):
        planes = [config["textures"][t]["planes"][p]["format"] for t, p in model["planes"]]
        lines.append(f"  model{i}: {len(planes)} planes ({', '.join(planes)})")
        for network in ("endpoint", "texel"):
            if model[network] is None:
                continue
            parts = {n: t for n, t in tensors.items() if n.startswith(f"model{i}.{network}.")}
            grids = sum(t["bytes"] for n, t in parts.items() if ".grid" in n)
            rest = sum(t["bytes"] for t in parts.values()) - grids
            levels = model[network]["levels"]
            sizes = " … ".join("×".join(map(str, levels[k])) for k in sorted({0, len(levels) - 1}))
            outputs = parts[f"model{i}.{network}.bias{len(config['hidden'])}"]["shape"][0]
            features, bits = model[network].get("features", 2), model[network].get("bits", 8)
            widths = "→".join(map(str, [features * len(levels), *config["hidden"], outputs]))
            kept = f"{len(levels)} grids {sizes} of {features} features in {bits} bits, {grids} bytes"
            lines.append(f"    {network}: {kept}; {widths}, {rest} bytes")
    return lines


def _channels(config: dict) -> list[str]:
    """Return the maps of a set and their constants."""
    lines, maps = [], {}
    for channel in config["channels"]:
        maps.setdefault(channel["map"], []).append(channel)
    for name, own in maps.items():
        parts = " ".join(channel["component"] for channel in own)
        low, high = min(c["range"][0] for c in own), max(c["range"][1] for c in own)
        spread = "" if (low, high) == (0, 1) else f", {low:.4g} … {high:.4g}"
        lines.append(f"  {name}: {parts} ({own[0]['encoding']}{spread})")
    for name, values in config.get("constants", {}).items():
        lines.append(f"  {name}: constant {' '.join(f'{v:.4g}' for v in values)}")
    return lines
