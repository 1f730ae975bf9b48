"""Shading of a BCf's decoded maps: what ``kernels/bcf.py`` reads from the textures, through ``kernels/ggx.py``.

A material's channels fill the slots of :data:`SLOTS`; one without a channel holds a constant. The maps are evaluated
once per texel (:attr:`view`), the BRDF once per light. Slots and what glTF 2.0 does with them:

- ``normal``: the shading normal in the texel's tangent frame, +Y up. A viewer below its horizon is raised to
  ``ggx.LEAST_COSINE``; a light below it, or below the frame's own, gives nothing.
- ``specular``: reflectance of the dielectric at normal incidence over 0.08, so that 0.5 is the usual 4 %.
- ``emissive``: radiance that leaves at any angle, added once however many lights there are.

Not used: occlusion, which is meant for ambient light alone, and there is none here; opacity, because nothing is drawn
behind a surface; displacement; and maps of other names.
"""

import dataclasses
import functools
import types

import numpy as np
import warp as wp

from warp_neumat.kernels import bcf, bcf_storage, dispatch, filter
from warp_neumat.kernels.frame import safe_normalize
from warp_neumat.kernels.ggx import above_horizon, ggx, ggx_alpha2, ggx_diffuse, ggx_f0

SLOTS = {
    ("base_color", "r"): 1.0,
    ("base_color", "g"): 1.0,
    ("base_color", "b"): 1.0,
    ("normal", "x"): 0.0,
    ("normal", "y"): 0.0,
    ("roughness", "value"): 1.0,
    ("metallic", "value"): 0.0,
    ("specular", "value"): 0.5,
    ("emissive", "r"): 0.0,
    ("emissive", "g"): 0.0,
    ("emissive", "b"): 0.0,
}
"""Map and component of each slot, with the value it has where the material says nothing (glTF 2.0's defaults)."""

_PLACE = {"r": 0, "g": 1, "b": 2, "x": 0, "y": 1, "value": 0}
_PARAMETERS = 13
_MODULE = {"module": "unique", "module_options": dispatch.module_options()}


LINEAR, SRGB, CONSTANT = 0, 1, 2
"""How a slot's number y becomes its value."""


@dataclasses.dataclass(frozen=True)
class Layout:
    """What a shading kernel is compiled for: the textures and the network. What the channels mean is data."""

    maps: bcf.Layout

    def scratch(self, lanes: int) -> int:
        """Return the float32 words of scratch for one block of ``lanes`` lanes."""
        return self.maps.scratch(lanes) + lanes * (3 + self.maps.channels + len(SLOTS) + _PARAMETERS)


@wp.struct
class Arguments:
    """A material's textures and network, and :func:`slot_program`."""

    maps: bcf.Arguments
    program: wp.array(dtype=wp.float32)


def slot_program(channels, constants) -> np.ndarray:
    """Return what fills the slots, (11, 4) float32: encoding, channel, and the range as lo and hi − lo.

    Args:
        channels: The asset's list of channels: map, component, encoding, range.
        constants: Maps stored as scalars: name → linear values. One value stands for all components.
    """
    program = np.zeros((len(SLOTS), 4), np.float32)
    where = {(c["map"], c["component"]): k for k, c in enumerate(channels)}
    for row, ((name, component), default) in zip(program, SLOTS.items(), strict=True):
        k = where.get((name, component), where.get((name, "value")))
        if k is None:
            values = np.ravel(constants.get(name, default))
            row[:] = CONSTANT, 0, values[min(_PLACE[component], len(values) - 1)], 0
            continue
        encoding, (lo, hi) = channels[k]["encoding"], channels[k]["range"]
        if encoding == "normal":  # 2v − 1 is one more range
            lo, hi = 2 * lo - 1, 2 * hi - 1
        row[:] = SRGB if encoding == "srgb" else LINEAR, k, lo, hi - lo
    return program


def share(layout: Layout, materials: list[Arguments]) -> list[Arguments]:
    """Return the same materials with their textures, level tables and networks in one buffer of each.

    Materials of one layout then have one kernel and one set of buffers, and differ in two offsets and their slots. The
    buffers are copies. Materials too large to number all their texels in 31 bits are given back as they are.
    """
    levels, first = [], 0
    for material in materials:
        table = material.maps.levels.numpy().reshape(-1, filter.RECORD).copy()
        table[:, 4:] += first  # the blocks at which mips begin
        levels.append(table.ravel())
        first += material.maps.texels.size // bcf_storage.BLOCK_BYTES[layout.maps.storage]
    if len(materials) < 2 or first >= 1 << 25:
        return materials
    device = materials[0].maps.texels.device
    texels, weights = (_joined([getattr(m.maps, name) for m in materials]) for name in ("texels", "weights"))
    joined, shared = wp.array(np.concatenate(levels), dtype=wp.int32, device=device), []
    level_at = weight_at = 0
    for material, table in zip(materials, levels, strict=True):
        one = Arguments()
        one.program, one.maps = material.program, bcf.Arguments()
        one.maps.tables = materials[0].maps.tables
        one.maps.texels, one.maps.levels, one.maps.weights = texels, joined, weights
        one.maps.level_at, one.maps.weight_at = level_at, weight_at
        level_at += len(table)
        weight_at += material.maps.weights.size
        shared.append(one)
    return shared


