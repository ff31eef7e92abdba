"""Claims of the colours that maps share."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from matplotlib.colors import to_rgb
from numpy.typing import NDArray

from hapticbridge.lab.maps.base import COLOURS, METHOD_COLOURS, THEORY_COLOUR
from hapticbridge.lab.methods import METHODS

TOLD_APART = 20.0
"""Distance in CIELAB from which on two colours of thin lines do not pass for each other: about ten
times what is just noticed side by side (2.3)."""


def lab(colour: str) -> NDArray[np.float64]:
    """Returns CIELAB coordinates of an sRGB colour (IEC 61966-2-1, white D65)."""
    rgb = np.array(to_rgb(colour))
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    to_xyz = np.array(
        [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
    )
    share = to_xyz @ linear / (to_xyz @ np.ones(3))
    f = np.where(share > (6 / 29) ** 3, np.cbrt(share), share / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def test_every_method_has_a_colour() -> None:
    assert set(METHOD_COLOURS) == set(METHODS)


def test_no_method_passes_for_a_verdict_for_theory_or_for_another_method() -> None:
    methods = list(METHOD_COLOURS.values())
    others = [(mine, other) for mine in methods for other in (*COLOURS, THEORY_COLOUR)]
    for one, other in [*combinations(methods, 2), *others]:
        assert np.linalg.norm(lab(one) - lab(other)) > TOLD_APART, (one, other)
