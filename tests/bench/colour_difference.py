"""Colour difference CIEDE2000 of linear sRGB pictures."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
TO_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])  # IEC 61966-2-1
WHITE = TO_XYZ.sum(axis=1)


def lab(encoded: Floats) -> Floats:
    """Return CIE L*a*b* (D65) of sRGB values in 0..1, both (n, 3)."""
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    xyz = linear @ TO_XYZ.T / WHITE
    f = np.where(xyz > (6 / 29) ** 3, np.cbrt(xyz), xyz / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.stack([116 * f[:, 1] - 16, 500 * (f[:, 0] - f[:, 1]), 200 * (f[:, 1] - f[:, 2])], axis=1)


def ciede2000(left: Floats, right: Floats) -> Floats:
    """Return dE00 (n,) of two lists of L*a*b* values (n, 3); G. Sharma et al., Color Res. Appl. 30, 21, 2005."""
    chroma = (np.hypot(left[:, 1], left[:, 2]) + np.hypot(right[:, 1], right[:, 2])) / 2
    stretch = 1.5 - 0.5 * np.sqrt(chroma**7 / (chroma**7 + 25.0**7))
    a1, a2 = left[:, 1] * stretch, right[:, 1] * stretch
    c1, c2 = np.hypot(a1, left[:, 2]), np.hypot(a2, right[:, 2])
    h1, h2 = np.arctan2(left[:, 2], a1), np.arctan2(right[:, 2], a2)
    turn = (h2 - h1 + np.pi) % (2 * np.pi) - np.pi
    turn = np.where(c1 * c2 == 0, 0, turn)
    lightness, c, hue = (left[:, 0] + right[:, 0]) / 2, (c1 + c2) / 2, h1 + turn / 2
    t = (
        1
        - 0.17 * np.cos(hue - np.radians(30))
        + 0.24 * np.cos(2 * hue)
        + 0.32 * np.cos(3 * hue + np.radians(6))
        - 0.2 * np.cos(4 * hue - np.radians(63))
    )
    s_l = 1 + 0.015 * (lightness - 50) ** 2 / np.sqrt(20 + (lightness - 50) ** 2)
    s_c, s_h = 1 + 0.045 * c, 1 + 0.015 * c * t
    near_blue = np.exp(-(((np.degrees(hue) % 360 - 275) / 25) ** 2))
    r_t = -np.sin(np.radians(60 * near_blue)) * 2 * np.sqrt(c**7 / (c**7 + 25.0**7))
    d_l, d_c, d_h = (right[:, 0] - left[:, 0]) / s_l, (c2 - c1) / s_c, 2 * np.sqrt(c1 * c2) * np.sin(turn / 2) / s_h
    squared: Floats = np.maximum(d_l**2 + d_c**2 + d_h**2 + r_t * d_c * d_h, 0)
    return np.sqrt(squared)
