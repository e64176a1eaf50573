"""The report of a workspace or a study: figures, tables and one page, from saved results only."""

from sliplens.report.page import Written, write_report
from sliplens.results.study import Results, load_results

__all__ = ["Results", "Written", "load_results", "write_report"]
