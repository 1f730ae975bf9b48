"""BCf evaluation (paper [bcf], Eq. 3, 10, 11): block-compressed feature textures, trilinear filtering, a small network.

For use inside other kernels: :func:`make_maps` gives, for a :class:`Layout` and a number of lanes, the Warp function

    ``maps(arguments, u, v, lod, count, scratch, y)``

which evaluates the first ``count`` lanes of a block: ``u``, ``v``, ``lod`` are float32 arrays of ``L`` lanes, ``y``
receives ``[channels][L]`` float32 clamped to [0, 1] (lanes from ``count`` on hold nothing of meaning), and ``scratch``
is the address (uint64) of ``Layout.scratch(lanes)`` float32 words of this worker's own.
``arguments`` is an :class:`Arguments`: several materials may share its texel, level and weight buffers, and differ in
``level_at`` and ``weight_at`` only. ``lod`` is the mip level of the reference material, as in ``Material.maps``.

What the channels mean (encoding, range, map) is for the caller to resolve: :func:`srgb_to_linear` is the one function
that is not plain arithmetic.

Texels are decoded where they are sampled: :mod:`~.bcf_storage` says in which three ways they may lie in memory, and all
give the same features, bit for bit. :mod:`~.filter` finds taps and weights, :mod:`~.bcf_texel` fetches.
"""

import dataclasses
import functools

import numpy as np
import warp as wp

from warp_neumat.kernels import bcf_storage, bcf_texel, dispatch, filter
from warp_neumat.kernels.approx import exp2
from warp_neumat.kernels.mlp import MLPShape, make_mlp

STORAGES = ("blocks", "unquantised", "half")
"""How features may lie in memory; see :mod:`warp_neumat.kernels.bcf_storage`."""

_MODULE = {"module": "unique", "module_options": dispatch.module_options()}


@dataclasses.dataclass(frozen=True)
class Layout:
    """What a kernel is compiled for.

    Attributes:
        textures: Number of feature textures T.
        hidden: Width of the hidden layer; 0 = there is no network, and the features are the outputs.
        channels: Outputs of the network; without one, 3T.
        wrap: One of ``filter.WRAPS``.
        signed: Whether blocks are BC6H_SF16.
        storage: One of :data:`STORAGES`, or ``"rgba8"`` for textures of plain 8-bit values, v/255.

    Raises:
        ValueError: If there is no network, and not as many channels as features.
    """

    textures: int = 4
    hidden: int = 16
    channels: int = 9
    wrap: str = "repeat"
    signed: bool = False
    storage: str = "unquantised"

    def __post_init__(self):
        if not self.hidden and self.channels != 3 * self.textures:
            raise ValueError(f"{self.textures} textures without a network have 3 channels each, got {self.channels}")

    @property
    def shape(self) -> MLPShape:
        """Sizes of the network."""
        return MLPShape(3 * self.textures, self.hidden, self.channels)

    def scratch(self, lanes: int) -> int:
        """Return the float32 words of scratch for one block of ``lanes`` lanes."""
        return 3 * self.textures * lanes if self.hidden else 0


@wp.struct
class Arguments:
    """Device arrays of one material, or of several that share them.

    Attributes:
        texels: Feature textures in their storage, bytes.
        tables: ``bcf_storage.packed_tables``.
        levels: Level tables (``filter.level_table``); this material's begins at word ``level_at``.
        weights: Packed networks (``mlp.pack``); this material's begins at word ``weight_at``.
    """

    texels: wp.array(dtype=wp.uint8)
    tables: wp.array(dtype=wp.uint8)
    levels: wp.array(dtype=wp.int32)
    level_at: int
    weights: wp.array(dtype=wp.float32)
    weight_at: int


