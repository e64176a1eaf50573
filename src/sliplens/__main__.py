"""`python -m sliplens` is the command line."""

import sys

from sliplens.cli import main

sys.exit(main())
