"""Points for interpolation that do not crowd at the ends of a panel.

Polynomials need points that do (Chebyshev's, Gauss's): in the middle these are pi/2 times as far apart as evenly
spaced ones. Polynomials in s, where a place in the panel is

    p(s) = 1/2 + asin(e (2 s - 1)) / (2 asin(e)),        0 <= e < 1

need points that crowd less, the closer e is to 1; and are as accurate as long as not too many digits are asked
for, since p is singular a little beyond the ends (Kosloff and Tal-Ezer, J. Comput. Phys. 104, 1993).
"""

import numpy as np
import numpy.typing as npt

Float64 = npt.NDArray[np.float64]


def spaced(s: Float64, even: float) -> Float64:
    """The places p(s), both in panels from the first one's lower end on, for e = `even`."""
    if not even:
        return s
    panel = np.floor(s)
    return np.asarray(panel + 0.5 + np.arcsin(even * (2.0 * (s - panel) - 1.0)) / (2.0 * np.arcsin(even)))


def crowded(places: Float64, even: float) -> Float64:
    """The s of `places`: the inverse of `spaced`."""
    if not even:
        return places
    panel = np.floor(places)
    return np.asarray(panel + 0.5 + np.sin(np.arcsin(even) * (2.0 * (places - panel) - 1.0)) / (2.0 * even))