@functools.cache
def make_sampler(textures: int, wrap: str, signed: bool, storage: str, lanes: int):
    """Return ``sample(texels, tables, levels, level_at, u, v, lod, count, x)``: trilinear features [3T][L] of a block.

    Error: at most 2e-6 of the texture's largest texel at sides to 33 texels, and about 2⁻²⁴ of a texture's side in
    texels beyond, which is what float32 texture coordinates lose; held by test_features_match_float64.
    """
    tables = "".join(
        f"const {kind}* const {name} = (const {kind}*)(tables.data + {bcf_storage.OFFSETS[name]});"
        for name, kind in {
            "fac": "int", "region": "unsigned char", "facts": "int", "anchor": "unsigned char",
            "modes": "unsigned char", "ends": "short", "mode_rows": "unsigned char", "loose": "short",
            "nibbles": "unsigned long long",
        }.items()
        if storage == "blocks" or (name == "fac" and storage == "unquantised")
    )  # fmt: skip
    head = f"const unsigned char* const tx = texels.data; const int* const lv = levels.data + level_at; {tables}"
    plain = filter.scalar_code(textures, lanes, wrap, bcf_texel.scalar_fetch(storage, signed))
    code = plain
    if lanes > 1:
        wide = filter.vector_code(
            textures, lanes, wrap, bcf_texel.vector_fetch(storage, signed), paired=storage == "half"
        )
        code = f"#if defined(__AVX2__) && defined(__F16C__) && defined(__BMI2__)\n{wide}\n#else\n{plain}\n#endif\n"

    @wp.func_native(f"{head}\n{code}")
    def sample(
        texels: wp.array(dtype=wp.uint8),
        tables: wp.array(dtype=wp.uint8),
        levels: wp.array(dtype=wp.int32),
        level_at: int,
        u: wp.array(dtype=wp.float32),
        v: wp.array(dtype=wp.float32),
        lod: wp.array(dtype=wp.float32),
        count: int,
        x: wp.array(dtype=wp.float32),
    ): ...

    return sample


@functools.cache
def make_maps(layout: Layout, lanes: int):
    """Return the Warp function ``maps`` for blocks of ``lanes`` lanes; the head of this file says how to call it.

    Error: at most 5e-6 against float64 with features to 180, 3e-7 with features of order one; held by
    test_encoded_matches_float64.
    """
    sample = make_sampler(layout.textures, layout.wrap, layout.signed, layout.storage, lanes)
    if not layout.hidden:
        return _features_alone(sample, layout.channels * lanes)
    shape = layout.shape
    mlp = make_mlp(shape, lanes)
    FEATURES, OUTPUTS, PARAMETERS = shape.inputs * lanes, shape.outputs * lanes, shape.parameters
    FLOAT = wp.constant(wp.uint64(4))

    @wp.func
    def maps(
        arguments: Arguments,
        u: wp.array(dtype=wp.float32),
        v: wp.array(dtype=wp.float32),
        lod: wp.array(dtype=wp.float32),
        count: int,
        scratch: wp.uint64,
        y: wp.array(dtype=wp.float32),
    ):
        X = wp.array(ptr=scratch, shape=(FEATURES,), dtype=wp.float32)
        W = wp.array(
            ptr=arguments.weights.ptr + wp.uint64(arguments.weight_at) * FLOAT, shape=(PARAMETERS,), dtype=wp.float32
        )
        sample(
            arguments.texels, arguments.tables, arguments.levels, arguments.level_at, u, v, lod, count, X
        )  # fmt: skip
        mlp(X, W, y)
        Y = wp.array(ptr=y.ptr, shape=(OUTPUTS,), dtype=wp.float32)
        for i in range(OUTPUTS):
            Y[i] = wp.clamp(Y[i], 0.0, 1.0)

    return maps


def _features_alone(sample, size: int):
    """Return the Warp function ``maps`` of a material without a network; ``size`` is channels × lanes."""
    SIZE = size

    @wp.func
    def maps(
        arguments: Arguments,
        u: wp.array(dtype=wp.float32),
        v: wp.array(dtype=wp.float32),
        lod: wp.array(dtype=wp.float32),
        count: int,
        scratch: wp.uint64,
        y: wp.array(dtype=wp.float32),
    ):
        sample(arguments.texels, arguments.tables, arguments.levels, arguments.level_at, u, v, lod, count, y)
        Y = wp.array(ptr=y.ptr, shape=(SIZE,), dtype=wp.float32)
        for i in range(SIZE):
            Y[i] = wp.clamp(Y[i], 0.0, 1.0)

    return maps


