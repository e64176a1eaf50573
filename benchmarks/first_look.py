"""The first minute of a new user: seconds until the demo's page is there, and until all of it is.

With `--from-scratch` a clone of this checkout is set up first, as `make install` does it on a machine where nothing is
installed, and the demo runs there.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # the demo inherits it

_LOOK_EVERY_S = 0.1
_ROOT = Path(__file__).resolve().parents[1]


def main() -> None:
    """Print the seconds as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--from-scratch", action="store_true", help="set up a clone first, and time that too")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        python, set_up_seconds = sys.executable, None
        if options.from_scratch:
            clone = Path(scratch) / "clone"
            subprocess.run(["git", "clone", "--quiet", str(_ROOT), str(clone)], check=True)
            started = time.perf_counter()
            subprocess.run(["make", "install"], cwd=clone, check=True, stdout=sys.stderr)
            set_up_seconds = time.perf_counter() - started
            python = str(clone / ".venv" / "bin" / "python")
        seconds_to_page, seconds_all = time_demo(python, Path(scratch) / "demo")
    result = {
        "seconds_to_page": seconds_to_page,
        "seconds_all": seconds_all,
        "set_up_seconds": set_up_seconds,
        "cores": os.cpu_count(),
        "load_before": os.getloadavg()[2],
    }
    print(json.dumps(result, indent=None if options.json else 2))


def time_demo(python: str, output: Path) -> tuple[float, float]:
    """Seconds from the start of the demo to its first page, and to its end."""
    started = time.perf_counter()
    process = subprocess.Popen([python, "-m", "sliplens", "demo", str(output)], stdout=sys.stderr)
    try:
        page = None
        while process.poll() is None:
            if page is None and (output / "report.html").is_file():
                page = time.perf_counter() - started
            time.sleep(_LOOK_EVERY_S)
        seconds = time.perf_counter() - started
        if process.returncode != 0 or not (output / "report.html").is_file():
            raise SystemExit(f"the demo ended with exit code {process.returncode} and made no page")
        return (seconds if page is None else page), seconds
    finally:
        process.kill()


if __name__ == "__main__":
    main()
