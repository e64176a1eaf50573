"""Trained networks outside training: as ONNX files, and run by the fastest engine there is."""

from sliplens.export.engines import ENGINES, Engine, fastest_engine, make_engine
from sliplens.export.onnx_file import export_onnx

__all__ = ["ENGINES", "Engine", "export_onnx", "fastest_engine", "make_engine"]