@wp.func
def srgb_to_linear(v: float) -> float:
    """Return the linear value of an sRGB-encoded one (IEC 61966-2-1), also beyond 1.

    Error: at most 1e-6 relative; held by test_srgb_to_linear_matches_float64.
    """
    t = wp.max((v + 0.055) * 0.94786729857, 0.01)
    bits = wp.cast(t, wp.int32)
    # log₂ t: the mantissa lies in [√½, √2), where atanh's series converges fast.
    exponent = (bits - 0x3F3504F3) >> 23
    m = wp.cast(bits - (exponent << 23), wp.float32)
    s = (m - 1.0) / (m + 1.0)
    s2 = s * s
    p = (((s2 * 0.111111111 + 0.142857143) * s2 + 0.2) * s2 + 0.333333333) * s2 + 1.0
    return wp.where(v <= 0.04045, v * 0.0773993808, exp2(2.4 * (float(exponent) + 2.8853900818 * s * p)))


LINEAR, SRGB, NORMAL, NORMAL_Z = 0, 1, 2, 3
"""What the columns of a map are made from; see :func:`make_eval_kernel`."""

PROGRAM = wp.constant(10)
"""Words that describe a column."""


# A block's samples to lanes; those beyond the last repeat it.
_TAKE = """
if (rest >= LANES) {
    _Pragma("clang loop unroll_count(8)")
    for (int l = 0; l < LANES; ++l) { u.data[l] = uv.data[2 * l]; v.data[l] = uv.data[2 * l + 1]; }
} else {
    for (int l = 0; l < LANES; ++l) {
        const int at = 2 * (l < rest ? l : rest - 1);
        u.data[l] = uv.data[at]; v.data[l] = uv.data[at + 1];
    }
}
for (int l = 0; l < LANES; ++l) s.data[l] = lods.data[lod_step ? (l < rest ? l : rest - 1) : 0];
"""

# A column of a block to every width-th word.
_PUT = """
float* out = result.data;
if (rest >= LANES) {
    _Pragma("clang loop unroll_count(8)")
    for (int l = 0; l < LANES; ++l, out += width) *out = x.data[l];
} else {
    for (int l = 0; l < rest; ++l, out += width) *out = x.data[l];
}
"""


@functools.cache
def _make_moves(lanes: int):
    """Return the Warp functions ``take(uv, lods, lod_step, rest, u, v, s)`` and ``put(x, rest, width, result)``."""

    @wp.func_native(_TAKE.replace("LANES", str(lanes)))
    def take(
        uv: wp.array(dtype=wp.float32),
        lods: wp.array(dtype=wp.float32),
        lod_step: int,
        rest: int,
        u: wp.array(dtype=wp.float32),
        v: wp.array(dtype=wp.float32),
        s: wp.array(dtype=wp.float32),
    ): ...

    @wp.func_native(_PUT.replace("LANES", str(lanes)))
    def put(x: wp.array(dtype=wp.float32), rest: int, width: int, result: wp.array(dtype=wp.float32)): ...

    return take, put


