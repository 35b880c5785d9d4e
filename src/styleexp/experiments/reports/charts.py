"""Small charts as inline SVG, in the page's own colours. Text is escaped."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from markupsafe import Markup, escape

WIDTH, HEIGHT = 420, 210
LEFT, RIGHT, TOP, BOTTOM = 58, 12, 12, 34
"""Margins, in the chart's units (about pixels)."""
DIGIT = 8
"""Width of a label's character with the space between labels, in these units."""


@dataclass(frozen=True)
class Scale:
    """A linear map from values to coordinates."""

    low: float
    high: float
    start: float
    end: float

    def __call__(self, value: float) -> float:
        """Coordinate of a value."""
        return self.start + (value - self.low) / (self.high - self.low) * (self.end - self.start)


def line_chart(
    title: str, across: str, lines: Sequence[tuple[str, Sequence[float], Sequence[float]]]
) -> Markup:
    """Draw lines of (label, x, y); non-finite values are skipped without breaking the line."""
    kept = [
        (label, [(x, y) for x, y in zip(xs, ys, strict=True) if _finite(x) and _finite(y)])
        for label, xs, ys in lines
    ]
    points = [point for _, line in kept for point in line]
    if not points:
        return Markup("")
    right = _scale([x for x, _ in points], LEFT, WIDTH - RIGHT, exact=True)
    up = _scale([y for _, y in points], HEIGHT - BOTTOM, TOP)
    parts = [_axes(right, up, across, _ticks(right, 5), None)]
    for number, (label, line) in enumerate(kept):
        path = " ".join(f"{right(x):.1f},{up(y):.1f}" for x, y in line)
        shape = f'points="{path}"'
        parts.append(
            f'<polyline class="line s{number}" {shape}><title>{escape(label)}</title></polyline>'
        )
    legend = [(number, label) for number, (label, _) in enumerate(kept)] if len(kept) > 1 else []
    return _chart(title, parts, legend)


def dot_chart(
    title: str, across: str, groups: Sequence[tuple[str, Sequence[tuple[str, float]]]]
) -> Markup:
    """Draw a column of dots per group (label, [(run, value)]), and a line through the means."""
    kept = [(label, [(run, y) for run, y in dots if _finite(y)]) for label, dots in groups]
    values = [y for _, dots in kept for _, y in dots]
    if not values:
        return Markup("")
    right = Scale(-0.5, len(kept) - 0.5, LEFT, WIDTH - RIGHT)
    up = _scale(values, HEIGHT - BOTTOM, TOP)
    labels = _thinned([label for label, _ in kept])
    parts = [_axes(right, up, across, list(range(len(kept))), labels)]
    means = [(k, sum(y for _, y in d) / len(d)) for k, (_, d) in enumerate(kept) if d]
    path = " ".join(f"{right(k):.1f},{up(y):.1f}" for k, y in means)
    parts.append(f'<polyline class="line mean" points="{path}"/>')
    for k, (_, dots) in enumerate(kept):
        for run, y in dots:
            place = f'cx="{right(k):.1f}" cy="{up(y):.1f}" r="4"'
            label = f"{run}: {y:.4g}"
            parts.append(f'<circle class="dot" {place}><title>{escape(label)}</title></circle>')
    return _chart(title, parts, [])


def _thinned(labels: Sequence[str]) -> list[str]:
    """Labels of an axis, those empty for which numbers leave no room, as a search's values."""
    try:
        longest = max(len(f"{float(label):g}") for label in labels)
    except ValueError:
        return list(labels)
    every = math.ceil(DIGIT * longest * len(labels) / (WIDTH - LEFT - RIGHT))
    return [label if k % every == 0 else "" for k, label in enumerate(labels)]


def _chart(title: str, parts: list[str], legend: list[tuple[int, str]]) -> Markup:
    keys = "".join(f'<span class="key s{k}">{escape(label)}</span>' for k, label in legend)
    return Markup(
        f'<figure class="chart"><figcaption>{escape(title)} {keys}</figcaption>'
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(title)}">'
        f"{''.join(parts)}</svg></figure>"
    )


def _axes(
    right: Scale, up: Scale, across: str, places: Sequence[float], labels: Sequence[str] | None
) -> str:
    parts = []
    for y in _ticks(up, 4):
        parts.append(
            f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{up(y):.1f}" '
            f'y2="{up(y):.1f}"/><text class="tick" text-anchor="end" x="{LEFT - 6}" '
            f'y="{up(y) + 4:.1f}">{y:.4g}</text>'
        )
    for k, x in enumerate(places):
        label = f"{x:g}" if labels is None else labels[k]
        if len(label) > 14:
            label = label[:13] + "…"
        parts.append(
            f'<text class="tick" text-anchor="middle" x="{right(x):.1f}" '
            f'y="{HEIGHT - BOTTOM + 15}">{escape(label)}</text>'
        )
    middle = (LEFT + WIDTH - RIGHT) / 2
    parts.append(
        f'<text class="axis" text-anchor="middle" x="{middle}" y="{HEIGHT - 3}">'
        f"{escape(across)}</text>"
    )
    return "".join(parts)


def _scale(values: Sequence[float], start: float, end: float, exact: bool = False) -> Scale:
    low, high = min(values), max(values)
    if low == high:
        low, high = low - (abs(low) or 1) * 0.5, high + (abs(high) or 1) * 0.5
    elif not exact:
        margin = 0.06 * (high - low)
        low, high = low - margin, high + margin
    return Scale(low, high, start, end)


def _ticks(scale: Scale, count: int) -> list[float]:
    """About ``count`` round numbers within the scale."""
    rough = (scale.high - scale.low) / count
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(m * power for m in (1, 2, 5, 10) if m * power >= rough * 0.999)
    first = math.ceil(scale.low / step - 1e-9)
    last = math.floor(scale.high / step + 1e-9)
    return [k * step for k in range(first, last + 1)]


def _finite(value: object) -> bool:
    return isinstance(value, int | float) and math.isfinite(value)
