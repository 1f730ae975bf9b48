"""Where what is costly to make is kept between runs."""

import os
from pathlib import Path


def cache_folder() -> Path:
    """Return ``$NEUMAT_CACHE``, else ``~/.cache/warp_neumat``. It need not exist."""
    return Path(os.environ.get("NEUMAT_CACHE") or Path.home() / ".cache" / "warp_neumat")
