"""Figures and clips of records, drawn without torch."""
