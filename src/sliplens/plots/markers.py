"""Figures of markers: arrows on a frame, and the displacement field."""

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.patheffects import Normal, Stroke

from sliplens.markers import DisplacementField
from sliplens.plots.style import BLACK

# light is far: equal under every common colour blindness
FIELD_COLOURS = "cividis"
SURE = 0.2
"""Confidence below which a field is not drawn."""
ARROWS = 5.0
"""Length of arrows over the displacement."""
STILL_PX = 0.3
"""Displacement below which a direction is noise."""


def plot_arrows(
    frame: UInt8[np.ndarray, "height width 3"],
    rest_px: Float[np.ndarray, "markers 2"],
    displacement_px: Float[np.ndarray, "markers 2"],
    *,
    ax: Axes,
) -> Axes:
    """Draw a frame with an arrow from each marker's place at rest along its displacement."""
    followed = np.all(np.isfinite(displacement_px), axis=1) & np.all(np.isfinite(rest_px), axis=1)
    place, way = rest_px[followed], displacement_px[followed]
    ax.imshow(frame)
    ax.quiver(
        *place.T, *way.T, angles="xy", scale_units="xy", scale=1 / ARROWS, color="white", width=0.008,
        headlength=3, headaxislength=2.7, edgecolor=BLACK, linewidth=0.6, minlength=0.5,
    )  # fmt: skip
    height, width = frame.shape[:2]
    ax.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xlabel="x (px)", ylabel="y (px)")
    ax.grid(visible=False)
    return ax


def plot_field(
    field: DisplacementField, *, size: tuple[int, int], ax: Axes, longest_px: float | None = None
) -> ScalarMappable:
    """Draw the length of the displacement in colour and its direction as streamlines; unsure parts stay grey.

    The lightest colour stands for `longest_px`, or for the field's own longest displacement.
    """
    sure = field.confidence > SURE
    length = np.linalg.norm(field.displacement_px, axis=-1)
    top = longest_px or max(float(np.nanmax(np.where(sure, length, 0))), STILL_PX)
    across, down = ((at[1] - at[0]) / 2 for at in (field.x_px, field.y_px))  # halves of a cell of the grid
    ends = float(field.x_px[0] - across), float(field.x_px[-1] + across)
    extent = (*ends, float(field.y_px[-1] + down), float(field.y_px[0] - down))
    ax.set_facecolor("#D1D5DB")
    norm = Normalize(0, top)
    ax.imshow(np.where(sure, length, np.nan), cmap=FIELD_COLOURS, norm=norm, extent=extent, interpolation="nearest")
    moves = sure & (length > STILL_PX)
    if moves.sum() > 3:
        x, y = (np.where(moves, field.displacement_px[..., axis], np.nan) for axis in (0, 1))
        lines = ax.streamplot(field.x_px, field.y_px, x, y, color="white", density=0.8, linewidth=1.0, arrowsize=0.9)
        lines.lines.set_path_effects([Stroke(linewidth=2.0, foreground=BLACK, alpha=0.5), Normal()])
    ax.set(xlim=(-0.5, size[1] - 0.5), ylim=(size[0] - 0.5, -0.5), aspect="equal", xlabel="x (px)", ylabel="y (px)")
    ax.grid(visible=False)
    return ScalarMappable(norm, FIELD_COLOURS)
