"""Light on the points of a height field: interreflection for eight lights at a time, and slices gathered from it.

The micro-BRDF at a point with normal n, albedo ρ, and GGX widths α_x, α_y along its tangents (what
``analytic:ggx?…&dim_diffuse=1`` of :mod:`warp_neumat.io.analytic_brdf` is) is

    f = ρ/π (1 − F(n·ω_i)) (1 − F(n·ω_o)) + F(ω_o·h) D V,    F(c) = F₀ + (1 − F₀)(1 − c)⁵,

with D of Walter et al. 2007 and V of Heitz 2014, Eq. 99. Light that bounces is diffuse on every bounce: with
F̄ = F₀ + (1 − F₀)/21, the mean of F over the cosine, a point gathers E = π/B Σ (1 − F̄) G over those of its B rays
that meet a point, and sends G = ρ/π (v (1 − F(n·ω_i)) n·ω_i + (1 − F̄) E), v = 1 where the light reaches it. A texel
of a slice is the mean of (1 − F(n·ω_o)) G + v F D V n·ω_i over the points that its rays see. Left out: light that a
highlight throws on other points, and highlights of light from other points.
"""

from __future__ import annotations

import functools

import numpy as np
import warp as wp

from warp_neumat.kernels import dispatch
from warp_neumat.kernels.height_field import Surface, floats, vectors

wp.set_module_options(dispatch.module_options())

LIGHTS = 8
"""Lights that one pass of interreflection sums together: a vector register of each colour."""

_UNIT = wp.constant(2097151.0)  # 21 bits for each colour of G
_INV_PI = wp.constant(0.318309886183790672)

light_rows = wp.types.vector(length=3 * LIGHTS, dtype=wp.float32)


@functools.cache
def _make_light(lanes: int):
    L = lanes

    @wp.kernel(module="unique", module_options=dispatch.module_options())
    def height_field_direct_kernel(
        first: int,
        lit: wp.array(dtype=wp.int32),
        normal: wp.array(dtype=wp.vec3),
        albedo: wp.array(dtype=wp.vec3),
        f0: wp.array(dtype=wp.float32),
        directions: wp.array(dtype=wp.vec3),
        direction_count: int,
        count: int,
        # outputs
        sent: wp.array(dtype=light_rows),
    ):
        b = first + wp.tid()
        for l in range(L):
            p = b * L + l
            if p < count:
                n = normal[p]
                g = light_rows()
                for k in range(LIGHTS):
                    if k < direction_count:
                        c = wp.max(wp.dot(n, directions[k]), 0.0)
                        weak = 1.0 - wp.min(c, 1.0)
                        through = (1.0 - f0[p]) * (1.0 - weak * weak * weak * weak * weak)
                        e = c * through * float(lit[p * direction_count + k]) * _INV_PI
                        for j in range(3):
                            g[j * LIGHTS + k] = albedo[p][j] * e
                sent[p] = g

    @wp.kernel(module="unique", module_options=dispatch.module_options())
    def height_field_bounce_kernel(
        first: int,
        seen: wp.array(dtype=wp.int32),
        bounces: int,
        albedo: wp.array(dtype=wp.vec3),
        keep: wp.array(dtype=wp.float32),
        sent: wp.array(dtype=light_rows),
        last: wp.array(dtype=light_rows),
        count: int,
        # outputs
        total: wp.array(dtype=light_rows),
    ):
        b = first + wp.tid()
        for l in range(L):
            p = b * L + l
            if p < count:
                e = light_rows()
                for k in range(bounces):
                    q = seen[p * bounces + k]
                    if q >= 0:
                        e = e + last[q] * keep[q]
                e = e * (keep[p] / float(bounces))  # π of the sum and 1/π of the albedo are gone
                g = sent[p]
                for j in range(3):
                    for k in range(LIGHTS):
                        g[j * LIGHTS + k] = g[j * LIGHTS + k] + albedo[p][j] * e[j * LIGHTS + k]
                total[p] = g

    @wp.kernel(module="unique", module_options=dispatch.module_options())
    def height_field_pack_kernel(
        first: int,
        lit: wp.array(dtype=wp.int32),
        total: wp.array(dtype=light_rows),
        direction_count: int,
        count: int,
        # outputs
        packed: wp.array(dtype=wp.uint64),
    ):
        b = first + wp.tid()
        for l in range(L):
            p = b * L + l
            if p < count:
                for k in range(direction_count):
                    word = wp.uint64(0)
                    for j in range(3):
                        level = wp.clamp(total[p][j * LIGHTS + k], 0.0, 1.0) * _UNIT + 0.5
                        word = word | (wp.uint64(wp.uint32(level)) << wp.uint64(21 * j))
                    word = word | (wp.uint64(lit[p * direction_count + k]) << wp.uint64(63))
                    packed[k * count + p] = word

    return height_field_direct_kernel, height_field_bounce_kernel, height_field_pack_kernel


