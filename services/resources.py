"""Paths of the non-Python files: web page, head files, scenes, light path, changelog; and of cached FFT plans.

In a checkout they lie at the top level. In a wheel they lie in the package `diffuscope`, so that site-packages gets no
top-level folder `web` or `hardware`.
"""

import os
from pathlib import Path

from device.config import shipped_heads

ROOT = shipped_heads.ROOT
HEADS = shipped_heads.HEADS
LIGHT_PATH = shipped_heads.LIGHT_PATH
WEB = ROOT / "web"
CHANGELOG = ROOT / "CHANGELOG.md"
SCENES = Path(__file__).parents[1] / "device" / "sim" / "scenes"


def fft_plans() -> Path | None:
    """Return the folder of cached FFT plans of this user; it may not exist yet. None for a user without a home."""
    place = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return Path(place) / "diffuscope" if Path(place).is_absolute() else None
