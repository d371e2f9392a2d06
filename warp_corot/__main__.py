"""``python -m warp_corot``."""

import sys

from .cli import main

sys.exit(main())
