"""NeuBRDF evaluation (paper [neubrdf], Eq. 1–4): spherical index grids, a codebook, a small network, and a texture.

Two directions, as the frame gives them (``kernels/neubrdf_frame.py``), select the four corners of their HEALPix pixels;
each corner's index selects a codeword; the weighted sum is the direction's feature. The features of side 0 and side 1,
and a neural texture's where there is one, together enter the network. Here the first layer is *folded into the
codebook*: with ψ = Σ w_t D[S[p_t]], the product W₁ψ equals Σ w_t (W₁D)[S[p_t]], so rows of W₁D, one table for each
side, are summed instead, and a quarter of the network's multiplications disappear. Of the first layer, what depends on
ω_o or the texture alone is computed once for all lights.

Evaluation is written for a block of ``L`` lanes and in two calls: ``view`` once, ``light`` for each light, over a list
of active lanes only. In the half frames both directions depend on the light, so ``light`` looks both up.

Scratch of a block, float32 words (int32 where said): corner places, int32 [4 a side][L], and their weights [4 a
side][L]; rotation [2][L], or in the half frames ω_o, warped half vector and difference vector [9][L]; first-layer sums
[H₁][L] that ``view`` leaves, where it leaves any.
"""

import dataclasses
import functools
import types

import numpy as np
import warp as wp

from warp_neumat.kernels import dispatch, neubrdf_code
from warp_neumat.kernels.approx import exp2
from warp_neumat.kernels.frame import safe_normalize
from warp_neumat.kernels.neubrdf_frame import azimuth_of, corner_function, make_half_frame

PAD = 16
"""Hidden widths are padded with zeros to a multiple of this, the widest float32 register."""

CHANNEL_PAD = 8
"""Channels of a texel are padded with zeros to a multiple of this."""

LOG_LIMIT = 11.0
"""Largest output of the network: log(1 + f) of 59,873 per steradian, below float16's largest number."""

_MODULE = {"module": "unique", "module_options": dispatch.module_options()}