_SLICE = """
const float* __restrict__ table = points.data;
const int* __restrict__ eye = view_table.data + ((size_t)view * texels + texel0) * {S};
typedef unsigned long long word_type;
const word_type* __restrict__ sent = (const word_type*)light_table.data + (size_t)light * texels * {S};
float* __restrict__ out = value.data + ((size_t)pair * texels + texel0) * 3;
const float sx = ix + ox, sy = iy + oy, sz = iz + oz;
const float s2 = wp::max(sx * sx + sy * sy + sz * sz, 1e-12f), inv_s2 = 1.0f / s2;
const float weak_h = wp::max(1.0f - 0.5f * sqrtf(s2), 0.0f), weak_h2 = weak_h * weak_h;
const float schlick_h = weak_h2 * weak_h2 * weak_h;
#ifndef __CUDA_ARCH__
#pragma clang loop vectorize(assume_safety) vectorize_width(8)
#endif
for (int l = 0; l < n; ++l) {
    float red = 0.0f, green = 0.0f, blue = 0.0f, gloss = 0.0f;
#ifndef __CUDA_ARCH__
#pragma clang loop unroll(full)
#endif
    for (int k = 0; k < {S}; ++k) {
        const int p = eye[l * {S} + k];
        const unsigned long long word = sent[p];
        const float* r = table + (size_t)p * 8;
        const float nx = r[0], ny = r[1], tx0 = r[2], ty0 = r[3], ax = r[4], ay = r[5], f0 = r[6];
        const float nz = sqrtf(wp::max(1.0f - nx * nx - ny * ny, 1e-8f));
        // The first tangent: (tx0, ty0, 0) laid onto the surface; the second: n × t.
        const float lean = nx * tx0 + ny * ty0;
        const float shorten = 1.0f / sqrtf(wp::max(1.0f - lean * lean, 1e-8f));
        const float tx = (tx0 - nx * lean) * shorten, ty = (ty0 - ny * lean) * shorten, tz = -nz * lean * shorten;
        const float bx = ny * tz - nz * ty, by = nz * tx - nx * tz, bz = nx * ty - ny * tx;
        const float lz = wp::max(nx * ix + ny * iy + nz * iz, 0.0f);
        const float vz = wp::max(nx * ox + ny * oy + nz * oz, 1e-3f);
        const float lx = ax * (tx * ix + ty * iy + tz * iz), ly = ay * (bx * ix + by * iy + bz * iz);
        const float vx = ax * (tx * ox + ty * oy + tz * oz), vy = ay * (bx * ox + by * oy + bz * oz);
        const float iax = 1.0f / ax, iay = 1.0f / ay;
        const float hx = (tx * sx + ty * sy + tz * sz) * iax, hy = (bx * sx + by * sy + bz * sz) * iay;
        const float hz = nx * sx + ny * sy + nz * sz;
        const float stretch = (hx * hx + hy * hy + hz * hz) * inv_s2;
        const float masking = vz * sqrtf(lx * lx + ly * ly + lz * lz) + lz * sqrtf(vx * vx + vy * vy + vz * vz);
        const float bright = f0 + (1.0f - f0) * schlick_h;
        const float lobe = bright * 0.15915494f * iax * iay * lz / (stretch * stretch * wp::max(masking, 1e-12f));
        const float weak = wp::max(1.0f - vz, 0.0f), weak2 = weak * weak;
        const float through = (1.0f - f0) * (1.0f - weak2 * weak2 * weak);
        const unsigned low = (unsigned)word, high = (unsigned)(word >> 32);
        red += through * (float)(int)(low & 2097151u);
        green += through * (float)(int)((low >> 21) | ((high & 1023u) << 11));
        blue += through * (float)(int)((high >> 10) & 2097151u);
        gloss += (high >> 31) ? lobe : 0.0f;
    }
    out[3 * l] = (red * 4.7683738e-07f + gloss) * {SHARE}f;
    out[3 * l + 1] = (green * 4.7683738e-07f + gloss) * {SHARE}f;
    out[3 * l + 2] = (blue * 4.7683738e-07f + gloss) * {SHARE}f;
}
"""


