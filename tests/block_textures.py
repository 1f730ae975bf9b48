"""Random block-compressed textures and broken files, for the tests of DDS and KTX2."""

import numpy as np
from hypothesis import strategies as st

from warp_neumat.io.block_formats import BlockTexture, mip_shape


def random_texture(format: str, width: int, height: int, mips: int = 1, layers: int = 1, seed: int = 0) -> BlockTexture:
    """Return a texture of random bytes."""
    rng = np.random.default_rng(seed)
    levels = [
        [rng.integers(0, 256, mip_shape(format, width, height, m), dtype=np.uint8) for m in range(mips)]
        for _ in range(layers)
    ]
    return BlockTexture(format, width, height, levels)


def assert_same(a: BlockTexture, b: BlockTexture) -> None:
    """Check that two textures are equal in every byte."""
    assert (a.format, a.width, a.height, a.mips, a.layers) == (b.format, b.width, b.height, b.mips, b.layers)
    for x, y in zip(a.levels, b.levels, strict=True):
        for p, q in zip(x, y, strict=True):
            np.testing.assert_array_equal(p, q)


def damage(header_bytes: int):
    """Return a strategy of damages: 32-bit words of the header replaced, and the file cut to a share of its length."""
    words = st.one_of(st.integers(0, 20), st.integers(0, 2**32 - 1), st.sampled_from([2**31, 2**32 - 1, 2**16]))
    edits = st.lists(st.tuples(st.integers(0, header_bytes // 4 - 1), words), max_size=4)
    return st.tuples(edits, st.one_of(st.just(1.0), st.floats(0, 1)))


def damaged(data: bytes, edits, share: float) -> bytes:
    """Return ``data`` with a :func:`damage` done."""
    content = bytearray(data)
    for word, value in edits:
        content[4 * word : 4 * word + 4] = value.to_bytes(4, "little")
    return bytes(content[: round(share * len(content))])
