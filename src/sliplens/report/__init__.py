"""The report of a workspace or a study: figures, tables and one page, from saved results only."""

from sliplens.report.page import Written, write_report
from sliplens.results.study import load_results

__all__ = ["Written", "load_results", "write_report"]
