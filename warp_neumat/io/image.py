"""Pictures to and from files: display values as PNG, linear values as OpenEXR. Row 0 is on top.

A file appears whole or not at all. OpenImageIO does the coding and is imported when first needed.
"""

import contextlib
import dataclasses
from pathlib import Path

import numpy as np

from .atomic import check_writable, replacing

_CHANNELS = {1: ("Y",), 3: ("R", "G", "B"), 4: ("R", "G", "B", "A")}
_REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)  # x, y of red, green, blue and white

# Deflate at its quickest with one fixed row filter (libpng's Up) takes a third of the time of the defaults, level 6
# and a filter chosen per row, for about a tenth more bytes.
_PNG_LEVEL, _PNG_FILTER_UP = 1, 0x20


@dataclasses.dataclass(frozen=True)
class ImageInfo:
    """What a picture file says of itself.

    ``dtype`` is the type of the stored values (``"uint8"``, ``"uint16"``, ``"half"``, ``"float"``), ``color_space``
    what OpenImageIO calls the encoding, empty where the file leaves it open.
    """

    width: int
    height: int
    channels: tuple[str, ...]
    dtype: str
    color_space: str


def to_uint8(picture) -> np.ndarray:
    """Return display values in [0, 1] as uint8, rounded, clipped, NaN as 0; uint8 passes through."""
    picture = np.asarray(picture)
    if picture.dtype == np.uint8:
        return np.ascontiguousarray(picture)
    if picture.dtype.kind != "f":
        raise TypeError(f"picture must be uint8 or floating point with values in [0, 1], got {picture.dtype}")
    result = np.empty(picture.shape, dtype=np.uint8)
    for row in range(0, len(picture), 16):  # temporaries stay in cache
        scaled = np.fmin(np.fmax(picture[row : row + 16], 0.0), 1.0)
        scaled *= 255.0
        scaled += 0.5
        result[row : row + 16] = scaled
    return result


def write_png(path, picture) -> None:
    """Write display values, sRGB-encoded, as an 8-bit PNG.

    Args:
        path: File to write or replace; its folder must exist.
        picture: uint8, or floating point in [0, 1]; shape (H, W), (H, W, 1), (H, W, 3) or (H, W, 4) with straight
            alpha.

    Raises:
        OSError: If the file cannot be written; one line that names it.
    """
    picture = to_uint8(_shaped(picture))
    extra = {"png:compressionLevel": _PNG_LEVEL, "png:filter": _PNG_FILTER_UP, "oiio:UnassociatedAlpha": 1}
    _write(path, picture, "uint8", "png", {**extra, "oiio:ColorSpace": "sRGB"})


def write_exr(path, picture, half: bool = True) -> None:
    """Write linear Rec. 709 values as OpenEXR, ZIP-compressed, with Rec. 709 chromaticities.

    Args:
        path: File to write or replace; its folder must exist.
        picture: Floating point; shape (H, W), (H, W, 1), (H, W, 3) or (H, W, 4) with premultiplied alpha.
        half: Store 16-bit floats instead of 32-bit ones; values beyond ±65504 become infinite.

    Raises:
        OSError: If the file cannot be written; one line that names it.
    """
    picture = _shaped(picture)
    if picture.dtype.kind != "f":
        raise TypeError(f"picture must be floating point, linear, got {picture.dtype}")
    picture = np.ascontiguousarray(picture, dtype=np.float32)
    extra = {"compression": "zip", "oiio:ColorSpace": "lin_rec709_scene", "chromaticities": _REC709}
    _write(path, picture, "half" if half else "float", "exr", extra)


def read_image(path, *, stored: bool = False) -> tuple[np.ndarray, ImageInfo]:
    """Return a picture file's values, shape (H, W, C), float32, and what the file says of itself.

    Values are as stored: integers scaled to [0, 1], floats unchanged, no transfer function undone, alpha straight in
    PNG and premultiplied in EXR. With ``stored``, 8- and 16-bit integers stay uint8 and uint16, unscaled.

    Raises:
        FileNotFoundError: If there is no such file.
        OSError: If it cannot be decoded or ends early; one line that names it.
    """
    with _opened(path) as source:
        spec = source.spec()
        kind = str(spec.format) if stored and str(spec.format) in ("uint8", "uint16") else "float"
        pixels = source.read_image(kind)
        if pixels is None or source.has_error:
            raise OSError(f"{path}: is damaged: {_line(source.geterror())}")
    dtype = np.float32 if kind == "float" else kind
    pixels = np.ascontiguousarray(pixels, dtype=dtype).reshape(spec.height, spec.width, spec.nchannels)
    return pixels, _info(spec)


def read_image_info(path) -> ImageInfo:
    """Return what a picture file says of itself; only its header is read.

    Raises:
        FileNotFoundError: If there is no such file.
        OSError: If it is no picture; one line that names it.
    """
    with _opened(path) as source:
        return _info(source.spec())


def _info(spec) -> ImageInfo:
    space = spec.getattribute("oiio:ColorSpace") or ""
    return ImageInfo(spec.width, spec.height, tuple(spec.channelnames), str(spec.format), space)


@contextlib.contextmanager
def _opened(path):
    import OpenImageIO as oiio

    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    config = oiio.ImageSpec()
    config["oiio:UnassociatedAlpha"] = 1
    source = oiio.ImageInput.open(str(path), config)
    if source is None:
        raise OSError(f"{path}: cannot be read as a picture: {_line(oiio.geterror())}")
    try:
        yield source
    finally:
        source.close()


def _shaped(picture) -> np.ndarray:
    picture = np.asarray(picture)
    if picture.ndim == 2:
        picture = picture[:, :, None]
    if picture.ndim != 3 or picture.shape[2] not in _CHANNELS or picture.size == 0:
        raise ValueError(f"picture must have shape (H, W), (H, W, 1), (H, W, 3) or (H, W, 4), got {picture.shape}")
    return picture


def _write(path, picture: np.ndarray, dtype: str, kind: str, attributes: dict) -> None:
    import OpenImageIO as oiio

    path = Path(path)
    if path.suffix.lower() != f".{kind}":
        raise ValueError(f"{path}: must end in .{kind}")
    check_writable(path)
    height, width, channels = picture.shape
    spec = oiio.ImageSpec(width, height, channels, dtype)
    spec.channelnames = _CHANNELS[channels]
    for name, value in attributes.items():
        if isinstance(value, tuple):
            spec.attribute(name, oiio.TypeDesc(f"float[{len(value)}]"), value)
        else:
            spec.attribute(name, value)
    with replacing(path) as temporary:
        file = oiio.ImageOutput.create(kind)
        opened = file.open(str(temporary), spec)
        good = opened and file.write_image(picture)
        good = (not opened or file.close()) and good  # the last bytes are written on closing
        if not good:
            raise OSError(f"{path}: cannot be written: {_line(file.geterror())}")


def _line(message: str) -> str:
    return " ".join(message.split()) or "unknown format"
