"""The proxy of a material: a few numbers whose changes under small turns follow the material's own.

A scheduler wants to know which texels change visibly before it shades them. It asks ``kernels/proxy.py``: a diffuse
term and one GGX lobe of luminance. What is fitted is not the value but √Y, which the eye's contrast follows more
nearly than Y, Y = π · luminance · value · cosθ_i being what a light of irradiance π leaves (1 for white paper), no
more than :data:`CEILING`. Fitted to are pairs of configurations (l, v) and (l′, v′), one a turn of 1° to 8° from the
other, of the light, the viewer or the surface: half of them with directions uniform over the hemisphere, half with
half vectors from 0.3° to 60° around the normal, uniform in the logarithm of the angle, because a highlight is small.

Loss, over pairs: (Δ√P − Δ√Y)² + (√P − √Y)², P the proxy's Y. For a given α it becomes a non-negative least-squares
problem in diffuse and specular where √P − √Y is written (P − Y) r and r is held, which is iterated; r is not
1/(√P + √Y) but 1/√(√P (√P + √Y)), because then the second term is stationary where the loss is. α comes from a
logarithmic grid, with and without the Fresnel term: taken is the one whose |Δ√P| is closest to |Δ√Y|.

A material that varies over uv is evaluated at :data:`PLACES` places, on a coarse mip if its ``eval`` takes ``lod``:
fitted is the mean √Y, judged the mean |Δ√Y|.
"""

import dataclasses
import inspect
import weakref

import numpy as np
import warp as wp

from warp_neumat.kernels.proxy import ProxyColors, proxy_eval

PAIRS = 1536
"""Pairs of configurations."""
PLACES = 8
"""Places in uv where the material varies."""
COARSE = 2.0
"""Mip level of the evaluation: that of a texel which is seen from some way off."""
ALPHAS = tuple(float(a) for a in np.geomspace(0.01, 1.0, 25))
"""α of the grid; sharper lobes jump from one configuration to the next anyway."""
CEILING = 4.0
"""Largest Y that counts: two stops above white."""

_LUMINANCE = (0.2126, 0.7152, 0.0722)  # of linear Rec. 709
_TURNS = (1.0, 8.0)  # degrees
_HALF_ANGLES = (0.3, 60.0)  # degrees
_CENTRED = 0.3  # weight of a pair around the highlight: a frame has fewer of them than the sample
_LEVEL = 1.0  # weight of √P − √Y
_STEPS = 6
_LEAST = 1e-9  # specular that is 0 but for rounding
_FLOOR = 1e-2  # added to √P: a hundredth of white's √Y is black


@dataclasses.dataclass(frozen=True)
class Proxy:
    """A diffuse term and one GGX lobe, luminance only.

    Attributes:
        diffuse: Albedo of the Lambertian term.
        specular: Factor of the lobe D V: its reflectance at normal incidence.
        roughness: √α, in (0, 1].
        fresnel: Whether the lobe's reflectance rises to 1 at grazing angles.
        luminance: Mean of the material's Y over pairs of uniform directions; 0.5 for white paper.
        error: Root mean square of |Δ√P| − |Δ√Y| over that of Δ√Y: 0 = follows exactly, 1 = no better than no change.
        colors: Diffuse, specular and grazing factor of each channel, with the same lobe.
    """

    diffuse: float
    specular: float
    roughness: float
    fresnel: bool
    luminance: float
    error: float
    colors: tuple[tuple[float, float, float], ...] = ((0.0,) * 3,) * 3

    @property
    def grazing(self) -> float:
        """What is added to ``specular`` at grazing angles, in units of (1 − v·h)⁵."""
        return max(1.0 - self.specular, 0.0) if self.fresnel else 0.0

    @property
    def params(self) -> tuple[float, float, float]:
        """Diffuse, specular (negative with a Fresnel term) and α², as ``kernels.proxy.proxy_value`` takes them."""
        return self.diffuse, -self.specular if self.fresnel else self.specular, self.roughness**4

    @property
    def luminance_terms(self) -> tuple[float, ...]:
        """Diffuse, specular, grazing and α²: the factors of ``kernels.proxy.proxy_terms`` and what it takes."""
        return self.diffuse, self.specular, self.grazing, self.roughness**4

    @property
    def color_terms(self) -> tuple[float, ...]:
        """Diffuse, specular and grazing of red, green and blue, and α²: ten numbers."""
        return (*(value for row in self.colors for value in row), self.roughness**4)


