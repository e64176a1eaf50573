"""Draw the picture of the README from a finished demo: python docs/strip.py runs/demo docs/images/strip.png."""

import argparse
from pathlib import Path

from sliplens.plots.margins import draw_strip
from sliplens.report.results import load_results

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("workspace", type=Path)
    parser.add_argument("output", type=Path)
    arguments = parser.parse_args()
    strip = load_results(arguments.workspace).strip
    if strip is None:
        parser.error(f"{arguments.workspace} holds no strip; name the folder of a demo")
    draw_strip(strip).savefig(arguments.output, dpi=130)
