"""Outside decoders of block-compressed textures, and what the tests of our own share."""

import functools

import numpy as np
import pytest
import warp as wp

# Name → (format of imagecodecs, channels).
_BCDEC = {"bc1": ("BC1", 4), "bc3": ("BC3", 4), "bc4": ("BC4", 1), "bc5": ("BC5", 2), "bc7": ("BC7", 4)}


def bcdec(name: str, blocks: np.ndarray) -> np.ndarray:
    """Decode (N, bytes) blocks with bcdec, by way of imagecodecs: (N, 4, 4, channels) uint8."""
    imagecodecs = pytest.importorskip("imagecodecs")
    format, channels = _BCDEC[name]
    shape = (4 * len(blocks), 4, channels) if channels > 1 else (4 * len(blocks), 4)
    picture = imagecodecs.bcn_decode(blocks.tobytes(), imagecodecs.BCN.FORMAT[format], shape=shape)
    return np.asarray(picture).reshape(len(blocks), 4, 4, channels)


def bcdec_half(blocks: np.ndarray, signed: bool) -> np.ndarray:
    """Decode (N, 16) BC6H blocks with bcdec: (N, 4, 4, 3) float16."""
    imagecodecs = pytest.importorskip("imagecodecs")
    format = imagecodecs.BCN.FORMAT["BC6HS" if signed else "BC6HU"]
    picture = imagecodecs.bcn_decode(blocks.tobytes(), format, shape=(4 * len(blocks), 4, 3))
    return np.asarray(picture).astype(np.float16).reshape(len(blocks), 4, 4, 3)


def texture2d(name: str, blocks: np.ndarray) -> np.ndarray:
    """Decode (N, bytes) blocks with texture2ddecoder: (N, 4, 4, 4) uint8, RGBA."""
    decoder = pytest.importorskip("texture2ddecoder")
    picture = getattr(decoder, f"decode_{name}")(blocks.tobytes(), 4, 4 * len(blocks))
    return np.frombuffer(picture, np.uint8).reshape(len(blocks), 4, 4, 4)[..., [2, 1, 0, 3]]


def check_kinds(decode, blocks: np.ndarray, shape: tuple) -> None:
    """Check that numpy, torch and Warp arrays go in and the same kind comes out, and what is refused."""
    torch = pytest.importorskip("torch")
    want = decode(blocks)
    assert isinstance(want, np.ndarray)
    assert want.shape == (len(blocks), *shape)
    from_torch = decode(torch.from_numpy(blocks.copy()))
    assert isinstance(from_torch, torch.Tensor)
    np.testing.assert_array_equal(from_torch.numpy(), want)
    from_warp = decode(wp.array(blocks, dtype=wp.uint8, device="cpu"))
    assert isinstance(from_warp, wp.array)
    np.testing.assert_array_equal(from_warp.numpy(), want)
    # A view that starts at an odd address, as one into the bytes of a file may.
    data = np.zeros(blocks.size + 3, np.uint8)
    data[3:] = blocks.ravel()
    np.testing.assert_array_equal(decode(data[3:].reshape(blocks.shape)), want)
    np.testing.assert_array_equal(decode(blocks[::2]), want[::2])
    assert decode(blocks[:0]).shape == (0, *shape)
    target = wp.empty(want.shape, dtype=wp.dtype_from_numpy(want.dtype), device="cpu")
    assert decode(blocks, out=target) is target
    np.testing.assert_array_equal(target.numpy(), want)
    with pytest.raises(
        ValueError, match=rf"out must be uint8 of shape \({len(blocks)}, .*\) on cpu, got float32 of shape"
    ):
        decode(blocks, out=wp.empty(want.shape, dtype=wp.float32, device="cpu"))
    size = blocks.shape[1]
    with pytest.raises(ValueError, match=rf"blocks must have shape \[N, {size}\], got \({len(blocks)}, {size - 1}\)"):
        decode(blocks[:, 1:])
    with pytest.raises(TypeError, match="blocks must be uint8, got float32; view it as bytes"):
        decode(blocks.astype(np.float32))


def check_cuda(kernel, folder) -> None:
    """Check that the kernel of one lane compiles to PTX, which needs no GPU."""
    wp.init()
    wp.compile_aot_module(kernel.module, arch=80, module_dir=folder, use_ptx=True)
    assert f"{kernel.key.split('.')[-1]}" in "".join(f.read_text(errors="replace") for f in folder.glob("*.ptx"))


@functools.cache
def falcor(folder, name: str):
    """Return (texture, reference picture) of data/bc; the references have their bottom row on top, so it is flipped."""
    import OpenImageIO as oiio

    from warp_neumat.io.dds import read_dds

    as_stored = oiio.ImageSpec()
    as_stored["oiio:UnassociatedAlpha"] = 1
    file = oiio.ImageInput.open(str(folder / "bc" / f"{name}-ref.png"), as_stored)
    picture = file.read_image(oiio.UINT8)
    return read_dds(folder / "bc" / f"{name}.dds"), np.ascontiguousarray(picture[::-1])
