"""`python -m eddies` is the command `eddies`."""

import sys

from eddies.cli import main

sys.exit(main())
