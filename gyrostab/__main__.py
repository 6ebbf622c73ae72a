"""``python -m gyrostab``: the command line."""

import sys

from gyrostab.cli import main

sys.exit(main())
