"""When tiles are due: choices against plain sorting, budgets, ages, and the spread of the work over frames."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from warp_neumat.pipeline.policy import (
    POLICIES,
    Adaptive,
    Budget,
    Staggered,
    Tiles,
    affordable,
    flip_of,
    make_policy,
    needed,
)

VALUES = st.floats(-1, 1e8, width=32) | st.sampled_from([0.0, 1.0, 1e-38, 1e6])
ROWS = st.lists(st.tuples(VALUES, st.integers(0, 9)), max_size=60)


def _order(value):
    return np.argsort(-np.maximum(np.float32(value), 0), kind="stable")


@settings(deadline=None, max_examples=300)
@given(ROWS, st.integers(0, 300))
def test_affordable_is_the_longest_prefix_of_the_sorted_tiles(rows, budget):
    value, cost = np.array(rows, np.float64).reshape(-1, 2).T
    order = _order(value)
    count = np.searchsorted(np.cumsum(cost[order]), budget, side="right")
    expected = np.zeros(len(value), bool)
    expected[order[:count]] = True
    assert np.array_equal(affordable(value, cost, float(budget)), expected)


@settings(deadline=None, max_examples=300)
@given(ROWS, st.integers(1, 300))
def test_needed_is_the_shortest_prefix_that_reaches_the_aim(rows, aim):
    value, gain = np.array(rows, np.float64).reshape(-1, 2).T
    order = _order(value)
    count = np.searchsorted(np.cumsum(gain[order]), aim) + 1
    expected = np.zeros(len(value), bool)
    expected[order[:count]] = True
    assert np.array_equal(needed(value, gain, float(aim)), expected)


def test_thousands_of_tiles_are_chosen_as_by_sorting(rng):
    for scale in (1e-6, 1.0, 1e6):
        value = scale * rng.lognormal(0, 3, 20_000) * rng.integers(0, 2, 20_000)
        cost = rng.integers(0, 64, 20_000).astype(np.float64)
        for budget in rng.uniform(0, 1.1 * cost.sum(), 5):
            order = _order(value)
            expected = np.zeros(len(value), bool)
            expected[order[np.cumsum(cost[order]) <= budget]] = True
            assert np.array_equal(affordable(value, cost, budget), expected)


def _tiles(rng, count, *, new=0.0, **given):
    cost = rng.integers(1, 65, count).astype(np.float64)
    fields = {
        "index": np.arange(count),
        "pixels": rng.integers(1, 200, count),
        "cost": cost,
        "age": rng.integers(1, 12, count),
        "change": rng.exponential(0.02, count),
        "new": new,
        "whole": float(cost.sum()),
        "picture": 200 * count,
        "moved": True,
        "tie": rng.random(count),
    }
    return Tiles(**fields | given)


@pytest.mark.parametrize("name", ["staggered", "adaptive"])
@pytest.mark.parametrize("new", [0.0, 700.0, 5000.0])
def test_a_budget_is_kept_and_used(rng, name, new):
    tiles = _tiles(rng, 2000, new=new)
    for budget in (1.0, 900.0, 20_000.0, 1e9):
        spent = tiles.cost[make_policy(name, 4, budget=budget).choose(tiles)].sum()
        left = max(0.0, budget - new)
        assert spent <= left
        assert spent > min(left, tiles.whole) - 65


@pytest.mark.parametrize("name", ["staggered", "adaptive"])
def test_milliseconds_become_evaluations_by_what_frames_have_cost(rng, name):
    tiles, policy = _tiles(rng, 2000), make_policy(name, 4, milliseconds=2.0)
    assert not policy.choose(tiles).any()  # nothing is known yet
    for _ in range(30):
        policy.learn(4.0, 20_000)  # 5000 evaluations a millisecond
    assert 10_000 - 65 < tiles.cost[policy.choose(tiles)].sum() <= 10_000 + 64
    policy.learn(0.0, 0)  # a frame without shading tells nothing
    for _ in range(30):
        policy.learn(8.0, 20_000)
    assert 5000 - 65 < tiles.cost[policy.choose(tiles)].sum() <= 5010 + 64  # the older frames still weigh a little


@pytest.mark.parametrize("interval", [1, 4, 9])
def test_staggered_spreads_a_round_evenly_over_the_interval(rng, interval):
    count, policy = 3000, make_policy("staggered", interval)
    tiles, age, spent, waited = _tiles(rng, count), np.ones(count, np.int64), [], np.zeros(count, np.int64)
    for _ in range(6 * (interval + 1)):
        tiles.age = age
        due = policy.choose(tiles)
        spent.append(tiles.cost[due].sum())
        waited = np.maximum(waited, age)
        age = np.where(due, 1, age + 1)
    share = tiles.whole / (interval + 1)
    # But for one tile, which the budget has no room for, and pays for in the next frame.
    assert max(spent) <= share + 64
    assert min(spent) > share - 65
    # What those last tiles of the frames leave over comes one frame later.
    assert waited.max() <= interval + 2
    assert (waited <= interval + 1).mean() > 1 - 65 * (interval + 2) ** 2 / tiles.whole


def test_staggered_takes_the_oldest_and_decides_ties_by_the_seed(rng):
    tiles = _tiles(rng, 500, cost=np.ones(500), age=np.repeat([3, 9], 250))
    due = Staggered(Budget(300)).choose(tiles)
    assert due[250:].all()
    assert due[:250].sum() == 50
    assert tiles.tie[:250][due[:250]].min() > tiles.tie[:250][~due[:250]].max()


def test_adaptive_takes_what_removes_most_error_for_its_cost(rng):
    tiles = _tiles(rng, 1000)
    due = make_policy("adaptive", 4, budget=8000).choose(tiles)
    value = tiles.pixels * tiles.change**0.75 / tiles.cost
    assert 100 < due.sum() < 900
    assert value[due].min() >= value[~due].max() * (1 - 1e-5)


def test_adaptive_keeps_floor_and_ceiling_of_age(rng):
    tiles = _tiles(rng, 900, age=np.tile([1, 4, 30], 300), change=np.repeat([0.0, 1e-4, 0.5], 300))
    everything = Adaptive(Budget(1e9), age_min=3, age_max=20).choose(tiles)
    young, old, still = tiles.age < 3, tiles.age >= 20, tiles.change == 0
    assert not everything[young].any()
    assert everything[old].all()
    assert not everything[still & ~old].any()
    assert everything[~young & ~still].all()
    few = Adaptive(Budget(2000), age_min=3, age_max=20).choose(tiles)
    assert few.any()
    assert old[few].all()  # they come before any change


def test_a_share_is_that_of_all_that_is_seen(rng):
    tiles = _tiles(rng, 1000, whole=60_000.0)
    assert Budget(share=0.25).left(tiles) == 15_000
    assert Budget(share=0.25).left(_tiles(rng, 10, whole=60_000.0, new=14_000.0)) == 1000
    assert make_policy("staggered", 4).budget.left(tiles) == pytest.approx(12_000)
    assert make_policy("adaptive", 4).budget.left(tiles) == pytest.approx(4000)


def test_adaptive_with_a_target_refreshes_what_is_over_it(rng):
    tiles = _tiles(rng, 2000, age=np.full(2000, 3))
    error = flip_of(tiles.change, tiles.pixels)
    kept = []
    for target in (0.0025, 0.01, 0.04, 0.99):
        policy = make_policy("adaptive", 4, target_flip=target)
        due = policy.choose(tiles)
        left = error[~due].sum() / tiles.picture
        allowed = policy.target.allowance()
        kept.append(due.sum())
        assert left <= allowed * (1 + 1e-6)
        if due.sum() > 1:  # and no more than that
            assert left + np.sort(error[due] / tiles.picture)[-1] >= allowed
    assert sorted(kept, reverse=True) == kept
    assert kept[0] > 500
    assert kept[-1] <= 1


@pytest.mark.parametrize("policy", ["every", "fixed", "staggered", "adaptive"])
def test_choices_are_a_function_of_the_tiles(rng, policy):
    tiles = _tiles(rng, 700)
    one, two = (make_policy(policy, 2).choose(tiles) for _ in range(2))
    assert np.array_equal(one, two)
    assert one.dtype == bool
    empty = _tiles(rng, 0)
    assert make_policy(policy, 2).choose(empty).shape == (0,)


def test_epochs():
    begins = {name: [make_policy(name, 2).begins_epoch(k) for k in range(7)] for name in POLICIES}
    assert begins["every"] == [True] * 7
    assert begins["fixed"] == [True, False, False] * 2 + [True]
    assert begins["staggered"] == begins["adaptive"] == [True] + [False] * 6


def test_flip_of_a_change_is_that_of_its_size():
    assert flip_of(np.array([0.0, 1.0, 0.0625]), 3.0) == pytest.approx(
        3 * np.array([0, 1, 1 / 8]) * flip_of(np.ones(1), 1.0)[0]
    )


@pytest.mark.parametrize(
    ("name", "limits", "message"),
    [
        ("often", {}, "policy must be one of every, fixed, staggered, adaptive, got 'often'"),
        ("adaptive", {"budget": 1.0, "target_flip": 0.1}, "budget and target_flip exclude each other; give one"),
        ("fixed", {"budget": 1.0}, "fixed keeps no budget; use the policy staggered or adaptive"),
        ("every", {"milliseconds": 1.0}, "every keeps no milliseconds"),
        ("staggered", {"target_flip": 0.1}, "staggered aims for no target_flip; use the policy adaptive"),
        ("adaptive", {"budget": 0.0}, "budget must be a positive number, got 0.0"),
        ("adaptive", {"target_flip": float("nan")}, "target_flip must be a positive number, got nan"),
        ("staggered", {"milliseconds": float("inf")}, "milliseconds must be a positive number, got inf"),
    ],
)
def test_limits_that_mean_nothing_are_refused(name, limits, message):
    with pytest.raises(ValueError, match=message):
        make_policy(name, 4, **limits)


def test_a_still_frame_mends_what_nobody_predicted(rng):
    """Where nothing moves any more, what is left of the budget goes to tiles that were shaded before that."""
    tiles = _tiles(rng, 200, change=np.zeros(200), moved=False)
    chosen = make_policy("adaptive", 4, budget=1e9).choose(tiles)
    assert np.array_equal(chosen, tiles.age > 0)
    moving = _tiles(rng, 200, change=np.zeros(200), age=np.ones(200))
    assert not make_policy("adaptive", 4, budget=1e9).choose(moving).any()
