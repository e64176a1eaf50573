"""The picture of a sensor profile: what it does to a frame of the camera."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from sliplens.markers.gel import SensorProposal
from sliplens.plots.style import BLUE, VERMILLION, drawing_style, written_whole


def draw_proposal(proposal: SensorProposal) -> Figure:
    """Draw the camera's frame with gel, crop and markers, and beside it the frame as networks and trackers read it."""
    profile, frame = proposal.profile, proposal.frame
    with drawing_style():
        figure = Figure(figsize=(9.6, 4.6), layout="constrained")
        camera, made = figure.subplots(1, 2, width_ratios=(frame.shape[1] / frame.shape[0], 1.0))
        camera.imshow(frame)
        for box, colour, words in (
            (proposal.gel_px, BLUE, "gel found"),
            (profile.crop_px or (0, 0, frame.shape[1], frame.shape[0]), VERMILLION, "kept (crop_px)"),
        ):
            left, top, width, height = box
            corner = (left - 0.5, top - 0.5)
            camera.add_patch(Rectangle(corner, width, height, fill=False, color=colour, linewidth=1.6, label=words))
        if len(proposal.markers_px):
            camera.plot(
                *proposal.markers_px.T, "o", mfc="none", mec="white", ms=9,
                label=f"{len(proposal.markers_px)} markers ({profile.markers})",
            )  # fmt: skip
        camera.set(title="camera", xlabel="x in pixels", ylabel="y in pixels")
        camera.legend(
            loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=3, frameon=True, facecolor="0.7"
        )  # rings are white
        result = profile.apply(frame)
        made.imshow(result)
        made.set(title=f"{profile.name}, as it is read", xlabel="x in pixels", ylabel="y in pixels")
        if np.isfinite(proposal.spacing_px):
            made.text(
                0.5, -0.22, f"markers {proposal.spacing_px:.1f} pixels apart", ha="center", transform=made.transAxes
            )
        for axes in (camera, made):
            axes.grid(visible=False)
    return figure


def write_proposal(proposal: SensorProposal, path: Path) -> None:
    """Write the picture as PNG, whole or not at all."""
    with written_whole(path) as part:
        draw_proposal(proposal).savefig(part, dpi=120, format="png")


__all__ = ["draw_proposal", "write_proposal"]