@functools.cache
def _make_slice(lanes: int, sub: int):
    L = lanes

    # Native, because only a pragma tells the compiler that slices do not overlap the tables they are gathered from.
    @wp.func_native(_SLICE.replace("{SHARE}", repr(1.0 / sub**2)).replace("{S}", str(sub**2)))
    def shade_texels(
        n: int,
        texel0: int,
        texels: int,
        pair: int,
        light: int,
        view: int,
        ix: float,
        iy: float,
        iz: float,
        ox: float,
        oy: float,
        oz: float,
        light_table: wp.array(dtype=wp.uint64),
        view_table: wp.array(dtype=wp.int32),
        points: wp.array(dtype=wp.float32),
        value: wp.array(dtype=wp.float32),
    ): ...

    @wp.kernel(module="unique", module_options=dispatch.module_options())
    def height_field_slice_kernel(
        first: int,
        slots: wp.array(dtype=wp.vec2i),
        lights: wp.array(dtype=wp.vec3),
        views: wp.array(dtype=wp.vec3),
        light_table: wp.array(dtype=wp.uint64),
        view_table: wp.array(dtype=wp.int32),
        points: wp.array(dtype=wp.float32),
        texels: int,
        per_slice: int,
        # outputs
        value: wp.array(dtype=wp.float32),
    ):
        b = first + wp.tid()
        pair = b / per_slice
        texel0 = (b - pair * per_slice) * L
        slot = slots[pair]
        i = lights[slot[0]]
        o = views[slot[1]]
        shade_texels(
            wp.min(L, texels - texel0), texel0, texels, pair, slot[0], slot[1], i[0], i[1], i[2], o[0], o[1], o[2],
            light_table, view_table, points, value,
        )  # fmt: skip

    return height_field_slice_kernel


