"""BC6H decoding: blocks of mixed modes and of mode 10 alone, beside bcdec (imagecodecs).

Both decode the same random blocks in turns into an array that exists already. The peer is called once for all blocks,
in the faster of two layouts: a picture 4096 texels wide, or the blocks one below the other, so that its output is
contiguous as ours is. With more than one worker it decodes as many parts at once, one per thread.

``error`` counts the texels that are not bit for bit the peer's. The floor is writing the result, 96 of the 112 bytes
that a block moves: ``floor_share`` is the time to fill that array over the time to decode into it.
"""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import warp as wp

from warp_neumat.kernels import bc6h, dispatch
from warp_neumat.kernels.bc6h_tables import MODES

from .harness import interleave

COLUMNS = [
    "blocks", "signed", "n", "workers", "ms", "mtexel_per_s", "gb_per_s", "floor_share", "error",
    "peer", "peer_ms", "peer_mtexel_per_s", "ratio",
]  # fmt: skip

_CONTENTS = {"all modes": [mode.bits for mode in MODES], "mode 10": [MODES[9].bits]}


def random_blocks(rng, count: int, codes) -> np.ndarray:
    """Return blocks [count, 16] uint8 of random bits whose modes are those of ``codes``, equally often."""
    blocks = rng.integers(0, 256, (count, 16), dtype=np.uint8)
    code = np.array(codes, np.uint8)[rng.integers(0, len(codes), count)]
    keep = (0xFF << np.where(code < 2, 2, 5)).astype(np.uint8)
    blocks[:, 0] = (blocks[:, 0] & keep) | code
    return blocks


class Peer:
    """imagecodecs' decoder on the same blocks: ``call()`` decodes them, ``halves()`` is what came out."""

    def __init__(self, blocks: np.ndarray, signed: bool, wide: bool, pool: ThreadPoolExecutor, workers: int):
        import imagecodecs

        self._decode, self._pool = imagecodecs.bcn_decode, pool
        self._form = imagecodecs.BCN.FORMAT.BC6HS if signed else imagecodecs.BCN.FORMAT.BC6HU
        self._across = 1024 if wide else 1
        self._parts = [
            (part.ravel(), np.empty((4 * len(part) // self._across, 4 * self._across, 3), np.float16))
            for part in np.split(blocks, workers)
        ]

    def _part(self, part) -> None:
        data, out = part
        self._decode(data, self._form, shape=out.shape, out=out)

    def call(self) -> None:
        """Decode all parts."""
        if len(self._parts) == 1:
            self._part(self._parts[0])
        else:
            list(self._pool.map(self._part, self._parts))

    def halves(self) -> np.ndarray:
        """Return the bits of the pixels, shape [n, 4, 4, 3]."""
        rows = [out.reshape(-1, 4, self._across, 4, 3).swapaxes(1, 2).reshape(-1, 4, 4, 3) for _, out in self._parts]
        return np.concatenate(rows).view(np.uint16)


def rows(*, device: str, quick: bool):
    """Yield one row per kind of blocks, signedness and number of workers."""
    everyone = dispatch.worker_count()
    count = (1 << (15 if quick else 18)) // everyone // 1024 * everyone * 1024
    rounds = 3 if quick else 15
    rng = np.random.default_rng(7)
    lanes = dispatch.lanes(device)
    result = wp.empty((count, 4, 4, 3), dtype=wp.float16, device=device)
    floor = np.empty(count * 12, np.uint64)
    before = dispatch._threads
    try:
        with ThreadPoolExecutor(everyone) as pool:
            for workers in sorted({1, everyone}):
                dispatch.set_worker_count(workers)
                for content, codes in _CONTENTS.items():
                    blocks = random_blocks(rng, count, codes)
                    data = wp.array(blocks, dtype=wp.uint8, device=device)
                    for signed in (False, True):
                        job = dispatch.Job(
                            bc6h.make_decode_kernel(signed, lanes),
                            dispatch.blocks(count, lanes) if lanes > 1 else 16 * count,
                            inputs=[data, count],
                            outputs=[result],
                            device=device,
                            grain=bc6h.GRAIN,
                        )

                        def ours(job=job):
                            job.run()
                            wp.synchronize_device(device)

                        peers = {wide: Peer(blocks, signed, wide, pool, workers) for wide in (False, True)}
                        seconds = interleave(
                            {
                                "ours": ours,
                                "floor": lambda: floor.fill(0),
                                False: peers[False].call,
                                True: peers[True].call,
                            },
                            rounds,
                        )
                        wide = seconds[True] < seconds[False]
                        texels = 16e-6 * count
                        differ = result.numpy().view(np.uint16) != peers[wide].halves()
                        yield {
                            "blocks": content,
                            "signed": signed,
                            "n": count,
                            "workers": workers,
                            "ms": 1e3 * seconds["ours"],
                            "mtexel_per_s": texels / seconds["ours"],
                            "gb_per_s": 112e-9 * count / seconds["ours"],
                            "floor_share": seconds["floor"] / seconds["ours"] / workers,
                            "error": int(differ.any(axis=3).sum()),
                            "peer": f"imagecodecs {'picture' if wide else 'column'}",
                            "peer_ms": 1e3 * seconds[wide],
                            "peer_mtexel_per_s": texels / seconds[wide],
                            "ratio": seconds[wide] / seconds["ours"],
                        }
    finally:
        dispatch.set_worker_count(before)
