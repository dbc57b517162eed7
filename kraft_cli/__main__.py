"""``python -m kraft_cli`` is ``kraft``."""

import sys

from kraft_cli.main import main

sys.exit(main())
