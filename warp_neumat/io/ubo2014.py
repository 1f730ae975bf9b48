"""Reader of the `.btf` files of UBO2014: BTFs factorised as one matrix, decoded slice by slice.

Layout, little endian, as the database's own library states it (University of Bonn, btflib: ``read_common_header``,
``read_meta_data``, ``read_bidir_sampling``, ``read_ubo_dfmf``, ``read_ubo_fmf``, ``undecorrelate``):

1. Signature: ``!DFMF08FCR`` (a factorisation for each decorrelated channel), ``!FMF12FCER`` and the older
   ``!FMF06FCR``, ``!FMF06FC`` (one factorisation for all channels). A trailing R announces field 5.
2. Meta data: uint32 bytes of this block, uint32 version; three texts of 80 bytes (setup, sensor, lamp); float32 pixels
   per mm; 3 float32 RGB scale; from version 2 uint32 cosine flag; from 3 uint32 length and XML; from 4 uint32 channels
   and for each uint32 length and name.
3. Directions: uint32 views, and for each float32 θ, φ [rad], uint32 lights and their θ, φ.
4. uint32 width, height.
5. uint32 rotations, 9 float32 for each.
6. DFMF: uint32 largest number of components, int32 colour model, 3 float32 mean and 9 float32 matrix of the colours.
   FMF12: uint8 version; from 1 uint32 log flag; from 2 uint32 width, height and the half floats of a height map. FMF:
   uint32 components.
7. A matrix (for each channel in DFMF): uint8 bytes of a number (2, 4, 8), uint32 components k, rows, columns; k
   singular values; U, (rows, k); S·V, (columns, k), row-major. Rows are pairs of directions, light fastest (in FMF
   below them the channel), and columns texels, or the reverse.

Nothing but what the asked slices need is read from the file, which stays mapped: their rows of one factor, and the
other in blocks. Colours: the three decoded channels are R, G, B (the Python package btf-extractor hands out B, G, R).
With the cosine flag the data hold value × cos θ_i, without it they are multiplied here.

Weinmann, Gall and Klein, "Material Classification Based on Training Data Synthesized Using a BTF Database", 2014.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from .asset import FormatError
from .btf_source import checked_pairs

_AGAIN = "fetch the file again"
_CONVERT = "convert it to !DFMF08FCR with the database's btflib"
_SIGNATURES = (b"!DFMF08FCR", b"!FMF12FCER", b"!FMF06FCR", b"!FMF06FC")
_SCALARS = {2: "<f2", 4: "<f4", 8: "<f8"}
_AZIMUTHS = {"counterclockwise": 1.0, "clockwise": -1.0}

LOG_EPSILON = np.float32(1e-5)
"""What the database adds before a logarithm; not stored in the files."""

_YUV = np.array([[1, 0, 1.13983], [1, -0.39465, -0.5806], [1, 2.03211, 0]], np.float32)
_YCOCG = np.array([[1, 1, -1], [1, 0, 1], [1, -1, -1]], np.float32)
COLOUR_MODELS = {
    0: "RGB",
    1: "YUV",
    3: "principal components",
    4: "YCoCg",
    9: "log Y, U, V",
    10: "log Y, log U, log V",
    11: "log Y, U/Y, V/Y",
    12: "log RGB",
}
"""Colour models that are read. Lab (2) and spectral ones (5, 6) are not: their white or bands are not in the file."""


class UBO2014:
    """A factorised BTF as a :class:`~warp_neumat.io.btf_source.BTFSource`; :func:`open_ubo2014` opens one.

    Error: at most 2e-7 of 1 + value with factors stored as floats, 6e-4 as half floats (of which 2e-6 are not rounding
    by the file), 1.4e-6 where the file holds logarithms, against the values that were factorised in float64; held by
    test_slices_are_what_was_written, test_half_precision_is_the_product_of_the_stored_halves and
    test_dynamic_range_reduction.
    """

    def __init__(self, path, *, scale: float = 1.0, azimuth: str = "counterclockwise"):
        if azimuth not in _AZIMUTHS:
            raise ValueError(f"azimuth must be one of {sorted(_AZIMUTHS)}, got {azimuth!r}")
        if not (np.isfinite(scale) and scale > 0):
            raise ValueError(f"scale must be a positive number, got {scale!r}")
        self._path, self._scale = Path(path), np.float32(scale)
        self.name = re.sub(r"_resampled_W\d+xH\d+_L\d+xV\d+$", "", self._path.stem)
        self.opening = {"path": str(path), "scale": float(scale), "azimuth": azimuth}
        self._notes: list[str] = []
        self._heights = None
        self._logarithmic = False
        self._model, self._mean, self._matrix = 0, np.zeros(3, np.float32), np.eye(3, dtype=np.float32)

        file = _Cursor(self._path)
        signature = file.signature()
        self._meta_data(file)
        views, lights = _directions(file)
        self.width, self.height = file.positive("width"), file.positive("height")
        if signature.endswith(b"R") and (turned := file.integer("number of rotations")):
            raise FormatError(path, "rotations", f"{turned} local frames, and only flat samples can be read", _CONVERT)
        if signature.startswith(b"!DFMF"):
            self._read_dfmf(file, len(lights) * len(views))
        else:
            self._read_fmf(file, signature, len(lights) * len(views))
        file.end()
        self._place(lights, views, _AZIMUTHS[azimuth])
        self._notes.append(
            f"{'DFMF' if signature.startswith(b'!DFMF') else 'FMF'}, {self._texels[0].dtype.itemsize}-byte numbers, "
            f"{max(t.shape[1] for t in self._texels)} components; colours: {COLOUR_MODELS[self._model]}"
            f"{', logarithmic' if self._logarithmic else ''}; values below 0 are returned as 0"
        )
        self._notes.append(
            f"taken as 1/sr, as stored{'' if scale == 1.0 else f', times {scale:g}'}, {self._cosine}; "
            f"first row on top, azimuths {azimuth} from +u: the file states neither unit nor orientation"
        )
        self.notes = tuple(self._notes)

    def slices(self, pairs) -> np.ndarray:
        """Return the slices of ``pairs`` (N, 2) of (light, view), (N, height, width, 3) float32, value × cos θ_i, 1/sr.

        Raises:
            ValueError: If ``pairs`` is no array of such indices, or a slice holds values that are not finite.
        """
        pairs = checked_pairs(pairs, len(self.lights), len(self.views))
        lights, views = self._light_rows[pairs[:, 0]], self._view_rows[pairs[:, 1]]
        rows = views * self._lights_in_file + lights
        texels, count = self.width * self.height, len(pairs)
        factor = np.full(count, self._scale, np.float32)
        if not self._cosine_stored:
            factor *= self.lights[pairs[:, 0], 2]
        weights = [_floats(matrix[rows]).T for matrix in self._pairs]
        out = np.empty((count, texels, 3), np.float32)
        step = int(np.clip((1 << 20) // max(count, 1), 64, 1 << 13))
        for first in range(0, texels, step):
            span, read, block = slice(first, min(first + step, texels)), None, None
            values = np.empty((span.stop - first, count, 3), np.float32)
            for channel, (matrix, weight) in enumerate(zip(self._texels, weights, strict=True)):
                if matrix is not read:  # the channels of an FMF may share one matrix
                    read, block = matrix, _floats(matrix[span])
                values[..., channel] = block @ weight
            with np.errstate(over="ignore", invalid="ignore"):
                colours = self._linear(values) * factor[:, None]
            out[:, span] = colours.transpose(1, 0, 2)
        finite = np.isfinite(out).all((1, 2))
        if not finite.all():
            light, view = pairs[np.argmin(finite)]
            raise FormatError(self._path, f"slice of light {light}, view {view}", "must be finite", _AGAIN)
        return np.maximum(out, 0.0, out=out).reshape(count, self.height, self.width, 3)

    @property
    def heights(self) -> np.ndarray | None:
        """The height map, (rows, columns) float32 in the file's unit, or None where the file has none."""
        return None if self._heights is None else self._heights.astype(np.float32)

    def _linear(self, v: np.ndarray) -> np.ndarray:
        """Return linear RGB of decoded channels (..., 3)."""
        if self._model == 3:
            v = v @ self._matrix + self._mean
        elif self._model == 4:
            v = v @ _YCOCG.T
        elif self._model == 12:
            v = np.exp(v) - LOG_EPSILON
        elif self._model != 0:
            y, uv = v[..., :1], v[..., 1:]
            if self._model >= 9:
                y = np.exp(y)
                if self._model == 10:
                    uv = np.sign(uv) * np.exp(np.abs(uv)) * LOG_EPSILON
                elif self._model == 11:
                    uv = uv * y
                y = y - LOG_EPSILON
            v = np.concatenate([y, uv], -1) @ _YUV.T
        return np.exp(v) - LOG_EPSILON if self._logarithmic else v

    def _meta_data(self, file: _Cursor) -> None:
        start = file.at
        size, version = file.integer("size of the meta data"), file.integer("version of the meta data")
        if not 1 <= version <= 4:
            raise FormatError(file.path, "version of the meta data", f"{version} is none of 1 … 4", _CONVERT)
        setup = file.text(80, "measurement setup")
        file.text(160, "image sensor and light source")
        file.take("<f4", 1, "pixels per mm")
        scale = file.take("<f4", 3, "RGB scale")
        self._cosine_stored = version > 1 and file.integer("cosine flag") != 0
        self._cosine = "with the cosine in the data" if self._cosine_stored else "times cos θ_i"
        if version > 2:
            file.text(file.integer("length of the XML"), "XML")
        names = ["R", "G", "B"]
        if version > 3:
            count = file.integer("number of channels")
            if count != 3:
                raise FormatError(file.path, "channels", f"{count}, and only RGB can be read", "take an RGB file")
            names = [file.text(file.integer("length of a channel's name"), "name of a channel") for _ in range(3)]
        if file.at - start != size:
            rule = f"{file.at - start} bytes long where the file says {size}"
            raise FormatError(file.path, "meta data", rule, _AGAIN)
        letters = [name.upper() for name in names]
        if sorted(letters) == ["B", "G", "R"] and letters != ["R", "G", "B"]:
            raise FormatError(file.path, "channels", f"in the order {', '.join(names)}, not R, G, B", _CONVERT)
        if letters != ["R", "G", "B"]:
            self._notes.append(f"channels named {', '.join(names)} are taken as R, G, B")
        if setup:
            self._notes.append(f"file says: {setup}")
        if not (scale == 1).all():
            stated = ", ".join(f"{s:g}" for s in scale)
            self._notes.append(f"the stated RGB scale ({stated}) is not applied: the database's library applies none")

    def _read_dfmf(self, file: _Cursor, pairs: int) -> None:
        file.integer("number of components")
        self._model = int(file.take("<i4", 1, "colour model")[0])
        if self._model not in COLOUR_MODELS:
            known = ", ".join(f"{k} {v}" for k, v in COLOUR_MODELS.items())
            raise FormatError(file.path, "colour model", f"{self._model} is none of {known}", _CONVERT)
        self._mean = file.take("<f4", 3, "mean colour").copy()
        self._matrix = file.take("<f4", 9, "colour matrix").reshape(3, 3).copy()
        self._texels, self._pairs = [], []
        for channel in range(3):
            u, sv, swapped = _matrix(file, f"channel {channel}", pairs, self.width * self.height, 1)
            self._texels.append(u if swapped else sv)
            self._pairs.append(sv if swapped else u)

    def _read_fmf(self, file: _Cursor, signature: bytes, pairs: int) -> None:
        version = int(file.take("u1", 1, "version of the FMF header")[0]) if signature == b"!FMF12FCER" else 0
        if version > 2:
            raise FormatError(file.path, "version of the FMF header", f"{version} is none of 0, 1, 2", _CONVERT)
        if version >= 1:
            self._logarithmic = file.integer("dynamic range reduction") != 0
        if version >= 2:
            columns, rows = file.integer("width of the height map"), file.integer("height of the height map")
            if columns and rows:
                # Which of the two comes first is not certain; for square maps it does not matter.
                if columns != rows and (columns, rows) != (self.width, self.height):
                    rule = f"{columns}x{rows} texels where the BTF has {self.width}x{self.height}"
                    raise FormatError(file.path, "height map", rule, _CONVERT)
                self._heights = file.take("<f2", columns * rows, "height map").reshape(rows, columns)
        file.integer("number of components")
        u, sv, swapped = _matrix(file, "matrix", pairs, self.width * self.height, 3)
        per_channel = u.reshape(-1, 3, u.shape[1])
        channels, shared = [per_channel[:, c] for c in range(3)], [sv] * 3
        self._texels, self._pairs = (channels, shared) if swapped else (shared, channels)

    def _place(self, lights: np.ndarray, views: np.ndarray, turn: float) -> None:
        self._lights_in_file = len(lights)
        kept = []
        for what, angles in (("lights", lights), ("views", views)):
            theta, phi = angles.astype(np.float64).T
            sine = np.sin(theta)
            vectors = np.stack([sine * np.cos(phi), turn * sine * np.sin(phi), np.cos(theta)], 1).astype(np.float32)
            above = np.flatnonzero(vectors[:, 2] > 1e-4)
            if len(above) == 0:
                raise FormatError(self._path, what, "none is above the horizon", _AGAIN)
            if len(above) < len(vectors):
                self._notes.append(f"{len(vectors) - len(above)} {what} at the horizon are left out")
            kept += [vectors[above], above]
        self.lights, self._light_rows, self.views, self._view_rows = kept


