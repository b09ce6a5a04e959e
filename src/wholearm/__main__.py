"""Run the command line with ``python -m wholearm``."""

import sys

from .cli import main

sys.exit(main())
