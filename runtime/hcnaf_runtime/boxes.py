"""When two boxes meet: where the centre of one lies in the Minkowski sum of both, an octagon."""

import math

import numpy as np
import numpy.typing as npt

Float64 = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]


def octagons(pose: Float64, size: Float64, other_yaw: Float64, other_size: Float64) -> Float64:
    """Where the centre of another box is when it meets a box: [..., 8, 2], counter-clockwise.

    The box is at `pose` [3, ...], x, y (m) and yaw (rad) of its centre, with length and width `size` [2] (m);
    `other_yaw` [...] and `other_size` [..., 2] are those of the other one. In memory all x come before all y.
    """
    x, y, yaw = pose
    quarters = np.floor((yaw - other_yaw) / (math.pi / 2))
    turn = yaw - other_yaw - quarters * (math.pi / 2)  # from 0 to a right angle
    odd = quarters % 2 == 1
    length, width = np.where(odd, size[1], size[0]) / 2, np.where(odd, size[0], size[1]) / 2
    c, s = np.cos(turn), np.sin(turn)
    A, B = np.moveaxis(other_size, -1, 0) / 2
    # Half the sides of both, in the other's axes, in the order of their directions; the corners go along them.
    u, v = (A, length * c, 0.0, -width * s), (0.0, length * s, B, width * c)
    half = np.empty((2, 4, *turn.shape))
    half[0, 0], half[1, 0] = -sum(u), -sum(v)
    for k in range(3):
        half[0, k + 1], half[1, k + 1] = half[0, k] + 2.0 * u[k], half[1, k] + 2.0 * v[k]
    C, S = np.cos(other_yaw), np.sin(other_yaw)
    corners = np.empty((2, 8, *turn.shape))
    for row, middle, part in ((0, x, C * half[0] - S * half[1]), (1, y, S * half[0] + C * half[1])):
        corners[row, :4], corners[row, 4:] = middle + part, middle - part
    return np.moveaxis(corners, (0, 1), (-1, -2))


def reach(yaw: Float64, size: Float64, other_yaw: Float64, other_size: Float64) -> Float64:
    """[2, ...]: how far an octagon extends from its middle along x and y (m); arguments as in `octagons`."""
    c, s, C, S = (np.abs(f(v)) for v in (yaw, other_yaw) for f in (np.cos, np.sin))
    A, B = np.moveaxis(other_size, -1, 0) / 2
    a, b = size / 2
    return np.stack([c * a + s * b + C * A + S * B, s * a + c * b + S * A + C * B])


def boxes_meet(
    dx: Float64, dy: Float64, yaw: Float64, size: Float64, other_yaw: Float64, other_size: Float64
) -> Mask:
    """Whether boxes meet [...]: `dx`, `dy` lead from the centre of one to that of the other (m).

    No line that separates them runs along a side of either.
    """
    c, s = np.cos(yaw), np.sin(yaw)
    C, S = np.cos(other_yaw), np.sin(other_yaw)
    cosine, sine = np.abs(c * C + s * S), np.abs(s * C - c * S)
    a, b = np.moveaxis(size, -1, 0) / 2
    A, B = np.moveaxis(other_size, -1, 0) / 2
    return np.asarray(
        (np.abs(c * dx + s * dy) <= a + cosine * A + sine * B)
        & (np.abs(c * dy - s * dx) <= b + sine * A + cosine * B)
        & (np.abs(C * dx + S * dy) <= A + cosine * a + sine * b)
        & (np.abs(C * dy - S * dx) <= B + sine * a + cosine * b)
    )
