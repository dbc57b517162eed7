"""``python -m kraft_cli`` is ``kraft``."""

import sys

from kraft_cli.entry import main

sys.exit(main())
