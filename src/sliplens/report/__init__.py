"""The report of a workspace: figures, tables and one page, from saved results only."""

from sliplens.report.page import Written, build_report
from sliplens.report.results import load_results
from sliplens.report.workspace import Results

__all__ = ["Results", "Written", "build_report", "load_results"]