def open_ubo2014(path, *, scale: float = 1.0, azimuth: str = "counterclockwise") -> UBO2014:
    """Return the BTF of a UBO2014 file as a source.

    Args:
        path: A `.btf` file; it stays mapped while the source lives.
        scale: 1/sr for a stored 1; the file states no unit.
        azimuth: Which way φ grows from +u with the first row on top: "counterclockwise" or "clockwise".

    Raises:
        FormatError: If the file is none of the layouts above, its sizes contradict each other or its length, or it
            uses what could not be established; one line that says what and what to do.
        OSError: If the file cannot be read.
    """
    return UBO2014(path, scale=scale, azimuth=azimuth)


class _Cursor:
    """Fields one after the other from a mapped file; what does not fit the file is refused before it is allocated."""

    def __init__(self, path: Path):
        self.path, self.at = path, 0
        if path.stat().st_size == 0:  # a mapping cannot be empty
            raise FormatError(path, "signature", "the file is empty", _AGAIN)
        self._bytes = np.memmap(path, np.uint8, "r")

    def take(self, dtype: str, count: int, field: str) -> np.ndarray:
        size = count * np.dtype(dtype).itemsize
        missing = self.at + size - len(self._bytes)
        if missing > 0:
            raise FormatError(self.path, field, f"the file ends {missing} bytes too early", _AGAIN)
        self.at += size
        return self._bytes[self.at - size : self.at].view(dtype)

    def integer(self, field: str) -> int:
        return int(self.take("<u4", 1, field)[0])

    def positive(self, field: str) -> int:
        value = self.integer(field)
        if value == 0:
            raise FormatError(self.path, field, "must be positive, is 0", _AGAIN)
        return value

    def text(self, size: int, field: str) -> str:
        raw = self.take("u1", size, field).tobytes()
        return " ".join(raw.split(b"\0")[0].decode("utf-8", "replace").split())

    def signature(self) -> bytes:
        start = self._bytes[:18].tobytes()
        for known in _SIGNATURES:
            # The R of !FMF06FCR may be the first byte of the next field of an !FMF06FC; its version tells.
            version = int.from_bytes(start[len(known) + 4 : len(known) + 8], "little")
            if start.startswith(known) and (known != b"!FMF06FCR" or version < 256):
                self.at = len(known)
                return known
        if start.startswith((b"!PVF", b"BDI")):
            rule = f"{start[:9].decode('ascii', 'replace')!r} is a factorisation per view or a full table"
            raise FormatError(self.path, "signature", rule, _CONVERT)
        shown = ", ".join(s.decode() for s in _SIGNATURES)
        raise FormatError(self.path, "signature", f"{start[:10]!r} is none of {shown}", "give a UBO2014 .btf file")

    def end(self) -> None:
        left = len(self._bytes) - self.at
        if left:
            raise FormatError(self.path, "length", f"{left} bytes more than the header accounts for", _AGAIN)


