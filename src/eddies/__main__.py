"""Run the command `eddies` as `python -m eddies`."""

import sys

from eddies.cli import main

sys.exit(main())