_known: weakref.WeakKeyDictionary = weakref.WeakKeyDictionary()


def proxy_of(material) -> Proxy:
    """Return the proxy of ``material``, fitted when it is first asked for."""
    if material not in _known:
        _known[material] = fit_proxy(material)
    return _known[material]


def fit_proxy(material) -> Proxy:
    """Return the proxy that follows ``material`` best; equal materials get equal ones.

    Args:
        material: Anything with ``eval(uv, wi, wo)`` for numpy rows, giving value × cosθ_i [1/sr], shape [n, 3], as
            :class:`~warp_neumat.materials.base.Material`. Values that are negative or not finite count as 0.

    It evaluates :data:`PAIRS` × 2 rows, or :data:`PLACES` times as many where the material varies over uv. A black
    material gets zeros.
    """
    lights, viewers, weights = turned_pairs(PAIRS)
    targets = _targets(material, lights, viewers)
    if not targets.root.any():
        return Proxy(0.0, 0.0, 1.0, False, 0.0, 0.0)

    def best(alphas):
        return min(_fit(np.asarray(alphas), f, lights, viewers, weights, targets) for f in (False, True))

    alpha = best(ALPHAS)[1]
    between = (ALPHAS[1] / ALPHAS[0]) ** np.linspace(-0.75, 0.75, 7)
    loss, alpha, fresnel, diffuse, specular = best(np.clip(alpha * between, ALPHAS[0], ALPHAS[-1]))
    scale = float(weights @ targets.square)
    error = float(np.sqrt(loss / scale)) if scale > 0 else 0.0
    colors = _fit_colors(targets.colors, alpha, lights, viewers, weights)
    return Proxy(diffuse, specular, float(np.sqrt(alpha)), fresnel and specular > 0, targets.mean, error, colors)


def proxy_colors(proxy: Proxy | None, epsilon: float) -> ProxyColors:
    """Return what the shading kernel takes: ``proxy`` with ``epsilon`` [radiance], or one that says there is none."""
    result = ProxyColors()
    result.alpha2 = 1.0
    if proxy is not None:
        result.diffuse, result.specular, result.grazing = (wp.vec3(*row) for row in proxy.colors)
        result.alpha2, result.epsilon = proxy.roughness**4, epsilon
    return result