def _directions(file: _Cursor) -> tuple[np.ndarray, np.ndarray]:
    """Return (views (V, 2), lights (L, 2)) of θ, φ [rad]; every view must have the same lights."""
    count, views, lights = file.positive("number of views"), [], None
    for view in range(count):
        views.append(file.take("<f4", 2, f"view {view}"))
        number = file.positive(f"number of lights of view {view}")
        own = file.take("<f4", 2 * number, f"lights of view {view}").reshape(number, 2)
        if lights is None:
            lights = own
        elif not np.array_equal(own, lights):
            rule = f"view {view} has other lights than view 0"
            raise FormatError(file.path, "lights", rule, "resample it to one set of lights")
    for what, angles in (("views", np.array(views)), ("lights", lights)):
        theta = angles[:, 0]
        bad = ~(np.isfinite(angles).all(1) & (theta >= 0) & (theta <= np.pi / 2 + 1e-3))
        if bad.any():
            rule = f"θ = {theta[np.argmax(bad)]:g} of number {np.argmax(bad)} lies outside [0, π/2]"
            raise FormatError(file.path, what, rule, _AGAIN)
    return np.array(views), lights


def _matrix(file: _Cursor, field: str, pairs: int, texels: int, channels: int):
    """Return (U (rows, k), S·V (columns, k), whether rows are texels) as views into the file."""
    size = int(file.take("u1", 1, f"{field}: bytes of a number")[0])
    if size not in _SCALARS:
        raise FormatError(file.path, f"{field}: bytes of a number", f"{size} is none of 2, 4, 8", _AGAIN)
    count = file.positive(f"{field}: components")
    rows, columns = file.integer(f"{field}: rows"), file.integer(f"{field}: columns")
    swapped = (rows, columns) != (pairs * channels, texels)
    if swapped and (rows, columns) != (texels * channels, pairs):
        rule = f"{rows}x{columns} does not fit {pairs} pairs of directions, {texels} texels and {channels} channel(s)"
        raise FormatError(file.path, f"{field}: rows and columns", rule, _AGAIN)
    file.take(_SCALARS[size], count, f"{field}: singular values")
    u = file.take(_SCALARS[size], rows * count, f"{field}: U").reshape(rows, count)
    return u, file.take(_SCALARS[size], columns * count, f"{field}: S·V").reshape(columns, count), swapped


def _floats(stored: np.ndarray) -> np.ndarray:
    """Return ``stored`` as float32, or float64 where it is; half floats by moving bits, 5 times NumPy's conversion."""
    if stored.dtype.itemsize != 2:
        return np.asarray(stored, stored.dtype.newbyteorder("="))
    bits = stored.view("<u2").astype(np.uint32)
    bits <<= np.uint32(16)
    bits = bits.view(np.int32)
    bits >>= np.int32(3)  # arithmetic: fills the exponent's upper bits with the sign, which the mask takes away again
    bits &= np.int32(0x8FFFE000 - (1 << 32))
    values = bits.view(np.float32)
    values *= np.float32(2.0**112)  # the difference of the two exponents' biases; subnormal numbers come out right too
    if values.size and max(values.max(), -values.min()) >= 65536.0:  # infinities and NaN need NumPy's conversion
        return stored.astype(np.float32)
    return values
