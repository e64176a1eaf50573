"""Figures of records, drawn without torch."""