@functools.cache
def make_eval_kernel(layout: Layout, lanes: int):
    """Return the kernel behind ``MapMaterial.encoded`` and ``MapMaterial.maps``.

    ``columns`` rows of :data:`PROGRAM` words say what is written for each sample: encoding (:data:`LINEAR` …
    NORMAL_Z); the channel, and for normals the other component's channel; first column of the map among all columns,
    columns of the map, place in it; low end and span of both channels' ranges as float bits. Map by map, ``result``
    holds [n, k].
    """
    maps = make_maps(layout, lanes)
    take, put = _make_moves(lanes)
    C, L, LANE = layout.channels, lanes, lanes
    # Two names, because a constant that is cast keeps the new type in the rest of the kernel.
    OWN, FIXED = layout.scratch(lanes), (3 + C) * lanes
    STRIDE = TOTAL = OWN + FIXED
    FLOAT = wp.constant(wp.uint64(4))

    @wp.kernel(**_MODULE)
    def bcf_eval_kernel(
        first: int,
        slot: int,
        arguments: Arguments,
        uv: wp.array(dtype=wp.float32),
        lods: wp.array(dtype=wp.float32),
        lod_step: int,
        count: int,
        program: wp.array(dtype=wp.int32),
        columns: int,
        scratch: wp.array(dtype=wp.float32),
        # outputs
        result: wp.array(dtype=wp.float32),
    ):
        b = first + wp.tid()
        own = scratch.ptr + wp.uint64(slot) * wp.uint64(STRIDE) * FLOAT
        if wp.static(L == 1):
            local = wp.zeros(shape=TOTAL, dtype=wp.float32)
            own = local.ptr
        U = wp.array(ptr=own, shape=(L,), dtype=wp.float32)
        V = wp.array(ptr=own + wp.uint64(LANE) * FLOAT, shape=(L,), dtype=wp.float32)
        S = wp.array(ptr=own + wp.uint64(2 * L) * FLOAT, shape=(L,), dtype=wp.float32)
        Y = wp.array(ptr=own + wp.uint64(3 * L) * FLOAT, shape=(C * L,), dtype=wp.float32)
        rest = wp.min(count - b * L, L)
        begin = wp.uint64(b) * wp.uint64(LANE) * FLOAT
        A = wp.array(ptr=uv.ptr + begin + begin, shape=(2 * L,), dtype=wp.float32)
        B = wp.array(ptr=lods.ptr + begin * wp.uint64(lod_step), shape=(L,), dtype=wp.float32)
        take(A, B, lod_step, rest, U, V, S)
        maps(arguments, U, V, S, rest, own + wp.uint64(FIXED) * FLOAT, Y)
        for j in range(columns):
            kind = program[PROGRAM * j]
            X = wp.array(ptr=Y.ptr + wp.uint64(program[PROGRAM * j + 1] * L) * FLOAT, shape=(L,), dtype=wp.float32)
            T = wp.array(ptr=Y.ptr + wp.uint64(program[PROGRAM * j + 2] * L) * FLOAT, shape=(L,), dtype=wp.float32)
            width = program[PROGRAM * j + 4]
            low = wp.cast(program[PROGRAM * j + 6], wp.float32)
            span = wp.cast(program[PROGRAM * j + 7], wp.float32)
            low2 = wp.cast(program[PROGRAM * j + 8], wp.float32)
            span2 = wp.cast(program[PROGRAM * j + 9], wp.float32)
            # U is free by now: it holds the column.
            if kind == SRGB:
                for l in range(L):
                    U[l] = srgb_to_linear(low + span * X[l])
            elif kind == LINEAR:
                for l in range(L):
                    U[l] = low + span * X[l]
            else:
                for l in range(L):
                    p = 2.0 * (low + span * X[l]) - 1.0
                    q = 2.0 * (low2 + span2 * T[l]) - 1.0
                    r = p * p + q * q
                    z = wp.sqrt(wp.max(1.0 - r, 0.0))
                    U[l] = wp.where(kind == NORMAL, p, z) / wp.max(wp.sqrt(r + z * z), 1.0e-30)
            place = count * program[PROGRAM * j + 3] + program[PROGRAM * j + 5] + width * b * L
            R = wp.array(ptr=result.ptr + wp.uint64(place) * FLOAT, shape=(L,), dtype=wp.float32)
            put(U, rest, width, R)

    return bcf_eval_kernel


def device_arrays(arrays: dict[str, np.ndarray], device) -> Arguments:
    """Return :class:`Arguments` with copies of ``arrays`` (by attribute) on ``device`` and both offsets 0."""
    result = Arguments()
    for name, dtype in {
        "texels": wp.uint8, "tables": wp.uint8, "levels": wp.int32, "weights": wp.float32,
    }.items():  # fmt: skip
        setattr(result, name, wp.array(arrays[name], dtype=dtype, device=device))
    result.level_at = result.weight_at = 0
    return result
