"""Version of kraft, for ``kraft --version`` and for every file that kraft writes."""

from typing import Final

VERSION: Final = "0.1.0"
