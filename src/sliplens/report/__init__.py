"""The report of a workspace: figures, tables and one page, from saved results only."""

from sliplens.report.audit import draw_audit, write_audit
from sliplens.report.contact_sheet import draw_contact_sheet, write_contact_sheet
from sliplens.report.figures import (
    plot_bins,
    plot_faithfulness,
    plot_learning_curves,
    plot_margin_over_time,
    plot_predictions,
)
from sliplens.report.overlay import overlay_saliency, plot_colour_bar, plot_overlay
from sliplens.report.page import Written, build_report
from sliplens.report.results import load_results
from sliplens.report.workspace import Results

__all__ = [
    "Results",
    "Written",
    "build_report",
    "draw_audit",
    "draw_contact_sheet",
    "load_results",
    "overlay_saliency",
    "plot_bins",
    "plot_colour_bar",
    "plot_faithfulness",
    "plot_learning_curves",
    "plot_margin_over_time",
    "plot_overlay",
    "plot_predictions",
    "write_audit",
    "write_contact_sheet",
]