def padded(width: int, unit: int = PAD) -> int:
    """Return ``width`` rounded up to a multiple of ``unit``."""
    return -(-width // unit) * unit


@dataclasses.dataclass(frozen=True)
class Layout:
    """What a kernel is compiled for."""

    hidden: tuple[int, ...] = (64, 64)
    """Hidden widths, at least one."""
    frame: str = "absolute"
    """One of ``neubrdf_frame.FRAMES``."""
    symmetry: str = "none"
    """One of ``neubrdf_frame.SYMMETRIES``; other than ``"none"`` with the half frames only."""
    interpolation: str = "bilinear"
    """One of ``neubrdf_frame.INTERPOLATIONS``."""
    channels: int = 0
    """Channels of the neural texture; 0 = none."""

    @property
    def half(self) -> bool:
        """Whether both sides depend on the light."""
        return self.frame.startswith("half")

    @property
    def rows(self) -> tuple[int, ...]:
        """Padded hidden widths."""
        return tuple(padded(h) for h in self.hidden)

    def both(self, single: bool) -> bool:
        """Whether ``light`` sums the rows of both sides."""
        return self.half or single

    def based(self, single: bool) -> bool:
        """Whether ``view`` leaves sums of the first layer."""
        return not self.both(single) or self.channels > 0

    def scratch(self, lanes: int, single: bool = False) -> int:
        """Return the float32 words of scratch for one block of ``lanes`` lanes; ``single`` as for :func:`functions`."""
        corners, frame = 16 if self.both(single) else 8, 9 if self.half else 2
        return lanes * (corners + frame + (self.rows[0] if self.based(single) else 0))

    @property
    def flops(self) -> int:
        """Operations of one evaluation at one light as executed: folded gathers, hidden and output layers."""
        middle = sum(i * o for i, o in zip(self.rows[:-1], self.rows[1:], strict=True))
        return 2 * ((8 if self.half else 4) * self.rows[0] + middle + 3 * self.rows[-1])


@wp.struct
class Grid:
    """Device arrays of one material; see :func:`fold` and :func:`pack_texture` for their contents."""

    nside: int
    index_0: wp.array(dtype=wp.uint16)
    index_1: wp.array(dtype=wp.uint16)
    table_0: wp.array(dtype=wp.float32)
    table_1: wp.array(dtype=wp.float32)
    weights: wp.array(dtype=wp.float32)
    levels: wp.array(dtype=wp.int32)
    texels: wp.array(dtype=wp.uint16)
    texel_weights: wp.array(dtype=wp.float32)


def fold(codebook, weights, biases, *, interpolation: str = "bilinear") -> dict[str, np.ndarray]:
    """Fold a network's first layer into its codebook and pack the rest for the kernels.

    Args:
        codebook: Codewords, shape [codes, k].
        weights: Weight matrices [out, in] of all layers; the first has 2k inputs, side 0's feature before side 1's,
            and then as many as the texture has channels.
        biases: Bias vectors of all layers.
        interpolation: ``"uniform"`` scales the tables by its weight.

    Returns: ``table_0`` [codes, H₁]; ``table_1`` [codes, H₁] including the first bias (corner weights sum to one);
        ``texel_weights`` [channels padded, H₁]; and ``weights``, the packed further layers: per hidden layer biases
        [H], transposed weights [H_in, H]; then the output's biases [3] and weights [3, H]. All float32, hidden widths
        padded with zeros; the folding itself is done in float64.
    """
    d, k = np.asarray(codebook, np.float64), codebook.shape[1]
    first, hidden = np.asarray(weights[0], np.float64), padded(weights[0].shape[0])
    share = 0.25 if interpolation == "uniform" else 1.0

    def table(part, bias):
        rows = np.zeros((len(d), hidden), np.float32)
        rows[:, : len(first)] = (d @ part.T + bias) * share
        return rows

    texel_weights = np.zeros((padded(first.shape[1] - 2 * k, CHANNEL_PAD), hidden), np.float32)
    texel_weights[: first.shape[1] - 2 * k, : len(first)] = first[:, 2 * k :].T
    packed, width = [], hidden
    for w, b in zip(weights[1:-1], biases[1:-1], strict=True):
        out = padded(w.shape[0])
        bias, matrix = np.zeros(out, np.float32), np.zeros((width, out), np.float32)
        bias[: len(b)] = b
        matrix[: w.shape[1], : w.shape[0]] = np.asarray(w, np.float32).T
        packed += [bias, matrix.ravel()]
        width = out
    last = np.zeros((3, width), np.float32)
    last[:, : weights[-1].shape[1]] = weights[-1]
    packed += [np.asarray(biases[-1], np.float32), last.ravel()]
    return {
        "table_0": table(first[:, :k], 0.0),
        "table_1": table(first[:, k : 2 * k], np.asarray(biases[0], np.float64)),
        "texel_weights": texel_weights,
        "weights": np.concatenate(packed),
    }


def pack_texture(mips) -> tuple[np.ndarray, np.ndarray]:
    """Return (levels, texels) of a neural texture.

    Args:
        mips: Mips from the finest on, each (h, w, c) float16.

    Returns: ``levels``: the number of mips, then width, height and first texel of each, flat int32; ``texels``: the
        bits of the float16 values, mip after mip, row by row, channels padded with zeros, flat uint16.
    """
    levels, texels, first = [len(mips)], [], 0
    for mip in mips:
        height, width, channels = mip.shape
        levels += [width, height, first]
        first += width * height
        wide = np.zeros((height, width, padded(channels, CHANNEL_PAD)), np.float16)
        wide[..., :channels] = mip
        texels.append(wide.ravel())
    return np.array(levels, np.int32), np.concatenate(texels).view(np.uint16)


@functools.cache
def functions(layout: Layout, lanes: int, single: bool = False) -> types.SimpleNamespace:
    """Return the Warp functions that evaluate a material of ``layout``; ``materials.base.Shader`` says what they take.

    ``single`` is for one light a view: the rows of both sides are then summed at once, with no sums kept in between.

    Directions must be unit with z ≥ 0: the caller lists only lanes above the horizon. ``light`` of a homogeneous
    material writes the BRDF [1/sr], of a textured one BRDF × cosine.
    """
    L, H1, half, textured = lanes, layout.rows[0], layout.half, layout.channels > 0
    isotropic, uniform = layout.frame == "isotropic", layout.interpolation == "uniform"
    both = layout.both(single)
    sides = 2 if both else 1
    CORNERS, FRAME = 4 * sides * L, 8 * sides * L
    SUMS = FRAME + (9 if half else 2) * L
    CELLS = 4 * sides * L
    VIEW = 4 * (sides - 1) * L  # where ω_o's corners lie: behind ω_i's, or in their place until the light comes
    FLOAT = wp.constant(wp.uint64(4))
    corners = corner_function(layout.interpolation)
    half_frame = make_half_frame(layout.frame, layout.symmetry)

    @wp.func_native(neubrdf_code.view_code(H1, lanes, uniform))
    def view_sums(
        index_1: wp.array(dtype=wp.uint16),
        table_1: wp.array(dtype=wp.float32),
        place: wp.array(dtype=wp.int32),
        corner: wp.array(dtype=wp.float32),
        active: wp.array(dtype=wp.int32),
        count: int,
        base: wp.array(dtype=wp.float32),
    ): ...

    @wp.func_native(neubrdf_code.texture_code(H1, padded(layout.channels, CHANNEL_PAD), lanes, add=not both))
    def texture_sums(
        levels: wp.array(dtype=wp.int32),
        texels: wp.array(dtype=wp.uint16),
        texel_weights: wp.array(dtype=wp.float32),
        at: wp.array(dtype=wp.float32),
        active: wp.array(dtype=wp.int32),
        count: int,
        base: wp.array(dtype=wp.float32),
    ): ...

    @wp.func_native(
        neubrdf_code.network_code(layout.rows, lanes, both=both, based=layout.based(single), uniform=uniform)
    )
    def network(
        index_0: wp.array(dtype=wp.uint16),
        table_0: wp.array(dtype=wp.float32),
        index_1: wp.array(dtype=wp.uint16),
        table_1: wp.array(dtype=wp.float32),
        weights: wp.array(dtype=wp.float32),
        place: wp.array(dtype=wp.int32),
        corner: wp.array(dtype=wp.float32),
        base: wp.array(dtype=wp.float32),
        active: wp.array(dtype=wp.int32),
        count: int,
        y: wp.array(dtype=wp.float32),
    ): ...

    @wp.func
    def locate(nside: int, at: wp.uint64, turn: wp.uint64, places: wp.uint64, weights: wp.uint64):
        # The arrays are made here, of constant size: through an argument the vectoriser would not see their bounds.
        directions = wp.array(ptr=at, shape=(3 * L,), dtype=wp.float32)
        place = wp.array(ptr=places, shape=(4 * L,), dtype=wp.int32)
        corner = wp.array(ptr=weights, shape=(4 * L,), dtype=wp.float32)
        rotation = wp.array(ptr=turn, shape=(2 * L,), dtype=wp.float32)
        for l in range(L):
            d = wp.vec3(directions[l], directions[L + l], wp.max(directions[2 * L + l], 0.0))
            if wp.static(isotropic):
                c = rotation[l]
                s = rotation[L + l]
                d = wp.vec3(c * d[0] + s * d[1], wp.abs(c * d[1] - s * d[0]), d[2])
            p, w = corners(nside, d)
            place[l] = p[0]
            place[L + l] = p[1]
            place[2 * L + l] = p[2]
            place[3 * L + l] = p[3]
            if wp.static(not uniform):
                corner[l] = w[0]
                corner[L + l] = w[1]
                corner[2 * L + l] = w[2]
                corner[3 * L + l] = w[3]

    @wp.func
    def prepare(
        grid: Grid, wo: wp.array(dtype=wp.float32), active: wp.array(dtype=wp.int32), count: int, scratch: wp.uint64
    ):
        turn = scratch + wp.uint64(FRAME) * FLOAT
        direction = wp.array(ptr=wo.ptr, shape=(3 * L,), dtype=wp.float32)
        if wp.static(half):
            kept = wp.array(ptr=turn, shape=(3 * L,), dtype=wp.float32)
            for l in range(3 * L):
                kept[l] = direction[l]
        else:
            if wp.static(isotropic):
                rotation = wp.array(ptr=turn, shape=(2 * L,), dtype=wp.float32)
                for l in range(L):
                    c, s = azimuth_of(direction[l], direction[L + l])
                    rotation[l] = c
                    rotation[L + l] = s
            own = wp.uint64(VIEW) * FLOAT
            weights = scratch + wp.uint64(CORNERS) * FLOAT
            locate(grid.nside, wo.ptr, turn, scratch + own, weights + own)
            if wp.static(not both):
                place = wp.array(ptr=scratch, shape=(CELLS,), dtype=wp.int32)
                corner = wp.array(ptr=weights, shape=(CELLS,), dtype=wp.float32)
                sums = wp.array(ptr=scratch + wp.uint64(SUMS) * FLOAT, shape=(L * H1,), dtype=wp.float32)
                view_sums(grid.index_1, grid.table_1, place, corner, active, count, sums)

    @wp.func
    def view(
        grid: Grid, wo: wp.array(dtype=wp.float32), active: wp.array(dtype=wp.int32), count: int, scratch: wp.uint64
    ):
        prepare(grid, wo, active, count, scratch)

    @wp.func
    def textured_view(
        grid: Grid,
        at: wp.array(dtype=wp.float32),
        wo: wp.array(dtype=wp.float32),
        active: wp.array(dtype=wp.int32),
        count: int,
        scratch: wp.uint64,
        emitted: wp.array(dtype=wp.float32),
    ):
        prepare(grid, wo, active, count, scratch)
        sums = wp.array(ptr=scratch + wp.uint64(SUMS) * FLOAT, shape=(L * H1,), dtype=wp.float32)
        texture_sums(grid.levels, grid.texels, grid.texel_weights, at, active, count, sums)

    @wp.func
    def light(
        grid: Grid,
        wi: wp.array(dtype=wp.float32),
        active: wp.array(dtype=wp.int32),
        count: int,
        scratch: wp.uint64,
        value: wp.array(dtype=wp.float32),
    ):
        turn = scratch + wp.uint64(FRAME) * FLOAT
        weights = scratch + wp.uint64(CORNERS) * FLOAT
        if wp.static(half):
            i = wp.array(ptr=wi.ptr, shape=(3 * L,), dtype=wp.float32)
            o = wp.array(ptr=turn, shape=(3 * L,), dtype=wp.float32)
            seen = turn + wp.uint64(3 * L) * FLOAT
            pair = wp.array(ptr=seen, shape=(6 * L,), dtype=wp.float32)
            for l in range(L):
                g, d = half_frame(wp.vec3(i[l], i[L + l], i[2 * L + l]), wp.vec3(o[l], o[L + l], o[2 * L + l]))
                for c in range(3):
                    pair[c * L + l] = g[c]
                    pair[(3 + c) * L + l] = d[c]
            locate(grid.nside, seen, turn, scratch, weights)
            further = wp.uint64(4 * L) * FLOAT
            locate(grid.nside, seen + wp.uint64(3 * L) * FLOAT, turn, scratch + further, weights + further)
        else:
            locate(grid.nside, wi.ptr, turn, scratch, weights)
        place = wp.array(ptr=scratch, shape=(CELLS,), dtype=wp.int32)
        corner = wp.array(ptr=weights, shape=(CELLS,), dtype=wp.float32)
        sums = wp.array(ptr=scratch + wp.uint64(SUMS) * FLOAT, shape=(L * H1,), dtype=wp.float32)
        network(
            grid.index_0, grid.table_0, grid.index_1, grid.table_1, grid.weights, place, corner, sums, active, count,
            value,
        )  # fmt: skip
        out = wp.array(ptr=value.ptr, shape=(3 * L,), dtype=wp.float32)
        for l in range(3 * L):
            # exp(y) − 1; a BRDF is not negative.
            e = exp2(wp.min(out[l], LOG_LIMIT) * 1.4426950408889634)
            out[l] = wp.max(e - 1.0, 0.0)
        if wp.static(textured):
            cosine = wp.array(ptr=wi.ptr + wp.uint64(2 * L) * FLOAT, shape=(L,), dtype=wp.float32)
            for c in range(3):
                for l in range(L):
                    out[c * L + l] = out[c * L + l] * cosine[l]

    return types.SimpleNamespace(view=textured_view if textured else view, light=light, Arguments=Grid)


def eval_scratch(layout: Layout, lanes: int) -> int:
    """Return the float32 words of scratch that :func:`make_eval_kernel`'s kernel needs for one block."""
    return layout.scratch(lanes, single=True) + (13 if layout.channels else 10) * lanes


@functools.cache
def make_eval_kernel(layout: Layout, lanes: int):
    """Return the kernel behind ``Material.eval``: pairs of local directions → BRDF × cosine.

    ``uv`` and ``lod`` are read for textured materials only; ``lod_step`` is 1 where each sample has a level of its own,
    0 where all share one.
    """
    evaluate = functions(layout, lanes, single=True)
    view, light = evaluate.view, evaluate.light
    L, textured = lanes, layout.channels > 0
    # Two names, because a constant that is cast keeps the new type in the rest of the kernel.
    TOTAL = STRIDE = eval_scratch(layout, lanes)
    OWN = (13 if textured else 10) * lanes
    FLOAT = wp.constant(wp.uint64(4))

    @wp.kernel(**_MODULE)
    def neubrdf_eval_kernel(
        first: int,
        slot: int,
        grid: Grid,
        uv: wp.array(dtype=wp.float32),
        lod: wp.array(dtype=wp.float32),
        lod_step: int,
        wi: wp.array(dtype=wp.float32),
        wo: wp.array(dtype=wp.float32),
        count: int,
        scratch: wp.array(dtype=wp.float32),
        # outputs
        result: wp.array(dtype=wp.float32),
    ):
        b = first + wp.tid()
        own = scratch.ptr + wp.uint64(slot) * wp.uint64(STRIDE) * FLOAT
        if wp.static(L == 1):
            local = wp.zeros(shape=TOTAL, dtype=wp.float32)
            own = local.ptr
        I = wp.array(ptr=own, shape=(3 * L,), dtype=wp.float32)  # noqa: E741
        O = wp.array(ptr=own + wp.uint64(3 * L) * FLOAT, shape=(3 * L,), dtype=wp.float32)  # noqa: E741
        Y = wp.array(ptr=own + wp.uint64(6 * L) * FLOAT, shape=(3 * L,), dtype=wp.float32)
        active = wp.array(ptr=own + wp.uint64(9 * L) * FLOAT, shape=(L,), dtype=wp.int32)
        Q = wp.array(ptr=own + wp.uint64(10 * L) * FLOAT, shape=(3 * L,), dtype=wp.float32)
        own = own + wp.uint64(OWN) * FLOAT
        rest = wp.min(count - b * L, L)
        offset = wp.uint64(b) * wp.uint64(3 * L) * FLOAT
        if rest == L:  # constant bounds, so that the loop is widened
            A = wp.array(ptr=wi.ptr + offset, shape=(3 * L,), dtype=wp.float32)
            B = wp.array(ptr=wo.ptr + offset, shape=(3 * L,), dtype=wp.float32)
            for l in range(L):
                i = safe_normalize(wp.vec3(A[3 * l], A[3 * l + 1], A[3 * l + 2]))
                o = safe_normalize(wp.vec3(B[3 * l], B[3 * l + 1], B[3 * l + 2]))
                for c in range(3):
                    I[c * L + l] = i[c]
                    O[c * L + l] = o[c]
                    Y[c * L + l] = 0.0
        else:
            for l in range(L):
                at = 3 * (b * L + wp.min(l, rest - 1))
                i2 = safe_normalize(wp.vec3(wi[at], wi[at + 1], wi[at + 2]))
                o2 = safe_normalize(wp.vec3(wo[at], wo[at + 1], wo[at + 2]))
                for c in range(3):
                    I[c * L + l] = i2[c]
                    O[c * L + l] = o2[c]
                    Y[c * L + l] = 0.0
        if wp.static(textured):
            for l in range(L):
                item = b * L + wp.min(l, rest - 1)
                Q[l] = uv[2 * item]
                Q[L + l] = uv[2 * item + 1]
                Q[2 * L + l] = lod[item * lod_step]
        lit = int(0)
        for l in range(L):
            # Written in any case and kept if counted: a branch on random directions is mispredicted half the time.
            active[lit] = l
            lit += wp.where(l < rest and I[2 * L + l] > 0.0 and O[2 * L + l] > 0.0, 1, 0)
        if lit > 0:
            if wp.static(textured):
                view(grid, Q, O, active, lit, own, Y)
            else:
                view(grid, O, active, lit, own)
            light(grid, I, active, lit, own, Y)
        if rest == L:
            R = wp.array(ptr=result.ptr + offset, shape=(3 * L,), dtype=wp.float32)
            for l in range(L):
                for c in range(3):
                    value = Y[c * L + l]
                    if wp.static(not textured):
                        value = value * I[2 * L + l]
                    R[3 * l + c] = wp.where(I[2 * L + l] > 0.0 and O[2 * L + l] > 0.0, value, 0.0)
        else:
            for l in range(rest):
                for c in range(3):
                    last = Y[c * L + l]
                    if wp.static(not textured):
                        last = last * I[2 * L + l]
                    result[3 * (b * L + l) + c] = wp.where(I[2 * L + l] > 0.0 and O[2 * L + l] > 0.0, last, 0.0)

    return neubrdf_eval_kernel
