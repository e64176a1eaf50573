"""A page on which labels are repaired, in a process of its own, until its standard input is closed; see served_page.py.

Writes its address as a line of JSON.
"""

import faulthandler
import json
import sys

from sliplens.app import LabelPage


def main() -> None:
    """Serve."""
    with LabelPage(sys.argv[1], by=sys.argv[2], port=0) as page:
        sys.stdout.write(json.dumps({"address": page.address}) + "\n")
        sys.stdout.flush()
        sys.stdin.read()


if __name__ == "__main__":
    faulthandler.enable()  # of a process that ends itself, this is all one sees
    main()
