"""Entry point of `python -m handover_marl.cli`."""

import sys

from handover_marl.cli import main

sys.exit(main())
