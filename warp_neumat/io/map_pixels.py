"""One map's picture, decoded and checked: from stored integers or floats to the encoded domain, (H, W, k) float32.

The encoded domain is what a loss sees: y in [0, 1]; v = lo + (hi − lo)·y with the map's range; then ``linear``: value =
v; ``srgb``: value = linear light of v; ``normal``: n = 2v − 1 for x and y, +Y up (OpenGL).

Transfer functions: base colour and emissive pictures of 8 bits are sRGB, as are 16-bit PNGs of them that say so in an
sRGB or gAMA chunk; a PNG that states a gamma of 1 is linear; EXR and everything else is linear.
"""

from __future__ import annotations

import dataclasses
import struct
from pathlib import Path

import numpy as np

from .image import ImageInfo
from .map_fields import MapSource
from .map_names import EXTRA, kind_of

CONSTANT = 0.5 / 255
"""A map whose values span less than half a step of 8 bits is a constant."""

_CURL_WINDOW = 1024  # texels a side, in the middle of a normal map, that the curl test looks at


@dataclasses.dataclass
class MapPixels:
    """One decoded map: ``planes`` (H, W, k) float32 in [0, 1], with the facts that the set's table shows."""

    source: MapSource
    components: tuple[str, ...]
    encoding: str
    range: tuple[float, float]
    planes: np.ndarray
    color_space: str
    notes: list[str]

    @property
    def is_constant(self) -> bool:
        """Whether no channel's stored values span :data:`CONSTANT` or more."""
        sparse = self.planes[::16, ::16]  # settles it for almost every map that is not constant
        scale = self.range[1] - self.range[0]
        return all(
            float(np.ptp(part[..., c])) * scale < CONSTANT
            for part in (sparse, self.planes)
            for c in range(part.shape[2])
        )


def decode_map(source: MapSource, picture: np.ndarray, info: ImageInfo, crop: tuple[slice, slice]) -> MapPixels:
    """Return the map that ``source`` takes from a decoded picture.

    Args:
        source: Which channels, and how to read them.
        picture: (H, W, C) uint8, uint16 or float32, as stored.
        info: What the file says of itself.
        crop: Rows and columns that are wanted; the whole picture is checked all the same.

    Raises:
        ValueError: If channels are missing, or values are not finite or do not fit their colour space; one line with
            file, map and way out.
    """
    kind, notes = kind_of(source.map), []
    at, names = _channels(source, kind, info)
    picture = picture[::-1] if source.flip else picture
    if kind is EXTRA and source.channel is None and "a" in names and not np.ptp(picture[..., at[-1]]):
        at, names = at[:-1], names[:-1] if len(at) > 2 else ("value",)  # an alpha that says nothing
    values = picture if at == list(range(picture.shape[2])) else picture[..., at]
    if values.dtype.kind == "f":
        values = _finite(source, values, notes)
    if kind.form == "normal":
        return _normal(source, values, crop, notes)
    if len(at) == 3 and kind.form != "color" and _grey(values, kind.form, source, notes):
        values, names = _mean(values[crop]), ("value",)
    elif len(at) == 3 and kind.form == "color" and _colour_spread(values) == 0:
        values, names = values[crop][..., :1], ("value",)
        notes.append("grey throughout: one channel")
    else:
        values = values[crop]
    planes = _to_float(values)
    if source.invert:
        planes = 1.0 - planes
    space = _color_space(source, kind, info, notes)
    low, high = (float(planes.min()), float(planes.max())) if values.dtype.kind == "f" else (0.0, 1.0)
    limits = (0.0, 1.0)
    if low < 0.0 or high > 1.0:
        if space == "srgb":
            raise ValueError(
                f"{source.file}: map {source.map}: sRGB values must lie in [0, 1], got {low:g} … {high:g}; "
                "set its color_space to linear"
            )
        limits = (low, high if high > low else low + 1.0)
        planes = np.clip((planes - np.float32(low)) * np.float32(1.0 / (limits[1] - low)), 0.0, 1.0)
        notes.append(f"values {low:.4g} … {high:.4g}, stored with this range")
    return MapPixels(source, names, space, limits, np.ascontiguousarray(planes, np.float32), space, notes)


# --- channels ---------------------------------------------------------------------------------------------------------


