"""Device condition in several dimensions."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticbridge.errors import CouplingError
from hapticbridge.passivity.grid import finite, scalar

SYMMETRY = 1e-9
"""Largest asymmetry of a matrix that counts as rounding, relative to its largest entry, without
unit."""


def _symmetric(name: str, value: ArrayLike) -> NDArray[np.float64]:
    matrix = finite(name, value)
    if matrix.ndim == 0:
        matrix = matrix.reshape(1, 1)
    if matrix.ndim < 2 or matrix.shape[-1] != matrix.shape[-2]:
        raise CouplingError(f"{name} has shape {matrix.shape}; it must be square: (..., n, n)")
    transposed = np.swapaxes(matrix, -1, -2)
    if np.abs(matrix - transposed).max() > SYMMETRY * np.abs(matrix).max():
        raise CouplingError(f"{name} is not symmetric; the condition requires symmetric matrices")
    return (matrix + transposed) / 2


def matrix_margin(
    stiffness: ArrayLike,
    damping: ArrayLike,
    device_damping: ArrayLike,
    period: float,
    *,
    scale: float = 1.0,
    force_scale: float = 1.0,
) -> float | NDArray[np.float64]:
    """Returns the smallest eigenvalue of b − s (K T/2 + B), s = scale · force scale.

    Where it is >= 0, the coupling is passive for any passive hand and any discrete-time passive
    environment. K and B are constant. If the device's damping depends on the pose, the condition
    must hold everywhere in the workspace. With entries of different units (translation beside
    rotation) only the sign has a meaning.

    Args:
        stiffness: K in N/m, symmetric and positive semidefinite, shape (..., n, n); a number is 1 ×
            1.
        damping: B in N s/m, symmetric and positive semidefinite, shape (..., n, n).
        device_damping: b in N s/m, symmetric, shape (..., n, n).
        period: T in s, finite and > 0.
        scale: Handle motion per device motion, > 0.
        force_scale: Force on the device per force on the tool, > 0.

    Returns:
        The margin in N s/m, shape (...).

    Raises:
        CouplingError: A matrix is not square, finite and symmetric, K or B is not positive
            semidefinite, the shapes do not fit, or a number is out of range.

    References:
        Brown & Colgate 1997, eq. (6), as a matrix inequality.
    """
    period = scalar("period", period, "s", positive=True)
    factor = scalar("scale", scale, positive=True)
    factor *= scalar("force scale", force_scale, positive=True)
    k, b_coupling, b = (
        _symmetric(name, value)
        for name, value in (
            ("stiffness", stiffness),
            ("damping", damping),
            ("device damping", device_damping),
        )
    )
    for name, matrix in (("stiffness", k), ("damping", b_coupling)):
        lowest = np.linalg.eigvalsh(matrix)[..., 0].min()
        if lowest < -SYMMETRY * np.abs(matrix).max():
            raise CouplingError(f"{name} has the eigenvalue {lowest:g}; all must be >= 0")
    shapes = {matrix.shape[-1] for matrix in (k, b_coupling, b)}
    if len(shapes) > 1:
        raise CouplingError(
            f"matrices of sizes {sorted(shapes)} do not fit together; all must have one size"
        )
    try:
        difference = b - factor * (k * period / 2 + b_coupling)
    except ValueError as error:
        raise CouplingError("the leading shapes of the matrices do not broadcast") from error
    margin = np.asarray(np.linalg.eigvalsh(difference)[..., 0], dtype=np.float64)
    return margin if margin.ndim else float(margin)
