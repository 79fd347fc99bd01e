"""Paths of the files that are not Python: the page, head files, the light path and the changelog.

A checkout has them at its top level. A wheel lays them into the package `diffuscope`, so that site-packages gets no
folder named `web` or `hardware`.
"""

from pathlib import Path

BESIDE = Path(__file__).parents[1]
INSTALLED = BESIDE / "diffuscope"
ROOT = INSTALLED if INSTALLED.is_dir() else BESIDE

WEB = ROOT / "web"
HEADS = ROOT / "hardware" / "heads"
LIGHT_PATH = ROOT / "hardware" / "optics.toml"
CHANGELOG = ROOT / "CHANGELOG.md"