def _channels(source: MapSource, kind, info: ImageInfo) -> tuple[list[int], tuple[str, ...]]:
    """Return channel numbers and component names."""
    count = len(info.channels)
    alpha = info.channels.index("A") if "A" in info.channels and count > 1 else None
    colours = [i for i in range(count) if i != alpha]
    if source.channel is not None:
        wanted = source.channel
        at = [alpha if c == "a" and alpha is not None else "rgba".index(c) if isinstance(c, str) else c for c in wanted]
        if max(at) >= count:
            raise ValueError(
                f"{source.file}: map {source.map}: has no channel {_say(wanted)}; its channels are "
                f"{', '.join(info.channels)}"
            )
    elif kind.form == "normal":
        at = list(range(min(count, 3)))
    elif kind.form == "color" or kind.form == "scalar":
        at = colours[:3] if len(colours) >= 3 else colours[:1]
    else:
        at = colours if kind is not EXTRA else list(range(count))
    if kind.form == "scalar" and len(at) not in (1, 3):
        at = at[:1]
    if kind.form == "normal" and len(at) < 2:
        raise ValueError(
            f"{source.file}: map {source.map}: has one channel, a normal map needs two; name another map in overrides"
        )
    if len(at) == 1:
        return at, ("value",)
    if len(at) > 4:
        raise ValueError(
            f"{source.file}: map {source.map}: has {len(at)} channels, a map holds at most 4; choose them with "
            f'overrides={{"{source.map}": {{"channel": [0, 1, 2]}}}}'
        )
    return at, tuple("rgba"[: len(at)])


def _say(channel) -> str:
    return channel if isinstance(channel, str) else ", ".join(map(str, channel))


def _finite(source: MapSource, values: np.ndarray, notes: list[str]) -> np.ndarray:
    good = np.isfinite(values)
    if good.all():
        return values
    bad = ~good
    count, (row, column, _) = int(bad.any(-1).sum()), np.argwhere(bad)[0]
    if source.replace_nan is None:
        raise ValueError(
            f"{source.file}: map {source.map}: {count} pixels are NaN or infinite, the first at x={column}, y={row}; "
            f'mend the file or set "replace_nan" to a number'
        )
    notes.append(f"{count} pixels were NaN or infinite, now {source.replace_nan:g}")
    return np.where(good, values, np.float32(source.replace_nan))


def _colour_spread(values: np.ndarray) -> float:
    """Return how far apart the three channels get, in [0, 1] of the stored range."""
    worst, scale = 0, {1: 255, 2: 65535}.get(values.dtype.itemsize, 1)
    for row in range(0, len(values), 128):
        r, g, b = (values[row : row + 128, :, c] for c in range(3))
        spread = np.maximum(np.maximum(r, g), b) - np.minimum(np.minimum(r, g), b)
        worst = max(worst, spread.max())
    return float(worst) / scale


def _grey(values: np.ndarray, form: str, source: MapSource, notes: list[str]) -> bool:
    """Tell whether three channels are to be one; a scalar map's always are."""
    spread = _colour_spread(values)
    if spread <= 1.001 / 255:
        return True
    if form == "scalar":
        notes.append(f"the picture is coloured (channels up to {spread:.3g} apart): their mean is taken; set channel")
        return True
    notes.append("a colour picture, taken as linear")
    return False


def _mean(values: np.ndarray) -> np.ndarray:
    if values.dtype.kind == "u" and not _colour_spread(values):
        return values[..., :1]
    total = values[..., 0].astype(np.float32) + values[..., 1] + values[..., 2]
    return total[..., None] * np.float32(1.0 / 3.0 / (np.iinfo(values.dtype).max if values.dtype.kind == "u" else 1))


def _to_float(values: np.ndarray) -> np.ndarray:
    if values.dtype.kind == "f":
        return values
    return np.multiply(values, np.float32(1.0 / np.iinfo(values.dtype).max), dtype=np.float32)


# --- colour space -----------------------------------------------------------------------------------------------------


def _color_space(source: MapSource, kind, info: ImageInfo, notes: list[str]) -> str:
    if source.color_space:
        return source.color_space
    if not kind.srgb or source.channel == "a":
        return "linear"
    stated = png_color_space(source.file)
    if stated == "linear":
        notes.append("the file says that it is linear")
        return "linear"
    if info.dtype == "uint8" or (info.dtype == "uint16" and stated == "srgb"):
        return "srgb"
    if info.dtype == "uint16":
        notes.append('16 bits and no transfer function stated: taken as linear; set color_space to "srgb" if it is not')
    return "linear"


def png_color_space(path: Path) -> str | None:
    """Return what a PNG's own sRGB or gAMA chunk states, ``srgb`` or ``linear``; None where it states neither."""
    if path.suffix.lower() != ".png":
        return None
    with path.open("rb") as file:
        if file.read(8) != b"\x89PNG\r\n\x1a\n":
            return None
        gamma = None
        while len(head := file.read(8)) == 8:
            length, kind = struct.unpack(">I4s", head)
            if kind == b"sRGB":
                return "srgb"
            if kind == b"gAMA" and length == 4:
                (gamma,) = struct.unpack(">I", file.read(4))
                file.seek(4, 1)
                continue
            if kind in (b"IDAT", b"IEND"):
                break
            file.seek(length + 4, 1)
    if gamma is None:
        return None
    return "srgb" if 45000 <= gamma <= 46000 else "linear" if 99000 <= gamma <= 101000 else None