def _joined(arrays: list[wp.array]) -> wp.array:
    """Return flat arrays of one type behind one another."""
    result = wp.empty(sum(a.size for a in arrays), dtype=arrays[0].dtype, device=arrays[0].device)
    start = 0
    for array in arrays:
        wp.copy(result, array, dest_offset=start, count=array.size)
        start += array.size
    return result


@functools.cache
def functions(layout: Layout, lanes: int) -> types.SimpleNamespace:
    """Return the Warp functions of a textured material; ``materials.base.Shader`` says what they take and give.

    Error: a picture differs by at most 8e-4 of its radiance + 0.05 from float64, float16 storage included; held by
    test_screen_space_matches_float64 in tests/pipeline/test_bcf_renderer.py.

    Scratch of a block, float32 words: that of the maps; u, v, level [3][L]; channels [C][L]; slots
    [11][L]; and normal, raised ω_o, α², diffuse colour and F₀, [13][L].
    """
    # Two names, because a constant that is cast keeps the new type in the rest of the kernel.
    L = LANE = lanes
    maps = bcf.make_maps(layout.maps, lanes)
    PLACE = layout.maps.scratch(lanes)
    CHANNELS = PLACE + 3 * lanes
    VALUES = CHANNELS + layout.maps.channels * lanes
    PARAMETERS = VALUES + len(SLOTS) * lanes
    COUNT = layout.maps.channels
    FLOAT = wp.constant(wp.uint64(4))

    @wp.func
    def view(
        material: Arguments,
        place: wp.array(dtype=wp.float32),
        wo: wp.array(dtype=wp.float32),
        active: wp.array(dtype=wp.int32),
        count: int,
        scratch: wp.uint64,
        emitted: wp.array(dtype=wp.float32),
    ):
        y = wp.array(ptr=scratch + wp.uint64(CHANNELS) * FLOAT, shape=(COUNT * L,), dtype=wp.float32)
        at = place.ptr
        if count < L:
            # The maps are evaluated for the first lanes of a block only, so that the others cost nothing.
            packed = wp.array(ptr=scratch + wp.uint64(PLACE) * FLOAT, shape=(3 * L,), dtype=wp.float32)
            for j in range(count):
                l = active[j]
                packed[j] = place[l]
                packed[L + j] = place[L + l]
                packed[2 * L + j] = place[2 * L + l]
            at = packed.ptr
        u = wp.array(ptr=at, shape=(L,), dtype=wp.float32)
        v = wp.array(ptr=at + wp.uint64(LANE) * FLOAT, shape=(L,), dtype=wp.float32)
        lod = wp.array(ptr=at + wp.uint64(2 * L) * FLOAT, shape=(L,), dtype=wp.float32)
        maps(material.maps, u, v, lod, count, scratch, y)
        if count < L:
            for i in range(count):
                j = count - 1 - i  # backwards, because active[j] >= j: nothing is overwritten before it is moved
                l = active[j]
                for c in range(COUNT):
                    y[c * L + l] = y[c * L + j]

        for slot in range(material.program.shape[0] >> 2):
            encoding = material.program[4 * slot]
            channel = wp.uint64(int(material.program[4 * slot + 1]))
            lo = material.program[4 * slot + 2]
            span = material.program[4 * slot + 3]
            row = wp.array(ptr=y.ptr + channel * wp.uint64(LANE) * FLOAT, shape=(L,), dtype=wp.float32)
            to = scratch + wp.uint64(VALUES) * FLOAT + wp.uint64(slot) * wp.uint64(LANE) * FLOAT
            value = wp.array(ptr=to, shape=(L,), dtype=wp.float32)
            if encoding == 0.0:
                for l in range(L):
                    value[l] = lo + span * row[l]
            elif encoding == 1.0:
                for l in range(L):
                    value[l] = bcf.srgb_to_linear(lo + span * row[l])
            else:
                for l in range(L):
                    value[l] = lo

        o = wp.array(ptr=wo.ptr, shape=(3 * L,), dtype=wp.float32)
        out = wp.array(ptr=emitted.ptr, shape=(3 * L,), dtype=wp.float32)
        m = wp.array(ptr=scratch + wp.uint64(VALUES) * FLOAT, shape=(11 * L,), dtype=wp.float32)
        x = wp.array(ptr=scratch + wp.uint64(PARAMETERS) * FLOAT, shape=(13 * L,), dtype=wp.float32)
        for l in range(L):
            n = wp.vec3(m[3 * L + l], m[4 * L + l], 0.0)
            flat = n[0] * n[0] + n[1] * n[1]
            shrink = 1.0 / wp.sqrt(wp.max(flat, 1.0))
            n = wp.vec3(n[0] * shrink, n[1] * shrink, wp.sqrt(wp.max(1.0 - flat, 0.0)))
            viewer = above_horizon(wp.vec3(o[l], o[L + l], o[2 * L + l]), n)
            metallic = m[6 * L + l]
            dielectric = 0.08 * m[7 * L + l]
            for c in range(3):
                x[c * L + l] = n[c]
                x[(3 + c) * L + l] = viewer[c]
                x[(7 + c) * L + l] = ggx_diffuse(m[c * L + l], metallic, dielectric)
                x[(10 + c) * L + l] = ggx_f0(m[c * L + l], metallic, dielectric)
                out[c * L + l] = m[(8 + c) * L + l]
            x[6 * L + l] = ggx_alpha2(m[5 * L + l])

    @wp.func
    def light(
        material: Arguments,
        wi: wp.array(dtype=wp.float32),
        active: wp.array(dtype=wp.int32),
        count: int,
        scratch: wp.uint64,
        value: wp.array(dtype=wp.float32),
    ):
        i = wp.array(ptr=wi.ptr, shape=(3 * L,), dtype=wp.float32)
        out = wp.array(ptr=value.ptr, shape=(3 * L,), dtype=wp.float32)
        x = wp.array(ptr=scratch + wp.uint64(PARAMETERS) * FLOAT, shape=(13 * L,), dtype=wp.float32)
        for l in range(L):
            f = ggx(
                wp.vec3(i[l], i[L + l], i[2 * L + l]),
                wp.vec3(x[3 * L + l], x[4 * L + l], x[5 * L + l]),
                wp.vec3(x[l], x[L + l], x[2 * L + l]),
                x[6 * L + l],
                wp.vec3(x[7 * L + l], x[8 * L + l], x[9 * L + l]),
                wp.vec3(x[10 * L + l], x[11 * L + l], x[12 * L + l]),
            )
            out[l] = f[0]
            out[L + l] = f[1]
            out[2 * L + l] = f[2]

    return types.SimpleNamespace(view=view, light=light, Arguments=Arguments)


