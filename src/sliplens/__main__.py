"""`python -m sliplens` is the command line."""

import sys

from sliplens.cli import main

if __name__ == "__main__":  # processes that it starts import it too
    sys.exit(main())
