"""Trials to draw, and what must not be seen on any figure."""

from itertools import combinations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text

from sliplens.recordings import ContactState, Recording

NO_CONTACT, CONTACT, INCIPIENT_SLIP, FULL_SLIP, _ = ContactState


def pulled_trial(
    *,
    pull: int = 41,
    lowest: float = 0.0,
    size: tuple[int, int] = (24, 24),
    bright: int = 90,
    step_s: float = 0.04,
    mu: float = 0.5,
) -> Recording:
    """Four frames untouched, five of pressing, a pull down to the lowest margin and, if that is 0, three of sliding."""
    slide = 3 if lowest == 0 else 0
    margin = np.concatenate([np.full(4, np.nan), np.ones(5), np.linspace(1, lowest, pull), np.zeros(slide)])
    normal = np.concatenate([np.zeros(4), [0.1, 0.3, 0.6, 0.9, 1.2], np.full(pull + slide, 1.1)])
    reference = np.random.default_rng(pull).integers(0, 100, (*size, 3), dtype=np.uint8)
    frames = np.repeat(reference[None], len(margin), axis=0)
    for index in range(4, len(margin)):
        frames[index, index % 8 : index % 8 + 8, 5:15] += np.uint8(bright)
    return Recording(
        trial="day1-dry-001",
        sensor="test-sensor",
        day=1,
        condition="dry",
        reference=reference,
        frames=frames,
        time_s=np.arange(len(margin)) * step_s,
        normal_force_n=normal,
        tangential_force_n=np.nan_to_num(mu * normal * (1 - margin)),
        friction_coefficient=np.full(len(margin), mu),
        safety_margin=margin,
        stick_ratio=margin ** (2 / 3),
        contact_state=(
            *[NO_CONTACT] * 4,
            *[CONTACT] * 5,
            *[INCIPIENT_SLIP] * pull,
            *[FULL_SLIP] * slide,
        ),
    )


def pictures(figure: Figure) -> tuple[list[Axes], list[Axes]]:
    """Axes of the camera frames and of the differences, from left to right and top to bottom."""
    shown = [ax for ax in figure.axes if ax.images]
    return shown[::2], shown[1::2]


def misplaced(figure: Figure) -> tuple[list[str], list[tuple[str, str]]]:
    """Words that leave the page, and pairs that lie over each other."""
    FigureCanvasAgg(figure).draw()
    # ticks beyond the limits of their axis have a place but are never drawn
    ticks = [
        (tick, axis.get_view_interval())
        for ax in figure.axes
        for axis in (ax.xaxis, ax.yaxis)
        for tick in axis.get_major_ticks()
    ]
    beyond = {tick.label1 for tick, (low, high) in ticks if not low <= tick.get_loc() <= high}
    shown = [found for found in figure.findobj(Text) if found.get_visible() and found.get_text().strip()]
    boxes = [(found.get_text(), found.get_window_extent()) for found in shown if found not in beyond]
    width, height = figure.bbox.size
    outside = [text for text, box in boxes if box.x0 < 0 or box.y0 < 0 or box.x1 > width or box.y1 > height]
    return outside, [(one, other) for (one, a), (other, b) in combinations(boxes, 2) if a.overlaps(b)]
