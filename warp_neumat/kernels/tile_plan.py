"""The bookkeeping of tiles: what a policy is told of those that are seen, and what their shading teaches.

Both are a few operations a tile. They are kernels because thirty array expressions would cost several times as much.
"""

import warp as wp

from warp_neumat.kernels import dispatch

wp.set_module_options(dispatch.module_options())

NEVER = -(1 << 20)
"""When a tile was shaded that never was."""

ROUGH = 0.006
"""Loss of a coarser rate that is accepted [√Y]: half a step of an 8-bit picture in the mid tones, about."""


STEP = wp.constant(1.5)
"""Longest step between anchors [px]: rates are powers of two, so the shortest that is not halved is three quarters."""


@wp.kernel
def rank_kernel(
    first: int,
    listed: wp.array(dtype=wp.int32),
    count: int,
    moved: int,
    skip_unchanged: int,
    predicts: int,
    minified: int,
    now: wp.array(dtype=wp.float32),
    then: wp.array(dtype=wp.float32),
    size: wp.array(dtype=wp.float32),
    shaded: wp.array(dtype=wp.int32),
    follow: wp.array(dtype=wp.float32),
    drift: wp.array(dtype=wp.float32),
    rough: wp.array(dtype=wp.float32),
    smooth_rate: wp.array(dtype=wp.uint8),
    next_rate: wp.array(dtype=wp.uint8),
    rate: wp.array(dtype=wp.uint8),
    tile_seen: wp.array(dtype=wp.uint8),
    per_block: int,
    # outputs
    size_rate: wp.array(dtype=wp.uint8),
    texels: wp.array(dtype=wp.float32),
    whole: wp.array(dtype=wp.float32),
    age: wp.array(dtype=wp.float32),
    change: wp.array(dtype=wp.float32),
    kept: wp.array(dtype=wp.float32),
):
    """Write, for each of the listed tiles in turn, what the policy is told of it.

    ``texels`` it shows, and would show were it not shaded coarsely for being smooth (``whole``); frames since it was
    shaded in which something moved (``age``, 0 for one that was never shaded; at least 1 for one that waits for a finer
    rate, and without ``skip_unchanged``), the predicted ``change`` since, and what of it refreshing would leave
    (``kept``). ``size_rate`` [tile] is the rate that its texels' size on the picture allows, if ``minified``: a step is
    at most :data:`STEP` pixels.
    """
    b = first + wp.tid()
    for i in range(b * per_block, wp.min((b + 1) * per_block, count)):
        t = listed[i]
        s = size[t]
        r = int(0)
        if minified != 0 and s > 0.0 and s <= STEP / 2.0:
            r = wp.where(s <= STEP / 4.0, 2, 1)
        size_rate[t] = wp.uint8(r)
        n = float(tile_seen[t])
        texels[i] = n
        finer = wp.max(int(rate[t]) - r, 0)
        whole[i] = wp.min(n * float(1 << (2 * finer)), 64.0 / float(1 << (2 * r)))
        since = moved - shaded[t]
        if shaded[t] == NEVER:
            since = 0
        elif skip_unchanged == 0 or next_rate[t] < smooth_rate[t]:
            since = wp.max(since, 1)
        age[i] = float(since)
        left = float(0.0)
        if smooth_rate[t] > wp.uint8(0):
            left = 0.25 * wp.max(rough[t], 0.0)
        off = float(0.0)
        if predicts != 0 and since > 0:
            off = follow[t] * wp.abs(now[t] - then[t]) + drift[t] * float(since) + left
        change[i] = off
        kept[i] = wp.where(next_rate[t] < smooth_rate[t], 0.0, wp.min(left, off))


@wp.kernel
def settle_kernel(
    first: int,
    listed: wp.array(dtype=wp.int32),
    count: int,
    known: int,
    moved: int,
    now: wp.array(dtype=wp.float32),
    changed: wp.array(dtype=wp.float32),
    roughness: wp.array(dtype=wp.float32),
    smooth_rate: wp.array(dtype=wp.uint8),
    coarsest: int,
    start_follow: float,
    start_drift: float,
    per_block: int,
    # outputs
    then: wp.array(dtype=wp.float32),
    shaded: wp.array(dtype=wp.int32),
    follow: wp.array(dtype=wp.float32),
    drift: wp.array(dtype=wp.float32),
    rough: wp.array(dtype=wp.float32),
    next_rate: wp.array(dtype=wp.uint8),
):
    """Take note that the listed tiles were shaded: the first ``known`` of them anew, the others for the first time.

    A refresh teaches how the change that shading found follows from what the proxy did and from age; half of what was
    held before stays. A first shading begins with ``start_follow`` and ``start_drift``. Where the anchors lie on
    straight lines to within :data:`ROUGH`, ``next_rate`` is one coarser, up to ``coarsest``; where their step loses
    more than that, estimated as a quarter of what the double step would, it is one finer.
    """
    b = first + wp.tid()
    for i in range(b * per_block, wp.min((b + 1) * per_block, count)):
        t = listed[i]
        if i < known:
            found = changed[t]
            if found >= 0.0:
                step = wp.abs(now[t] - then[t])
                if step > 0.01:
                    follow[t] = 0.5 * (follow[t] + wp.clamp(found / step, 0.1, 3.0))
                rest = wp.max(found - follow[t] * step, 0.0) / float(wp.max(moved - shaded[t], 1))
                drift[t] = 0.5 * (drift[t] + rest)
        else:
            follow[t] = start_follow
            drift[t] = start_drift
        then[t] = now[t]
        shaded[t] = moved
        rough[t] = roughness[t]
        r = int(smooth_rate[t])
        if roughness[t] > 4.0 * ROUGH and r > 0:
            r -= 1
        elif roughness[t] >= 0.0 and roughness[t] < ROUGH and r < coarsest:
            r += 1
        next_rate[t] = wp.uint8(r)
