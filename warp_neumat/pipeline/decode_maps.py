"""Maps of a material back as pictures: what ``neumat decode`` writes, for tools that know no neural material.

Frames and files: row 0 on top, texel i at (i + 0.5)/W. Colours (maps that were fitted as sRGB, constant base colours
and emission) become sRGB PNG, normals +Y up (OpenGL) 0.5 + 0.5 n with all three components, all other maps PNG with the
values as they are. A map that may hold values outside [0, 1] becomes linear float EXR: its range tells, not
what it happens to hold. Names are those that texture sets are read by, so the folder opens as a source again.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from warp_neumat.io.atomic import replacing
from warp_neumat.io.image import write_exr, write_png
from warp_neumat.io.map_names import kind_of
from warp_neumat.io.mipmaps import linear_to_srgb

_CHUNK = 1 << 20  # samples that are decoded at a time


def decode_size(material, size=None, lod: float | None = None) -> tuple[tuple[int, int], float]:
    """Return the (width, height) and the mip level that :func:`decode_maps` uses where one or both are left open.

    The level defaults to that which fits the size, the size to that of the level (rounded down to a whole mip), both to
    the finest mip.
    """
    if not hasattr(material, "maps"):
        raise ValueError(f"{material.name}: a material of kind {material.kind!r} has no maps to decode")
    config = material.header["config"]
    full = config["width"], config["height"]
    if size is not None:
        size = int(size[0]), int(size[1])
        if min(size) < 1:
            raise ValueError(f"size must be at least 1x1, got {size[0]}x{size[1]}")
    if lod is None:
        ratio = 1.0 if size is None else max(f / s for f, s in zip(full, size, strict=True))
        lod = math.log2(max(ratio, 1.0))
    if not 0 <= lod <= 32:
        raise ValueError(f"lod must be between 0 (finest) and 32, got {lod}")
    if size is None:
        size = tuple(max(1, n >> math.floor(lod)) for n in full)
    return size, float(lod)


def decode_maps(material, size=None, lod: float | None = None) -> dict[str, np.ndarray]:
    """Return every map of a material as a picture, {name: (H, W, k) float32}, linear values, normals unit (H, W, 3).

    Args:
        material: With ``maps(uv, lod)`` and the config's width and height, as a BCf.
        size: (width, height) of the pictures; default: that of the mip, see :func:`decode_size`.
        lod: Mip level of the reference, 0 = finest, continuous; default: that which fits the size.
    """
    (width, height), lod = decode_size(material, size, lod)
    pictures: dict[str, np.ndarray] = {}
    u = ((np.arange(width) + 0.5) / width).astype(np.float32)
    rows = max(1, _CHUNK // width)
    for top in range(0, height, rows):
        v = ((np.arange(top, min(top + rows, height)) + 0.5) / height).astype(np.float32)
        uv = np.stack(np.broadcast_arrays(u[None, :], v[:, None]), axis=-1).reshape(-1, 2)
        for name, values in material.maps(np.ascontiguousarray(uv), lod).items():
            if name not in pictures:
                pictures[name] = np.empty((height, width, values.shape[1]), np.float32)
            pictures[name][top : top + rows] = values.reshape(len(v), width, -1)
    return pictures


def write_maps(folder, material, size=None, lod: float | None = None, *, bits: int = 8) -> list[Path]:
    """Decode a material as :func:`decode_maps` does, write a file per map, and return their paths.

    Args:
        folder: Where to write; made where it is missing. Files of the same names are replaced.
        material: As for :func:`decode_maps`.
        size: As for :func:`decode_maps`.
        lod: As for :func:`decode_maps`.
        bits: 8 or 16 a channel, in PNG.

    Raises:
        ValueError: If ``bits``, ``size`` or ``lod`` is none that can be.
        OSError: If a file cannot be written; one line that names it.
    """
    if bits not in (8, 16):
        raise ValueError(f"bits must be 8 or 16, got {bits}")
    pictures = decode_maps(material, size, lod)
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for name, picture in pictures.items():
        encoding, bounded = _facts(material, name)
        if picture.shape[2] == 2:  # no picture format has two colours: blue is 0
            picture = np.concatenate([picture, np.zeros_like(picture[..., :1])], axis=2)
        if encoding == "normal":
            path = folder / f"{name}_gl.png"
            _write_png(path, 0.5 + 0.5 * picture, bits, srgb=False)
        elif bounded:
            path = folder / f"{name}.png"
            srgb = encoding == "srgb"
            _write_png(path, linear_to_srgb(picture) if srgb else picture, bits, srgb=srgb)
        else:
            path = folder / f"{name}.exr"
            write_exr(path, picture, half=False)
        written.append(path)
    return written


def _facts(material, name: str) -> tuple[str, bool]:
    """Return a map's encoding and whether its values stay in [0, 1]."""
    own = [channel for channel in material.channels if channel["map"] == name]
    if own:
        bounded = all(min(channel["range"]) >= 0 and max(channel["range"]) <= 1 for channel in own)
        return own[0]["encoding"], bounded
    kind, values = kind_of(name), np.asarray(material.constants[name])
    encoding = "normal" if kind.form == "normal" else "srgb" if kind.srgb else "linear"
    return encoding, bool((values >= 0).all() and (values <= 1).all())


def _write_png(path: Path, picture: np.ndarray, bits: int, *, srgb: bool) -> None:
    if bits == 8 and srgb:
        write_png(path, picture)
        return
    import OpenImageIO as oiio

    levels, dtype = (255, np.uint8) if bits == 8 else (65535, np.uint16)
    stored = np.rint(np.clip(picture, 0, 1) * np.float32(levels)).astype(dtype)
    buffer = oiio.ImageBuf(np.ascontiguousarray(stored))
    buffer.specmod().attribute("oiio:UnassociatedAlpha", 1)  # a fourth channel is a value like the others
    if srgb:
        buffer.specmod().attribute("oiio:ColorSpace", "sRGB")
    with replacing(path) as temporary:
        if not buffer.write(str(temporary), oiio.UINT8 if bits == 8 else oiio.UINT16):
            raise OSError(f"{path}: cannot be written: {' '.join(buffer.geterror().split())}")
