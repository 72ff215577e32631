"""A drawing of how losses fall, as a page shows it: SVG, a color for each stage of a fit, a line for each descent."""

import math
from collections.abc import Sequence

COLORS = ("#4dabf7", "#ffa94d", "#69db7c", "#f783ac", "#b197fc", "#ffe066")
"""Colors of the stages; further stages begin again."""

_WIDTH, _HEIGHT, _LEFT, _BOTTOM = 360, 220, 44, 18
_MAX_POINTS = 600  # of all lines: a page is sent all of them each time


def loss_plot(stages: Sequence[Sequence[Sequence[float]]]) -> str:
    """Draw losses over iterations, on a logarithmic scale.

    Args:
        stages: Losses of the iterations of each descent of each stage; values that are not above 0, or not finite, are
            left out.
    Returns:
        An <svg>; nothing where there is no loss to draw.
    """
    runs = [(stage, run) for stage, descents in enumerate(stages) for run in descents]
    count = sum(len(run) for _, run in runs)
    logs = [math.log10(loss) for _, run in runs for loss in run if 0 < loss < math.inf]
    if not logs:
        return ""
    low, high = min(logs), max(logs)
    low, high = low - 0.03 * (high - low) - 1e-3, high + 0.03 * (high - low) + 1e-3

    def to_x(iteration: float) -> float:
        return _LEFT + (_WIDTH - _LEFT - 4) * iteration / max(count - 1, 1)

    def to_y(log: float) -> float:
        return 4 + (_HEIGHT - _BOTTOM - 4) * (high - log) / (high - low)

    parts = []
    for log in _ticks(low, high):
        y = to_y(log)
        parts.append(f'<line x1="{_LEFT}" x2="{_WIDTH}" y1="{y:.1f}" y2="{y:.1f}" stroke="#444"/>')
        parts.append(f'<text x="{_LEFT - 4}" y="{y + 4:.1f}" text-anchor="end">{10**log:.2g}</text>')
    first, step = 0, math.ceil(count / _MAX_POINTS)
    for stage, run in runs:
        shown_iterations = sorted({*range(0, len(run), step), len(run) - 1}) if run else []
        points = [(to_x(first + n), to_y(math.log10(run[n]))) for n in shown_iterations if 0 < run[n] < math.inf]
        dots = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
        color = COLORS[stage % len(COLORS)]
        parts.append(f'<polyline points="{dots}" fill="none" stroke="{color}" stroke-width="1.5"/>')
        first += len(run)
    parts.append(f'<text x="{_WIDTH}" y="{_HEIGHT - 4}" text-anchor="end">{count} iterations</text>')
    style = "width:100%;font:10px sans-serif;fill:#aaa"
    return f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" style="{style}">{"".join(parts)}</svg>'


def _ticks(low: float, high: float) -> list[float]:
    """Logarithms of 1, 2 and 5 in each decade between two, or of 1 alone where there would be many."""
    decades = range(math.floor(low), math.ceil(high) + 1)
    steps = (1,) if high - low > 3 else (1, 2, 5)
    return [log for decade in decades for step in steps if low <= (log := decade + math.log10(step)) <= high]
