"""Places on a sheet: never two on one tile, found whenever there is one, and nothing lost when all is given back."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from warp_neumat.pipeline.rectangles import Rectangles

SHEETS = st.tuples(st.integers(1, 21), st.integers(1, 21))
STEPS = st.lists(st.tuples(st.booleans(), st.integers(1, 9), st.integers(1, 9), st.integers(0, 10**6)), max_size=60)


def _first_place(taken, width, height):
    """Return the topmost, then leftmost free (column, row), by looking at every one."""
    for row in range(taken.shape[0] - height + 1):
        for column in range(taken.shape[1] - width + 1):
            if not taken[row : row + height, column : column + width].any():
                return column, row
    return None


def _run(columns, rows, steps):
    """Take and give as told; check every step against a grid of tiles, and return the places."""
    sheet, taken, held, places = Rectangles(columns, rows), np.zeros((rows, columns), bool), [], []
    for give, width, height, pick in steps:
        if give and held:
            x, y, w, h = held.pop(pick % len(held))
            sheet.give(x, y, w, h)
            taken[y : y + h, x : x + w] = False
        else:
            at = sheet.take(width, height)
            assert at == _first_place(taken, width, height)
            places.append(at)
            if at is not None:
                x, y = at
                taken[y : y + height, x : x + width] = True
                held.append((x, y, width, height))
        assert sheet.free_tiles == (~taken).sum()
    return sheet, held, places


@settings(deadline=None, max_examples=150)
@given(SHEETS, STEPS)
def test_places_are_free_first_and_all_come_back(size, steps):
    sheet, held, places = _run(*size, steps)
    assert places == _run(*size, steps)[2]  # deterministic
    for rectangle in held:
        sheet.give(*rectangle)
    assert sheet.free_tiles == size[0] * size[1]
    assert sheet.take(*size) == (0, 0)


def test_a_long_life_does_not_fragment_it(rng):
    sheet, held, failed = Rectangles(64, 64), [], 0
    for _ in range(3000):
        while sheet.free_tiles < 0.3 * 64 * 64:  # 70 % full: give back at random
            sheet.give(*held.pop(rng.integers(len(held))))
        w, h = (int(n) for n in rng.integers(1, 9, 2))
        at = sheet.take(w, h)
        failed += at is None
        if at is not None:
            held.append((*at, w, h))
        else:
            sheet.give(*held.pop(rng.integers(len(held))))
    assert failed < 60  # of 3000, with 70 to 85 % of the tiles taken; measured 38


def test_clear_frees_everything():
    sheet = Rectangles(5, 3)
    sheet.take(3, 2)
    sheet.clear()
    assert sheet.take(5, 3) == (0, 0)
    assert sheet.take(1, 1) is None


def test_mistakes_are_told():
    sheet = Rectangles(4, 4)
    sheet.take(2, 2)
    with pytest.raises(ValueError, match=r"the 1 × 1 tiles at \(3, 3\) are not all taken"):
        sheet.give(3, 3, 1, 1)
    with pytest.raises(ValueError, match=r"the 3 × 2 tiles at \(0, 0\) are not all taken"):
        sheet.give(0, 0, 3, 2)
    with pytest.raises(ValueError, match="not all taken"):
        sheet.give(-1, 0, 2, 2)
    with pytest.raises(ValueError, match="at least 1 × 1"):
        sheet.take(0, 3)
    with pytest.raises(ValueError, match="columns and rows must be at least 1"):
        Rectangles(0, 3)
    assert sheet.take(5, 1) is None
