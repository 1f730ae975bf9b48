"""Video: decoded frames are the ones put in, colours are tagged, and an aborted writer leaves nothing."""

import os
import sys

import numpy as np
import pytest

from warp_neumat.io.video import VideoWriter

av = pytest.importorskip("av")


def frames(count, height, width):
    """Smooth coloured pictures that move: what a rendered frame is like."""
    y, x = np.mgrid[0:height, 0:width] / max(height, width)
    for k in range(count):
        red = 0.5 + 0.4 * np.sin(6 * x + 0.3 * k)
        green = 0.5 + 0.4 * np.cos(5 * y - 0.2 * k)
        yield np.stack([red, green, 0.7 * np.hypot(x - 0.5, y - 0.5) + 0.1], axis=-1).astype(np.float32)


def decoded(file):
    with av.open(str(file)) as container:
        stream = container.streams.video[0]
        pictures = [
            frame.to_ndarray(format="rgb24", src_colorspace="ITU709", src_color_range="MPEG") / np.float32(255)
            for frame in container.decode(stream)
        ]
        return pictures, stream.codec_context, stream.average_rate


def psnr(a, b):
    return -10 * np.log10(np.mean((a - b) ** 2))


@pytest.mark.parametrize(("width", "height"), [(160, 96), (161, 97)])
def test_decoded_frames_match(tmp_path, width, height):
    file = tmp_path / "a.mp4"
    with VideoWriter(file, width, height, fps=24) as video:
        for k, picture in enumerate(frames(12, height, width)):
            video.add(picture if k % 2 else np.round(picture * 255).astype(np.uint8))
        assert not file.exists()
    pictures, context, rate = decoded(file)
    assert len(pictures) == 12
    assert rate == 24
    assert pictures[0].shape == (height + height % 2, width + width % 2, 3)
    worst = min(psnr(got[:height, :width], want) for got, want in zip(pictures, frames(12, height, width), strict=True))
    assert worst > 35  # dB; 40.6 seen. Rec. 601 colours, or full range taken for limited, stay below 30
    assert context.pix_fmt == "yuv420p"
    assert context.codec.name == "h264"
    assert (context.colorspace, context.color_primaries, context.color_trc, context.color_range) == (1, 1, 1, 1)
    assert os.listdir(tmp_path) == ["a.mp4"]


def test_the_index_comes_first(tmp_path):
    with VideoWriter(tmp_path / "a.mp4", 64, 64, fps=30) as video:
        for picture in frames(3, 64, 64):
            video.add(picture)
    data = (tmp_path / "a.mp4").read_bytes()
    assert 0 < data.index(b"moov") < data.index(b"mdat")


def test_an_aborted_writer_leaves_what_was_there(tmp_path):
    file = tmp_path / "a.mp4"
    file.write_bytes(b"old")

    def abort():
        with VideoWriter(file, 64, 64, fps=30) as video:
            for picture in frames(3, 64, 64):
                video.add(picture)
            raise KeyError("stop")

    with pytest.raises(KeyError, match="stop"):
        abort()
    assert file.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["a.mp4"]


def test_a_video_without_frames_is_refused(tmp_path):
    with (
        pytest.raises(ValueError, match=r"a.mp4: a video needs at least one frame"),
        VideoWriter(tmp_path / "a.mp4", 64, 64, fps=30),
    ):
        pass
    assert os.listdir(tmp_path) == []


def test_bad_arguments_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none/a.mp4: cannot be written, there is no folder"):
        VideoWriter(tmp_path / "none" / "a.mp4", 64, 64, fps=30)
    with pytest.raises(ValueError, match=r"a.avi: must end in .mp4"):
        VideoWriter(tmp_path / "a.avi", 64, 64, fps=30)
    with pytest.raises(ValueError, match="fps must be above 0, got 0"):
        VideoWriter(tmp_path / "a.mp4", 64, 64, fps=0)
    video = VideoWriter(tmp_path / "a.mp4", 64, 64, fps=30)
    with pytest.raises(ValueError, match="frames are added inside the with block"):
        video.add(np.zeros((64, 64, 3), np.uint8))
    with pytest.raises(ValueError, match=r"a frame must have shape \(64, 64, 3\), got \(64, 65, 3\)"), video:
        video.add(np.zeros((64, 65, 3), np.uint8))
    assert os.listdir(tmp_path) == []


def test_a_missing_library_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(ImportError, match=r"needs PyAV; pip install 'warp-neumat\[video\]'"):
        VideoWriter(tmp_path / "a.mp4", 64, 64, fps=30)
