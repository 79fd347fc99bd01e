"""ICC profile of an image file: whether it states values that are linear in the light (ICC.1:2022)."""

import struct

import numpy as np

_CURVES = (b"rTRC", b"gTRC", b"bTRC", b"kTRC")  # tone curves of red, green, blue and grey


def is_linear(profile: bytes) -> bool:
    """Return whether all tone curves of a profile are straight; False for one without curves, or not whole."""
    try:
        (count,) = struct.unpack_from(">I", profile, 128)
        tags = [struct.unpack_from(">4sII", profile, 132 + 12 * index) for index in range(min(count, 100))]
        curves = [_is_straight(profile[start : start + size]) for word, start, size in tags if word in _CURVES]
    except struct.error:
        return False
    return bool(curves) and all(curves)


def _is_straight(curve: bytes) -> bool:
    """Return whether a curve, of type `curv` (a table, or a power in 1/256) or `para`, is the identity."""
    if curve[:4] == b"para":
        return struct.unpack_from(">HHi", curve, 8) == (0, 0, 65536)
    (count,) = struct.unpack_from(">I", curve, 8)
    table = np.frombuffer(curve, ">u2", min(count, (len(curve) - 12) // 2), 12)
    if count == 1:
        return bool((table == 256).all())
    return bool(np.allclose(table, np.linspace(0, 65535, len(table)), rtol=0, atol=1))
