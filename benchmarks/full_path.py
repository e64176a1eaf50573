"""The whole path with networks of one's own, `sliplens demo --train`: how long it takes, and how well they read."""

import argparse
import json
import os
import sys
import tempfile
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # the demo inherits it

from first_look import time_demo
from sliplens.codec import load_result
from sliplens.results import Evaluation


def main() -> None:
    """Print the minutes, and how well the networks read, as text or as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--max-minutes", type=float, default=10.0, help="what the path aims for")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        output = Path(scratch) / "demo"
        _, seconds = time_demo(sys.executable, output, "--train", "--max-minutes", str(options.max_minutes))
        result: dict[str, float | None] = {"minutes": seconds / 60, "load": os.getloadavg()[2]}
        for name in ("difference", "raw"):
            evaluation = load_result(output / f"evaluate-{name}", Evaluation, command="sliplens demo")
            for condition, scores in evaluation.conditions.items():
                result[f"r2_{name}_{condition}"] = scores.r2
    if options.json:
        print(json.dumps(result))
        return
    print(f"{result['minutes']:.1f} minutes")
    for name, value in result.items():
        if name.startswith("r2"):
            print(f"{name}: {value:.2f}" if value is not None else f"{name}: not known")


if __name__ == "__main__":
    main()