# --- normals ----------------------------------------------------------------------------------------------------------


def _normal(source: MapSource, values: np.ndarray, crop, notes: list[str]) -> MapPixels:
    signed = values.dtype.kind == "f" and float(values.min()) < -0.01
    window = _vectors(values[_middle(values.shape)], signed)
    if source.orientation is None or source.orientation == "gl":
        note = _orientation_note(window, source.orientation)
        if note:
            notes.append(note)
    if source.orientation == "dx":
        notes.append("DirectX orientation: green flipped")
    vectors = _vectors(values[crop], signed)
    planes = np.ascontiguousarray(vectors[..., :2])
    if values.shape[2] >= 3:
        length = _length(window)
        off = float(np.abs(length - 1.0).mean())
        if off > 0.05:
            notes.append(f"lengths are {off:.2f} off one on average: normalised")
            planes /= np.maximum(_length(vectors), 1e-6)[..., None]
        if float((window[..., 2] < -0.02).mean()) > 1e-3:
            notes.append("some normals point below the surface: their z is taken as positive")
    if source.orientation == "dx":
        planes[..., 1] *= -1.0
    length = _length(planes)
    if float(length.max()) > 1.0:  # JPEG noise beyond the unit circle
        planes /= np.maximum(length, 1.0)[..., None]
    planes *= 0.5
    planes += 0.5
    return MapPixels(source, ("x", "y"), "normal", (0.0, 1.0), planes, "linear", notes)


def _length(vectors: np.ndarray) -> np.ndarray:
    square = vectors[..., 0] ** 2
    for c in range(1, vectors.shape[-1]):  # a sum over an axis of three is many times slower
        square += vectors[..., c] ** 2
    return np.sqrt(square)


def _vectors(values: np.ndarray, signed: bool) -> np.ndarray:
    vectors = _to_float(values)
    return vectors if signed else 2.0 * vectors - 1.0


def _middle(shape) -> tuple[slice, slice]:
    return tuple(slice(max(0, (n - _CURL_WINDOW) // 2), (n + _CURL_WINDOW) // 2) for n in shape[:2])


def _orientation_note(vectors: np.ndarray, stated: str | None) -> str:
    agreement = integrability(vectors)
    said = "named as OpenGL but" if stated else "orientation not named and"
    if agreement < (-0.5 if stated else -0.15):
        return (
            f"{said} it looks like DirectX (curl correlation {agreement:.2f}; +1 is OpenGL, −1 DirectX); "
            'set orientation to "dx" to flip green'
        )
    if stated is None and agreement < 0.15:
        return f"orientation not named, taken as OpenGL; its curl does not tell (correlation {agreement:.2f})"
    return ""


def integrability(vectors: np.ndarray) -> float:
    """Return how well normals fit a height field with +Y up, in [−1, 1]: near +1 OpenGL, near −1 DirectX, 0 unclear.

    The slopes p = ∂h/∂x = −x/z and q = ∂h/∂y = −y/z of one height field satisfy ∂p/∂y = ∂q/∂x; with y flipped the two
    sides have opposite signs. The value is their correlation over the picture, on slopes averaged over 2×2 texels.

    Args:
        vectors: (H, W, 2) or (H, W, 3) in [−1, 1], row 0 on top.
    """
    height, width = vectors.shape[0] // 2 * 2, vectors.shape[1] // 2 * 2
    if height < 6 or width < 6:
        return 0.0
    x, y = vectors[:height, :width, 0], vectors[:height, :width, 1]
    if vectors.shape[2] >= 3:
        z = vectors[:height, :width, 2]
    else:
        z = np.sqrt(np.maximum(1.0 - x * x - y * y, 0.0))
    z = np.maximum(z, 0.1)
    p, q = (_halved(-c / z) for c in (x, y))
    p_y = -(p[2:, 1:-1] - p[:-2, 1:-1])  # rows go down, y goes up
    q_x = q[1:-1, 2:] - q[1:-1, :-2]
    power = float(np.sqrt((p_y * p_y).sum(dtype=np.float64) * (q_x * q_x).sum(dtype=np.float64)))
    # Below a step of 8 bits on average there is nothing to tell from.
    if power < p_y.size * (0.5 / 255) ** 2:
        return 0.0
    return float((p_y * q_x).sum(dtype=np.float64)) / power


def _halved(values: np.ndarray) -> np.ndarray:
    rows = values[0::2] + values[1::2]
    return (rows[:, 0::2] + rows[:, 1::2]) * np.float32(0.25)
