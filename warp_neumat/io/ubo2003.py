"""Reader of UBO2003 archives: a picture for each pair of a light and a view, in a zip file or a folder.

Every picture is named by the angles in degrees, as in ``tv030_pv090/00008 tl015 pl060 tv030 pv090.jpg`` (number and
folder do not matter): θ_l, φ_l to the light, θ_v, φ_v to the viewer. The database has 81 × 81 of 256² or 800² texels,
8-bit JPEG; the BTF database of UTIA writes its PNG files with the same names, ``tl000_pl000_tv000_pv000.png``. Pictures
are decoded when first asked for, and a few are kept.

Assumed, since the files do not say: bytes are sRGB-encoded; pictures show radiance under a lamp of constant irradiance,
so that cos θ_i is in them; and linear 1 is what a white diffuser facing the lamp shows, f·cos θ_i = 1/π. Published
renderings of the database do the same with a gamma of 2.2 (github.com/elerac/btf-rendering).

Sattler, Sarlette and Klein, "Efficient and Realistic Visualization of Cloth", 2003.
"""

from __future__ import annotations

import collections
import re
import tempfile
import zipfile
import zlib
from pathlib import Path, PurePosixPath

import numpy as np

from .asset import FormatError
from .btf_directions import ubo2003_directions
from .btf_source import checked_pairs
from .image import read_image
from .mipmaps import srgb_to_linear

_NAME = re.compile(
    r"(?:.*[ _-])?tl(\d{1,3})[ _]pl(\d{1,3})[ _]tv(\d{1,3})[ _]pv(\d{1,3})\.(?:jpe?g|png)", re.IGNORECASE
)
_TRANSFERS = ("srgb", "linear")
_AZIMUTHS = ("counterclockwise", "clockwise")
_AGAIN = "fetch the archive again"

KEPT = 64 << 20
"""Bytes of pictures that stay decoded: 341 of 256²."""


