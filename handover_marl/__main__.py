"""`python -m handover_marl` is the command `handover-marl`."""

import sys

from handover_marl.cli import main

sys.exit(main())
