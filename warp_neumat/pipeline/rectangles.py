"""Places rectangles of tiles on a sheet, and takes them back: exact first fit on one long bitmap.

The whole sheet is one Python integer, a bit per tile, rows one after another with one wall bit between them. A place
for w × h tiles is found by eroding the free bits: ``free & free >> 1 & … & free >> w - 1`` leaves the bits with w free
tiles to the right, and the same with steps of a row leaves those with h such rows below. Doubling makes that
log₂ w + log₂ h shifts of the whole sheet (256 × 256 tiles are 8 KB: some 20 µs). The lowest bit left is the topmost,
then leftmost place.

Why this: a place is found whenever there is one. Shelves, skylines and guillotine cuts keep lists of free pieces that
fragment in the bookkeeping as well, because cuts are not undone when neighbours are freed; power-of-two buddies merge
but waste up to three quarters of a rectangle. Here only the tiles themselves can fragment; first fit keeps
the free ones together at the lower end, and who still finds no room can place everything anew, tallest first.
"""

import functools
import operator


class Rectangles:
    """The tiles of a sheet, free or taken.

    The same calls in the same order always give the same places.

    Args:
        columns, rows: Size of the sheet in tiles, at least 1.
    """

    def __init__(self, columns: int, rows: int):
        self.columns, self.rows = operator.index(columns), operator.index(rows)
        if self.columns < 1 or self.rows < 1:
            raise ValueError(f"columns and rows must be at least 1, got {columns} × {rows}")
        self._stride = self.columns + 1  # the wall: no rectangle continues in the next row
        self._all = _block(self.columns, self.rows, self._stride)
        self._free = self._all

    @property
    def free_tiles(self) -> int:
        """Number of tiles that nobody holds."""
        return self._free.bit_count()

    def take(self, width: int, height: int) -> tuple[int, int] | None:
        """Take the first free ``width`` × ``height`` tiles from the top; return their (column, row), None = no place.

        Raises:
            ValueError: If a side is less than 1.
        """
        if width < 1 or height < 1:
            raise ValueError(f"a rectangle must have at least 1 × 1 tiles, got {width} × {height}")
        if width > self.columns or height > self.rows:
            return None
        fits = _erode(_erode(self._free, width, 1), height, self._stride)
        if not fits:
            return None
        at = (fits & -fits).bit_length() - 1
        self._free ^= _block(width, height, self._stride) << at
        row, column = divmod(at, self._stride)
        return column, row

    def give(self, column: int, row: int, width: int, height: int) -> None:
        """Give back a rectangle that :meth:`take` placed.

        Raises:
            ValueError: If it is not on the sheet, or not all of it is taken.
        """
        inside = 0 <= column <= self.columns - width and 0 <= row <= self.rows - height and width > 0 and height > 0
        block = _block(width, height, self._stride) << (row * self._stride + column) if inside else 0
        if not inside or self._free & block:
            raise ValueError(
                f"the {width} × {height} tiles at ({column}, {row}) are not all taken; give them back once"
            )
        self._free |= block

    def clear(self) -> None:
        """Give back everything."""
        self._free = self._all


@functools.lru_cache(4096)
def _block(width: int, height: int, stride: int) -> int:
    """Return the bits of a rectangle at the origin."""
    row = (1 << width) - 1
    bits, rows = row, 1
    while rows < height:
        more = min(rows, height - rows)
        bits |= bits << more * stride
        rows += more
    return bits


def _erode(bits: int, count: int, step: int) -> int:
    """Return the bits that start ``count`` set bits, ``step`` apart."""
    run = 1
    while run < count:
        more = min(run, count - run)
        bits &= bits >> more * step
        run += more
    return bits
