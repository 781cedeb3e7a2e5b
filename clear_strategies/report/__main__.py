"""`python -m clear_strategies.report`."""

import sys

from clear_strategies.report import main

sys.exit(main())
