"""Figures, clips and the viewer: what draws a record, without a page and without torch."""
