"""The bookkeeping of tiles against plain loops, and a still tile."""

import numpy as np
import pytest
import warp as wp

from warp_neumat.kernels import dispatch
from warp_neumat.kernels.tile_plan import NEVER, ROUGH, STEP, rank_kernel, settle_kernel

TILES = 300


@pytest.fixture
def state(rng):
    """Return what is known of tiles; one in ten was never shaded."""
    shaded = rng.integers(0, 21, TILES)
    shaded[::10] = NEVER
    return {
        "now": rng.random(TILES),
        "then": rng.random(TILES),
        "size": rng.choice([0.0, 0.1, 0.375, 0.4, 0.75, 0.76, 3.0], TILES),
        "shaded": shaded,
        "follow": 0.1 + rng.random(TILES),
        "drift": 0.01 * rng.random(TILES),
        "rough": rng.choice([-1.0, 0.0, 0.002, 0.01, 0.1], TILES),
        "smooth_rate": rng.integers(0, 3, TILES),
        "next_rate": rng.integers(0, 3, TILES),
        "rate": rng.integers(0, 3, TILES),
        "tile_seen": rng.integers(0, 65, TILES),
    }


_TYPES = {"shaded": wp.int32, "smooth_rate": wp.uint8, "next_rate": wp.uint8, "rate": wp.uint8, "tile_seen": wp.uint8}


def _arrays(state, device):
    return {k: wp.array(v, dtype=_TYPES.get(k, wp.float32), device=device) for k, v in state.items()}


@pytest.mark.parametrize("skip", [0, 1])
@pytest.mark.parametrize(("predicts", "minified"), [(0, 1), (1, 1), (1, 0)])
def test_rank_matches_a_plain_loop(state, rng, device, skip, predicts, minified):
    moved, listed = 20, rng.permutation(TILES)[:200].astype(np.int32)
    arrays = _arrays(state, device)
    size_rate = wp.zeros(TILES, dtype=wp.uint8, device=device)
    told = [wp.zeros(TILES, dtype=wp.float32, device=device) for _ in range(5)]
    inputs = [wp.array(listed, device=device), len(listed), moved, skip, predicts, minified, *arrays.values(), 64]
    dispatch.launch(rank_kernel, 4, inputs=inputs, outputs=[size_rate, *told], device=device)
    texels, whole, age, change, kept = (a.numpy()[: len(listed)] for a in told)
    for i, t in enumerate(listed):
        s = {k: v[t].item() for k, v in state.items()}
        finer = s["next_rate"] < s["smooth_rate"]  # a refresh removes what the present rate loses
        least = 0 if skip and not finer else 1
        since = 0 if s["shaded"] == NEVER else max(moved - s["shaded"], least)
        left = 0.25 * max(s["rough"], 0) if s["smooth_rate"] else 0.0
        off = s["follow"] * abs(s["now"] - s["then"]) + s["drift"] * since + left if predicts and since > 0 else 0.0
        assert texels[i] == s["tile_seen"]
        by_size = minified * (2 if 0 < s["size"] <= STEP / 4 else 1 if 0 < s["size"] <= STEP / 2 else 0)
        assert whole[i] == min(s["tile_seen"] * 4 ** max(s["rate"] - by_size, 0), 64 / 4**by_size)
        assert age[i] == since
        assert change[i] == pytest.approx(off, abs=1e-6)
        assert kept[i] == pytest.approx(0.0 if finer else min(left, off), abs=1e-6)
        assert size_rate.numpy()[t] == by_size


def test_settle_matches_a_plain_loop(state, rng, device):
    moved, known, listed = 25, 120, rng.permutation(TILES)[:200].astype(np.int32)
    changed, roughness = rng.random(TILES) - 0.2, rng.choice([-1.0, 0.0, 0.9 * ROUGH, 2 * ROUGH, 5 * ROUGH], TILES)
    arrays = _arrays(state, device)
    inputs = [wp.array(listed, device=device), len(listed), known, moved, arrays["now"]]
    inputs += [wp.array(v, dtype=wp.float32, device=device) for v in (changed, roughness)]
    inputs += [arrays["smooth_rate"], 2, 0.7, 0.001, 64]
    outputs = [arrays[k] for k in ("then", "shaded", "follow", "drift", "rough", "next_rate")]
    dispatch.launch(settle_kernel, 4, inputs=inputs, outputs=outputs, device=device)
    got = {k: arrays[k].numpy() for k in ("then", "shaded", "follow", "drift", "rough", "next_rate")}
    for i, t in enumerate(listed):
        s = {k: v[t].item() for k, v in state.items()}
        follow, drift = (s["follow"], s["drift"]) if i < known else (0.7, 0.001)
        if i < known and changed[t] >= 0:
            step = abs(s["now"] - s["then"])
            if step > 0.01:
                follow = 0.5 * (follow + min(max(changed[t] / step, 0.1), 3.0))
            rest = max(changed[t] - follow * step, 0) / max(moved - s["shaded"], 1)
            drift = 0.5 * (drift + rest)
        rate, rough = s["smooth_rate"], roughness[t]
        rate += -1 if rough > 4 * ROUGH and rate else 1 if 0 <= rough < ROUGH and rate < 2 else 0
        assert got["follow"][t] == pytest.approx(follow, rel=1e-5)
        assert got["drift"][t] == pytest.approx(drift, rel=1e-4, abs=1e-7)
        assert got["then"][t] == np.float32(s["now"])
        assert (got["shaded"][t], got["next_rate"][t]) == (moved, rate)
        assert got["rough"][t] == np.float32(rough)
    rest = np.setdiff1d(np.arange(TILES), listed)
    assert np.array_equal(got["shaded"][rest], state["shaded"][rest])