class UBO2003:
    """Pictures named by their directions as a :class:`~warp_neumat.io.btf_source.BTFSource`; :func:`open_ubo2003`.

    Error: at most 5e-7 of a value against float64 of the decoded bytes; held by test_slices_are_the_pictures.
    """

    def __init__(self, path, *, transfer: str = "srgb", scale: float = 1 / np.pi, azimuth: str = "counterclockwise"):
        if transfer not in _TRANSFERS:
            raise ValueError(f"transfer must be one of {list(_TRANSFERS)}, got {transfer!r}")
        if azimuth not in _AZIMUTHS:
            raise ValueError(f"azimuth must be one of {list(_AZIMUTHS)}, got {azimuth!r}")
        if not (np.isfinite(scale) and scale > 0):
            raise ValueError(f"scale must be a positive number, got {scale!r}")
        self._path = Path(path)
        self.name = self._path.stem
        self.opening = {"path": str(path), "transfer": transfer, "scale": float(scale), "azimuth": azimuth}
        self._zip = None
        if not self._path.is_dir():
            try:
                self._zip = zipfile.ZipFile(self._path)
            except zipfile.BadZipFile as error:
                raise FormatError(path, "archive", f"is no zip file ({error})", _AGAIN) from None
        found, foreign = self._listed()
        lights, views = (sorted({key[i : i + 2] for key in found}) for i in (0, 2))
        self._members = _complete(self._path, found, lights, views)
        turn = -1.0 if azimuth == "clockwise" else 1.0
        self.lights, self.views = _directions(lights, turn), _directions(views, turn)
        self._kept: collections.OrderedDict[int, np.ndarray] = collections.OrderedDict()
        self.height, self.width = self._decode(0).shape[:2]
        bytes_ = np.arange(256, dtype=np.float32) / 255
        self._values = np.float32(scale) * (srgb_to_linear(bytes_) if transfer == "srgb" else bytes_)
        self.notes = (
            *([f"{len(foreign)} file(s) that are no slices are left out: {', '.join(foreign[:3])}"] if foreign else []),
            *self._sampling_notes(len(lights), len(views)),
            f"assumed: {'sRGB-encoded' if transfer == 'srgb' else 'linear'} 8-bit values (highlights end at white), "
            f"cosine in the data, {scale:.4g} 1/sr for white, first row on top, azimuths {azimuth} from +u",
        )

    def slices(self, pairs) -> np.ndarray:
        """Return the slices of ``pairs`` (N, 2) of (light, view), (N, height, width, 3) float32, value × cos θ_i, 1/sr.

        Raises:
            ValueError: If ``pairs`` is no array of such indices, or a picture is damaged or of another size.
        """
        pairs = checked_pairs(pairs, len(self.lights), len(self.views))
        out = np.empty((len(pairs), self.height, self.width, 3), np.float32)
        for row, (light, view) in zip(out, pairs, strict=True):
            pixels = self._picture(light * len(self.views) + view)
            np.take(self._values, pixels, out=row)
        return out

    def _picture(self, index: int) -> np.ndarray:
        if index in self._kept:
            self._kept.move_to_end(index)
            return self._kept[index]
        pixels = self._decode(index)
        if pixels.shape[:2] != (self.height, self.width):
            rule = f"{pixels.shape[1]}x{pixels.shape[0]} where {self._members[0]} is {self.width}x{self.height}"
            raise FormatError(self._path, self._members[index], rule, "give slices of one size")
        self._kept[index] = pixels
        if len(self._kept) > max(1, KEPT // pixels.nbytes):
            self._kept.popitem(last=False)
        return pixels

    def _decode(self, index: int) -> np.ndarray:
        member = self._members[index]
        try:
            if self._zip is None:
                pixels, _ = read_image(self._path / member, stored=True)
            else:
                with tempfile.TemporaryDirectory() as folder:  # OpenImageIO's Python reads files, not bytes
                    file = Path(folder) / f"slice{PurePosixPath(member).suffix.lower()}"
                    file.write_bytes(self._zip.read(member))
                    pixels, _ = read_image(file, stored=True)
        except (OSError, zipfile.BadZipFile, zlib.error, RuntimeError, NotImplementedError) as error:
            what = str(error).rpartition(": ")[2] or type(error).__name__
            raise FormatError(self._path, member, f"cannot be decoded ({what})", _AGAIN) from None
        if pixels.dtype != np.uint8 or pixels.shape[2] not in (1, 3):
            rule = f"has {pixels.shape[2]} channel(s) of {pixels.dtype}, not 1 or 3 of 8 bits"
            raise FormatError(self._path, member, rule, "write it as 8-bit RGB")
        return np.ascontiguousarray(np.broadcast_to(pixels, (*pixels.shape[:2], 3)))

    def _listed(self) -> tuple[dict[tuple[int, int, int, int], str], list[str]]:
        """Return {(θ_l, φ_l, θ_v, φ_v): name in the archive}, and the names of other files."""
        if self._zip is None:
            names = [p.relative_to(self._path).as_posix() for p in sorted(self._path.rglob("*")) if p.is_file()]
        else:
            names = [info.filename for info in self._zip.infolist() if not info.is_dir()]
        found, foreign = {}, []
        for name in names:
            base = PurePosixPath(name).name
            match = _NAME.fullmatch(base)
            if match is None or base.startswith("._"):  # macOS puts ._ files beside the others
                foreign.append(name)
                continue
            key = tuple(int(angle) for angle in match.groups())
            key = (key[0], key[1] % 360, key[2], key[3] % 360)
            if max(key[0], key[2]) >= 90:
                raise FormatError(self._path, name, "θ must be below 90°", "remove it and its row of slices")
            if key in found:
                raise FormatError(self._path, name, f"has the directions of {found[key]}", "remove one of the two")
            found[key] = name
        if not found:
            rule = f"none of {len(names)} file(s) is named like 'tl015 pl060 tv030 pv090.jpg'"
            raise FormatError(self._path, "pictures", rule, "give a UBO2003 zip file or its folder")
        return found, foreign

    def _sampling_notes(self, lights: int, views: int) -> list[str]:
        usual = ubo2003_directions()
        same = all(
            len(own) == len(usual) and (np.abs(own[:, None] - usual).max(-1).min(1) < 1e-2).all()
            for own in (self.lights, self.views)
        )
        return [] if same else [f"{lights} lights and {views} views, not the 81 directions of UBO2003"]


def open_ubo2003(
    path, *, transfer: str = "srgb", scale: float = 1 / np.pi, azimuth: str = "counterclockwise"
) -> UBO2003:
    """Return the BTF of a UBO2003 archive as a source.

    Args:
        path: A zip file, which stays open while the source lives, or a folder; subfolders are searched.
        transfer: How the bytes encode radiance: "srgb" or "linear".
        scale: Value × cos θ_i [1/sr] of white.
        azimuth: Which way φ grows from +u with the first row on top: "counterclockwise" or "clockwise".

    Raises:
        FormatError: If it is no zip file, has no such pictures, two for one pair of directions, or none for a pair of
            a light and a view that occur; one line that names the picture.
        OSError: If it cannot be read.
    """
    return UBO2003(path, transfer=transfer, scale=scale, azimuth=azimuth)


def _complete(path: Path, found: dict, lights: list, views: list) -> list[str]:
    """Return the name of each pair's picture, light slowest."""
    wanted = [light + view for light in lights for view in views]
    missing = [key for key in wanted if key not in found]
    if missing:
        name = "tl{:03} pl{:03} tv{:03} pv{:03}".format(*missing[0])
        rule = f"{len(missing)} of {len(lights)}x{len(views)} pairs have no picture, the first is '{name}'"
        raise FormatError(path, "pictures", rule, "add them, or remove the light or view that they belong to")
    return [found[key] for key in wanted]


def _directions(angles: list[tuple[int, int]], turn: float) -> np.ndarray:
    theta, phi = np.radians(np.array(angles, np.float64)).T
    sine = np.sin(theta)
    return np.stack([sine * np.cos(phi), turn * sine * np.sin(phi), np.cos(theta)], 1).astype(np.float32)
