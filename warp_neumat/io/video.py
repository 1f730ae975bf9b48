"""Frames to an mp4 file: H.264, 4:2:0, Rec. 709, which every browser and player shows.

PyAV does the coding and is imported when a writer is made.
"""

import contextlib
import fractions
import math
from pathlib import Path

import numpy as np

from .atomic import check_writable, replacing
from .image import to_uint8

_QUALITY = "16"  # x264's constant rate factor: visually lossless on rendered frames
_REC709 = 1  # number of Rec. 709 in the H.264 standard's tables of primaries, transfer and matrix
_LIMITED = 1  # FFmpeg's number of the 16…235 range


def _av():
    try:
        import av
    except ImportError:
        raise ImportError("writing video needs PyAV; pip install 'warp-neumat[video]' brings it") from None
    return av


class VideoWriter:
    """Writes frames to an mp4 file, as a context manager.

    The file appears when the block ends well; if it raises, or no frame was added, nothing is left and what was there
    stays.

    Args:
        path: File to write or replace, ending in ``.mp4``; its folder must exist.
        width: Frame width [px]; an odd one is padded to even with a copy of the last column.
        height: Frame height [px]; likewise.
        fps: Frames per second, as 30 or 23.976.

    Raises:
        ImportError: If PyAV is missing; names the extra that brings it.
        OSError: If the file cannot be written; one line that names it.

    Example:
        >>> with VideoWriter("out.mp4", 1280, 720, fps=24) as video:  # doctest: +SKIP
        ...     video.add(frame)
    """

    def __init__(self, path, width: int, height: int, fps: float = 30.0):
        self._library = _av()
        self.path, self.width, self.height = Path(path), int(width), int(height)
        if self.path.suffix.lower() != ".mp4":
            raise ValueError(f"{self.path}: must end in .mp4")
        if self.width < 1 or self.height < 1:
            raise ValueError(f"a video must have at least one pixel, got {self.width}x{self.height}")
        if not 0 < fps < math.inf:
            raise ValueError(f"fps must be above 0, got {fps}")
        check_writable(self.path)
        self.fps = fractions.Fraction(fps).limit_denominator(1001)
        self.frames = 0
        self._stack: contextlib.ExitStack | None = None

    def __enter__(self):
        with contextlib.ExitStack() as stack, self._named():
            temporary = stack.enter_context(replacing(self.path))
            # faststart moves the index to the front, so that a browser plays before it has the whole file.
            self._container = self._library.open(str(temporary), "w", options={"movflags": "faststart"})
            stack.callback(self._container.close)
            self._stream = self._add_stream()
            self._stack = stack.pop_all()
        return self

    def __exit__(self, kind, error, trace):
        stack, self._stack = self._stack, None
        with self._named(), stack:  # closes the container, then renames
            if error is None:
                if not self.frames:
                    raise ValueError(f"{self.path}: a video needs at least one frame")
                self._container.mux(self._stream.encode(None))
                self._container.close()
            else:
                raise error

    def add(self, picture) -> None:
        """Append one frame: display values, sRGB-encoded, shape (H, W, 3), uint8 or floating point in [0, 1]."""
        if self._stack is None:
            raise ValueError(f"{self.path}: frames are added inside the with block")
        picture = np.asarray(picture)
        if picture.shape != (self.height, self.width, 3):
            raise ValueError(f"a frame must have shape {(self.height, self.width, 3)}, got {picture.shape}")
        picture = to_uint8(picture)
        if self.width % 2 or self.height % 2:
            picture = np.pad(picture, ((0, self.height % 2), (0, self.width % 2), (0, 0)), mode="edge")
        frame = self._library.VideoFrame.from_ndarray(picture, format="rgb24")
        frame = frame.reformat(format="yuv420p", dst_colorspace="ITU709", dst_color_range="MPEG")
        frame.pts, frame.time_base = self.frames, 1 / self.fps
        frame.colorspace, frame.color_range = _REC709, _LIMITED
        with self._named():
            self._container.mux(self._stream.encode(frame))
        self.frames += 1

    def _add_stream(self):
        stream = self._container.add_stream("libx264", rate=self.fps)
        stream.width, stream.height = self.width + self.width % 2, self.height + self.height % 2
        stream.pix_fmt = "yuv420p"
        stream.options = {"crf": _QUALITY, "preset": "veryfast"}
        context = stream.codec_context
        context.color_primaries = context.color_trc = context.colorspace = _REC709
        context.color_range = _LIMITED
        return stream

    @contextlib.contextmanager
    def _named(self):
        """Turn the library's errors into an OSError that names the file."""
        try:
            yield
        except self._library.error.FFmpegError as error:
            raise OSError(f"{self.path}: cannot be written: {' '.join(str(error).split())}") from None
