"""Measures of simulated touch beside real touch."""
