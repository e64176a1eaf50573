"""Measures and pictures that tell simulated touch from real touch; used by `sim_vs_real.py`."""
