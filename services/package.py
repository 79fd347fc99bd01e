"""Diffuscope: reconstruction of the retina from the raw frame of a lensless funduscope.

The wheel lays this module as `diffuscope/__init__.py`; the program is in the packages `device` and `services`.
"""

from importlib.metadata import version

__all__ = ["__version__"]
__version__ = version("diffuscope")