@functools.cache
def make_eval_kernel(layout: Layout, lanes: int):
    """Return the kernel behind ``BCf.eval``: uv and pairs of local directions → BRDF × cosine at the finest level."""
    evaluate = functions(layout, lanes)
    view, light = evaluate.view, evaluate.light
    L = lanes
    # Two names, because a constant that is cast keeps the new type in the rest of the kernel.
    TOTAL = STRIDE = eval_scratch(layout, lanes)
    FLOAT = wp.constant(wp.uint64(4))

    @wp.kernel(**_MODULE)
    def bcf_shade_kernel(
        first: int,
        slot: int,
        material: Arguments,
        uv: wp.array(dtype=wp.float32),
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
        Q = wp.array(ptr=own + wp.uint64(9 * L) * FLOAT, shape=(3 * L,), dtype=wp.float32)
        active = wp.array(ptr=own + wp.uint64(12 * L) * FLOAT, shape=(L,), dtype=wp.int32)
        own = own + wp.uint64(16 * L) * FLOAT
        lit = int(0)
        rest = wp.min(count - b * L, L)
        for l in range(L):
            item = b * L + wp.min(l, rest - 1)
            i = safe_normalize(wp.vec3(wi[3 * item], wi[3 * item + 1], wi[3 * item + 2]))
            o = safe_normalize(wp.vec3(wo[3 * item], wo[3 * item + 1], wo[3 * item + 2]))
            for c in range(3):
                I[c * L + l] = i[c]
                O[c * L + l] = o[c]
                Y[c * L + l] = 0.0
            Q[l] = uv[2 * item]
            Q[L + l] = uv[2 * item + 1]
            Q[2 * L + l] = 0.0
            if l < rest and i[2] > 0.0 and o[2] > 0.0:
                active[lit] = l
                lit += 1
        if lit > 0:
            view(material, Q, O, active, lit, own, Y)
            light(material, I, active, lit, own, Y)
        for l in range(L):
            if l < rest:
                above = I[2 * L + l] > 0.0 and O[2 * L + l] > 0.0
                at = 3 * (b * L + l)
                for c in range(3):
                    result[at + c] = wp.where(above, Y[c * L + l], 0.0)

    return bcf_shade_kernel


def eval_scratch(layout: Layout, lanes: int) -> int:
    """Return the float32 words of scratch that :func:`make_eval_kernel`'s kernel needs for one block."""
    return layout.scratch(lanes) + 16 * lanes