def cosine_directions(count: int) -> np.ndarray:
    """Return cosine-distributed directions, [4 ⌈count/4⌉, 3] float32, the same set when mirrored in x or in y.

    A Fibonacci spiral over a quarter of the unit disk, lifted to the hemisphere (Malley's method), and its mirror
    images: with them, a field that is symmetric gives slices that are.
    """
    quarter = -(-count // 4)
    k = np.arange(quarter)
    radius, turn = np.sqrt((k + 0.5) / quarter), ((k + 0.5) * 0.6180339887498949) % 1.0 * (np.pi / 2)
    x, y = radius * np.cos(turn), radius * np.sin(turn)
    z = np.sqrt(np.maximum(1.0 - radius * radius, 0.0))
    return np.concatenate([np.stack([i * x, j * y, z], 1) for i in (1, -1) for j in (1, -1)]).astype(np.float32)


class Optics:
    """What the points of a :class:`Surface` reflect, on its device.

    Args:
        field: The surface.
        albedo: ρ of the points, shape [points, 3], in [0, 1].
        alpha: α_x and α_y of the points, shape [points, 2], at least 1e-3.
        f0: F₀ of the points, shape [points].
    """

    def __init__(self, field: Surface, albedo, alpha, f0):
        self.field, device = field, field.device
        f0 = np.asarray(f0, np.float32)
        self.albedo = vectors(albedo, device)
        self.f0 = wp.array(f0, dtype=wp.float32, device=device)
        self.keep = wp.array((1.0 - f0) * np.float32(20.0 / 21.0), dtype=wp.float32, device=device)
        turn = np.stack([np.cos(field.angle), np.sin(field.angle)], 1)
        table = np.concatenate([field.normal.numpy()[:, :2], turn, alpha, f0[:, None], f0[:, None]], 1)
        self._points = floats(table, device)
        rows = lambda: wp.zeros(field.points, dtype=light_rows, device=device)  # noqa: E731
        self._sent, self._total, self._last = rows(), rows(), rows()

    def light_tables(self, directions, lit: np.ndarray, seen: wp.array, bounces: int, passes: int) -> np.ndarray:
        """Return G and v of every point under up to :data:`LIGHTS` lights, [lights, points] uint64.

        Bits 0–20, 21–41 and 42–62 hold the colours of G in steps of 1/(2²¹ − 1), bit 63 v.

        Args:
            directions: ω_i, shape [lights, 3].
            lit: :func:`~warp_neumat.kernels.height_field.trace_lights` of them.
            seen: :func:`~warp_neumat.kernels.height_field.trace_bounces`, flat, on the device.
            bounces: Directions in ``seen``.
            passes: Bounces of light.

        Error: G against float64, at most 1e-6; held by
            test_a_light_in_a_closed_pit_comes_to_the_series_of_its_bounces.
        """
        count, device = self.field.points, self.field.device
        lanes = dispatch.lanes(device)
        blocks = dispatch.blocks(count, lanes)
        direct, bounce, pack = _make_light(lanes)
        lit = wp.array(lit.ravel(), dtype=wp.int32, device=device)
        lights = vectors(directions, device)
        inputs = [lit, self.field.normal, self.albedo, self.f0, lights, len(directions), count]
        dispatch.launch(direct, blocks, inputs, [self._sent], device=device)
        last, other = self._sent, self._total
        for _ in range(passes):
            inputs = [seen, bounces, self.albedo, self.keep, self._sent, last, count]
            dispatch.launch(bounce, blocks, inputs, [other], device=device)
            last, other = other, self._last if other is self._total else self._total
        packed = wp.empty(len(directions) * count, dtype=wp.uint64, device=device)
        dispatch.launch(pack, blocks, [lit, last, len(directions), count], [packed], device=device)
        return packed.numpy().reshape(len(directions), count)

    def slices(self, slots, lights, views, light_table: wp.array, view_table: wp.array) -> np.ndarray:
        """Return value × cos θ_i [1/sr] of pairs, shape [pairs, rows, width, 3], float32.

        Args:
            slots: Rows of ``lights`` and ``light_table``, and of ``views`` and ``view_table``: [pairs, 2].
            lights: Directions ω_i that the rows of ``light_table`` belong to, shape [l, 3].
            views: Directions ω_o that the rows of ``view_table`` belong to, shape [v, 3].
            light_table: :meth:`light_tables`, flat, on the device.
            view_table: :func:`~warp_neumat.kernels.height_field.trace_views`, flat, on the device.

        Error: against float64 with the same points seen and lit, at most 2e-6 + 2e-5 of the value; held by
            test_slices_match_paths_traced_one_by_one and test_a_flat_field_is_its_brdf.
        """
        field, lanes = self.field, dispatch.lanes(self.field.device)
        texels = field.width * field.rows
        per_slice = dispatch.blocks(texels, lanes)
        value = wp.empty(len(slots) * texels * 3, dtype=wp.float32, device=field.device)
        inputs = [
            wp.array(np.ascontiguousarray(slots, np.int32), dtype=wp.vec2i, device=field.device),
            vectors(lights, field.device), vectors(views, field.device), light_table, view_table, self._points,
            texels, per_slice,
        ]  # fmt: skip
        kernel = _make_slice(lanes, field.sub)
        dispatch.launch(kernel, len(slots) * per_slice, inputs, [value], device=field.device)
        return value.numpy().reshape(len(slots), field.rows, field.width, 3)
