"""Plots per frame as inline SVG: stacked steps and lines over one shared frame axis.

Colours come from the page (CSS variables, for light and dark); series colours are Okabe and Ito's, which people with
any kind of colour vision tell apart. Each plot carries a cursor line of class ``cursor`` that the page moves to a
frame.
"""

import dataclasses
import html
import math

PALETTE = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#8C8C8C", "#F0E442", "#7A5195", "#B8860B")

_WIDTH, _HEIGHT = 640, 240
_LEFT, _RIGHT, _TOP, _BOTTOM = 58, 10, 12, 38


@dataclasses.dataclass(frozen=True)
class Series:
    """One named curve: a value per frame, ``None`` where there is none."""

    name: str
    values: list
    color: str
    dashed: bool = False


def short(value: float) -> str:
    """Return a number as an axis or a tile shows it: three digits, k and M for thousands and millions."""
    if value is None:
        return "–"
    for scale, unit in ((1e9, "G"), (1e6, "M"), (1e4, "k")):
        if abs(value) >= scale:
            return f"{value / (1e3 if unit == 'k' else scale):.3g}{unit}"
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"


def ticks(low: float, high: float, count: int = 5) -> list[float]:
    """Return round numbers in [low, high], steps of 1, 2 or 5 times a power of ten, about ``count`` of them."""
    span = high - low
    if not span > 0:
        return [low]
    raw = span / count
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(power * k for k in (1, 2, 5, 10) if power * k >= raw * 0.999)
    first = math.ceil(low / step - 1e-9)
    return [k * step for k in range(first, math.floor(high / step + 1e-9) + 1)]


def ceiling(totals: list[float]) -> float:
    """Return the top of the axis: the largest value, or less where a few frames tower over all others.

    A first frame that compiles kernels takes a thousand times the others' time; a plot scaled to it shows nothing else.
    """
    ordered = sorted(totals)
    typical = ordered[min(len(ordered) - 1, int(0.9 * len(ordered)))]
    top = ordered[-1]
    return 1.5 * typical if typical > 0 and top > 4.0 * typical else top


class Frame:
    """Axes of one plot: maps frame numbers and values to SVG coordinates, and draws itself."""

    def __init__(self, index: list[int], low: float, high: float, y_label: str, title: str):
        self.index, self.y_label, self.title = index, y_label, title
        self.low, self.high = low, high if high > low else low + 1.0
        self.parts: list[str] = []

    def x(self, position: float) -> float:
        """Return the horizontal coordinate of a place among the frames; frame k fills k … k + 1."""
        return _LEFT + (_WIDTH - _LEFT - _RIGHT) * position / len(self.index)

    def y(self, value: float) -> float:
        """Return the vertical coordinate of a value, held to the axis."""
        share = (min(max(value, self.low), self.high) - self.low) / (self.high - self.low)
        return _TOP + (_HEIGHT - _TOP - _BOTTOM) * (1.0 - share)

    def svg(self) -> str:
        """Return the plot with its grid, labels and cursor."""
        bottom, right = _HEIGHT - _BOTTOM, _WIDTH - _RIGHT
        grid = []
        for value in ticks(self.low, self.high):
            y = self.y(value)
            grid.append(f'<line class="grid" x1="{_LEFT}" x2="{right}" y1="{y:.1f}" y2="{y:.1f}"/>')
            grid.append(f'<text x="{_LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{short(value)}</text>')
        count = len(self.index)
        for k in sorted({int(v) for v in ticks(0, count - 1, 8)}):
            x = self.x(k + 0.5)
            grid.append(f'<text x="{x:.1f}" y="{bottom + 16}" text-anchor="middle">{self.index[k]}</text>')
        middle = (_TOP + bottom) / 2
        labels = (
            f'<text class="label" x="{(_LEFT + right) / 2}" y="{_HEIGHT - 4}" text-anchor="middle">frame</text>'
            f'<text class="label" transform="translate(13 {middle}) rotate(-90)" text-anchor="middle">'
            f"{html.escape(self.y_label)}</text>"
        )
        cursor = f'<line class="cursor" x1="0" x2="0" y1="{_TOP}" y2="{bottom}"/>'
        place = f'data-left="{_LEFT}" data-step="{(_WIDTH - _LEFT - _RIGHT) / count:.6g}"'
        return (
            f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{html.escape(self.title)}" {place}>'
            f"{''.join(grid)}{''.join(self.parts)}{labels}{cursor}</svg>"
        )


def stacked(index: list[int], series: list[Series], y_label: str, title: str) -> str:
    """Return a plot of steps on top of each other, the first series at the bottom; clipped peaks carry their value."""
    totals = [sum(s.values[k] or 0.0 for s in series) for k in range(len(index))]
    frame = Frame(index, 0.0, ceiling(totals) * 1.03, y_label, title)
    below = [0.0] * len(index)
    for s in series:
        above = [b + (v or 0.0) for b, v in zip(below, s.values, strict=True)]
        up = " ".join(
            f"{frame.x(k):.1f},{frame.y(v):.1f} {frame.x(k + 1):.1f},{frame.y(v):.1f}" for k, v in _run(above)
        )
        down = " ".join(
            f"{frame.x(k + 1):.1f},{frame.y(v):.1f} {frame.x(k):.1f},{frame.y(v):.1f}" for k, v in reversed(_run(below))
        )
        frame.parts.append(f'<polygon points="{up} {down}" fill="{s.color}"/>')
        below = above
    for k, total in enumerate(totals):
        if total > frame.high:
            x = min(frame.x(k + 0.5) + 6, _WIDTH - 60)
            frame.parts.append(f'<text class="peak" x="{x:.1f}" y="{_TOP + 10}">▲ {short(total)}</text>')
    return frame.svg()


def lines(index: list[int], series: list[Series], y_label: str, title: str, *, from_zero: bool = True) -> str:
    """Return a plot of one line per series, a dot where a value has no neighbour; missing values leave gaps."""
    present = [v for s in series for v in s.values if v is not None]
    high = max(present, default=1.0)
    low = 0.0 if from_zero else min(present, default=0.0)
    margin = 0.06 * (high - low) or 0.05 * abs(high) or 1.0
    frame = Frame(index, low if from_zero else low - margin, high + margin, y_label, title)
    for s in series:
        style = f'stroke="{s.color}"' + (' stroke-dasharray="6 4"' if s.dashed else "")
        for run in _runs(s.values):
            points = [f"{frame.x(k + 0.5):.1f},{frame.y(v):.1f}" for k, v in run]
            if len(points) == 1:
                x, y = points[0].split(",")
                frame.parts.append(f'<circle cx="{x}" cy="{y}" r="3" fill="{s.color}"/>')
            else:
                frame.parts.append(f'<polyline class="curve" points="{" ".join(points)}" {style}/>')
    return frame.svg()


def legend(series: list[Series]) -> str:
    """Return the series' names with their colours, as HTML."""
    items = [f'<span><i style="background:{s.color}"></i>{html.escape(s.name)}</span>' for s in series]
    return f'<div class="legend">{"".join(items)}</div>'


def _run(values: list[float]) -> list[tuple[int, float]]:
    return list(enumerate(values))


def _runs(values: list) -> list[list[tuple[int, float]]]:
    """Split at missing values."""
    runs: list[list[tuple[int, float]]] = [[]]
    for k, value in enumerate(values):
        if value is None:
            runs.append([])
        else:
            runs[-1].append((k, value))
    return [run for run in runs if run]