def turned_pairs(count: int, sequence=None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return directions before and after a small turn: ω_i and ω_o [2, count, 3] float32, and weights [count].

    Args:
        count: Number of pairs. Even ones have uniform directions, odd ones a half vector near the normal.
        sequence: Numbers in [0, 1), shape [count, 7]; None = an additive recurrence (Roberts 2018).

    Some end below the horizon.
    """
    u = _recurrence(count, 7) if sequence is None else sequence
    viewer, uniform = _upper(u[:, 0], u[:, 1]), _upper(u[:, 2], u[:, 3])
    low, high = np.radians(_HALF_ANGLES)
    half = _upper(np.cos(low * (high / low) ** u[:, 2]), u[:, 3])
    mirrored = 2 * (viewer * half).sum(1, keepdims=True) * half - viewer
    centred = (np.arange(count) % 2 == 1) & (mirrored[:, 2] > 0)
    light = np.where(centred[:, None], mirrored, uniform)
    angle = np.radians(_TURNS[0] + (_TURNS[1] - _TURNS[0]) * u[:, 4])
    axis = _upper(2 * u[:, 5] - 1, u[:, 6])
    what = np.arange(count)[:, None] // 2 % 3  # 0: the light turns, 1: the viewer, 2: the surface, so both
    lights = np.stack([light, np.where(what == 1, light, _turned(light, axis, angle))])
    viewers = np.stack([viewer, np.where(what == 0, viewer, _turned(viewer, axis, angle))])
    return lights.astype(np.float32), viewers.astype(np.float32), np.where(centred, _CENTRED, 1.0)


def _recurrence(count: int, dimensions: int) -> np.ndarray:
    root = 1.5
    for _ in range(40):  # the real root of x^(d+1) = x + 1
        root = (1.0 + root) ** (1.0 / (dimensions + 1))
    return (0.5 + np.arange(1, count + 1)[:, None] * root ** -np.arange(1.0, dimensions + 1)) % 1.0


def _upper(z, turn) -> np.ndarray:
    """Return unit vectors [n, 3] of height ``z`` and azimuth 2π ``turn``."""
    radius, phi = np.sqrt(np.maximum(1 - z * z, 0.0)), 2 * np.pi * turn
    return np.stack([radius * np.cos(phi), radius * np.sin(phi), z], axis=1)


def _turned(vectors, axis, angle) -> np.ndarray:
    """Return ``vectors`` [n, 3] turned about unit ``axis`` by ``angle`` (Rodrigues)."""
    cosine, sine = np.cos(angle)[:, None], np.sin(angle)[:, None]
    along = axis * (axis * vectors).sum(1, keepdims=True)
    return vectors * cosine + np.cross(axis, vectors) * sine + along * (1 - cosine)


@dataclasses.dataclass(frozen=True)
class _Targets:
    """What the material does: root = √Y [2, n]; size and square = |Δ√Y| and (Δ√Y)² [n]; means over the places.

    colors: π · value · cosθ_i of each channel, [2, n, 3], a mean over the places too and without ceiling.
    """

    colors: np.ndarray
    root: np.ndarray
    size: np.ndarray
    square: np.ndarray
    mean: float


def _targets(material, lights, viewers) -> _Targets:
    wi, wo = (np.ascontiguousarray(d.reshape(-1, 3)) for d in (lights, viewers))
    options = {"lod": COARSE} if "lod" in inspect.signature(material.eval).parameters else {}
    uv = _recurrence(PLACES, 2).astype(np.float32)

    def light_of(places, wi, wo):
        """Return the light of each channel, [places, rows, 3]."""
        rows = np.repeat(places, len(wi), axis=0)
        value = material.eval(rows, np.tile(wi, (len(places), 1)), np.tile(wo, (len(places), 1)), **options)
        light = np.pi * np.asarray(value, np.float64)
        return np.maximum(np.where(np.isfinite(light), light, 0.0), 0.0).reshape(len(places), -1, 3)

    few = light_of(uv, wi[:64], wo[:64])
    varies = np.ptp(few, axis=0).max() > 1e-5 * few.max()
    light = light_of(uv if varies else uv[:1], wi, wo)
    y = np.minimum(light @ _LUMINANCE, CEILING)
    root = np.sqrt(y).reshape(len(y), 2, -1)
    change = np.abs(root[:, 1] - root[:, 0])
    uniform = y.reshape(len(y), 2, -1)[:, 0, ::2]
    colors = light.mean(0).reshape(2, -1, 3)
    return _Targets(colors, root.mean(0), change.mean(0), (change**2).mean(0), float(uniform.mean()))


def _fit(alphas, fresnel: bool, lights, viewers, weights, targets: _Targets):
    """Return (loss, α, fresnel, diffuse, specular) of the α [a] that follows best."""
    count, shape = lights[0].shape[0], lights.shape[:2]
    wi, wo = lights.reshape(-1, 3), viewers.reshape(-1, 3)
    params = np.zeros((len(alphas), 2 * count, 3), np.float32)
    params[..., 1], params[..., 2] = 1.0, (alphas * alphas)[:, None]
    tiled = (np.tile(d, (len(alphas), 1)) for d in (wi, wo))
    lobe = np.pi * proxy_eval(params.reshape(-1, 3), (0.0, 0.0, 1.0), *tiled).astype(np.float64)
    lobe = lobe.reshape(len(alphas), *shape)
    cosine = np.where(wo[:, 2] > 0, np.maximum(wi[:, 2], 0.0), 0.0).reshape(shape).astype(np.float64)
    grazing = np.zeros(shape)
    if fresnel:
        grazing = np.maximum(1 - 0.5 * np.linalg.norm(wi + wo, axis=1), 0.0).reshape(shape) ** 5
    target = targets.root**2
    light = np.broadcast_to(target, lobe.shape)
    for _ in range(_STEPS):
        root = np.sqrt(light) + _FLOOR
        rate = 1.0 / np.sqrt(root * (root + targets.root))
        rate = np.where((light >= CEILING) & (target >= CEILING), 0.0, rate)  # both are white: nothing to follow
        # s + (1 − s) w is linear in s but for a constant.
        terms = (cosine, lobe * (1 - grazing), target - lobe * grazing)
        diffuse, specular = _non_negative(*(_rows(rate * term, weights) for term in terms))
        d, s = diffuse[:, None, None], specular[:, None, None]
        rise = np.where(s > _LEAST, np.maximum(1.0 - s, 0.0), 0.0)
        light = np.minimum(d * cosine + (s + rise * grazing) * lobe, CEILING)
    specular = np.where(specular > _LEAST, specular, 0.0)
    change = np.abs(np.diff(np.sqrt(light), axis=1))[:, 0]
    loss = (change * change - 2 * change * targets.size + targets.square) @ weights
    best = int(np.argmin(loss))
    return float(loss[best]), float(alphas[best]), fresnel, float(diffuse[best]), float(specular[best])


def _fit_colors(target, alpha: float, lights, viewers, weights) -> tuple[tuple[float, float, float], ...]:
    """Return diffuse, specular and grazing [3] × channel [3] that follow ``target`` [2, n, 3] best, all at least 0.

    As for luminance, but with the denominators taken from the target alone and the grazing factor free.
    """
    wi, wo = lights.reshape(-1, 3), viewers.reshape(-1, 3)
    lobe = np.pi * proxy_eval((0.0, 1.0, float(alpha) ** 2), (0.0, 0.0, 1.0), wi, wo).astype(np.float64)
    cosine = np.where(wo[:, 2] > 0, np.maximum(wi[:, 2], 0.0), 0.0).astype(np.float64)
    grazing = lobe * np.maximum(1 - 0.5 * np.linalg.norm(wi + wo, axis=1), 0.0) ** 5
    columns = np.stack([cosine, lobe, grazing]).reshape(3, 2, -1)
    result = np.zeros((3, 3))
    for c in range(3):
        wanted = target[None, ..., c]
        rate = np.where(wanted < CEILING, 0.5 / (np.sqrt(wanted) + np.sqrt(_FLOOR)), 0.0)
        basis = np.concatenate([_rows(rate * column[None], weights) for column in columns])
        result[:, c] = _least_squares(basis, _rows(rate * wanted, weights)[0])
    return tuple(tuple(float(v) for v in row) for row in result)


def _least_squares(columns, target) -> np.ndarray:
    """Return x ≥ 0 [k] of least |x columns − target|, by trying every set of columns [k, n]: there are few."""
    gram, right = columns @ columns.T, columns @ target
    best, least = np.zeros(len(columns)), 0.0
    for chosen in range(1, 1 << len(columns)):
        at = [k for k in range(len(columns)) if chosen >> k & 1]
        x = np.linalg.lstsq(gram[np.ix_(at, at)], right[at], rcond=1e-9)[0]
        loss = float(x @ gram[np.ix_(at, at)] @ x - 2 * x @ right[at])
        if (x >= 0).all() and loss < least:
            best, least = np.zeros(len(columns)), loss
            best[at] = x
    return best


def _rows(term, weights) -> np.ndarray:
    """Return the weighted rows of change and level of ``term`` [a, 2, n], as [a, 2n]."""
    change, level = term[:, 1] - term[:, 0], np.sqrt(_LEVEL) * term[:, 0]
    return np.concatenate([change, level], axis=1) * np.tile(np.sqrt(weights), 2)


def _non_negative(a, b, y):
    """Return x₁, x₂ ≥ 0 that minimise |x₁ a + x₂ b − y|² row by row, [r] each, for a, b, y [r, n]."""
    aa, bb, ab, ay, by = ((p * q).sum(1) for p, q in ((a, a), (b, b), (a, b), (a, y), (b, y)))
    alone_a = np.maximum(ay, 0.0) / np.maximum(aa, 1e-30)
    alone_b = np.maximum(by, 0.0) / np.maximum(bb, 1e-30)
    determinant = aa * bb - ab * ab
    regular = determinant > 1e-9 * aa * bb
    safe = np.where(regular, determinant, 1.0)
    x1, x2 = (bb * ay - ab * by) / safe, (aa * by - ab * ay) / safe
    inside = regular & (x1 >= 0) & (x2 >= 0)
    only_a = alone_a * ay >= alone_b * by  # what each takes off |y|² by itself
    return np.where(inside, x1, np.where(only_a, alone_a, 0.0)), np.where(inside, x2, np.where(only_a, 0.0, alone_b))
