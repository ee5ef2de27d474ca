"""Rigid transforms and similarities between coordinate frames, as numpy arrays.

Names state both frames: `world_from_camera` maps a point in the camera to the world. Cameras look along z, x is right
and y is down. Quaternions are in the order x, y, z, w.
"""

from __future__ import annotations

from typing import Any, Tuple, overload

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

# Largest deviation of a quaternion from unit length: rounding, not another transform.
QUATERNION_TOLERANCE = 1e-6


def _rotation(quaternion: Floats) -> Floats:
    x, y, z, w = (float(value) for value in quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def _product(left: Floats, right: Floats) -> Floats:
    (ax, ay, az, aw), (bx, by, bz, bw) = left, right
    product = np.array(
        [
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        ]
    )
    unit: Floats = product / np.linalg.norm(product)
    return unit


class Transform:
    """`x' = scale · R x + t`: a rigid transform if `scale` is 1, else a similarity."""

    __slots__ = ("quaternion", "translation", "scale")

    def __init__(self, quaternion: npt.ArrayLike, translation: npt.ArrayLike, scale: float = 1.0) -> None:
        """From a unit quaternion (x, y, z, w), a translation, and a scale."""
        self.quaternion: Floats = np.array(quaternion, dtype=np.float64)
        self.translation: Floats = np.array(translation, dtype=np.float64)
        self.scale = float(scale)
        self.quaternion.flags.writeable = False
        self.translation.flags.writeable = False

    @classmethod
    def identity(cls) -> Transform:
        """The identity transform."""
        return cls([0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.0])

    @property
    def rotation(self) -> Floats:
        """The rotation as a 3×3 matrix."""
        return _rotation(self.quaternion)

    @property
    def matrix(self) -> Floats:
        """The transform as a 4×4 matrix; its rotation is multiplied by the scale."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.scale * self.rotation
        matrix[:3, 3] = self.translation
        return matrix

    def inverse(self) -> Transform:
        """The inverse: `b_from_a` for `a_from_b`."""
        x, y, z, w = self.quaternion
        back = np.array([-x, -y, -z, w])
        scale = 1.0 / self.scale
        return Transform(back, -scale * (_rotation(back) @ self.translation), scale)

    def is_valid(self) -> bool:
        """Whether all numbers are finite, the quaternion has unit length and the scale is positive."""
        is_unit = abs(float(np.linalg.norm(self.quaternion)) - 1.0) <= QUATERNION_TOLERANCE
        is_scale = np.isfinite(self.scale) and self.scale > 0.0
        return bool(is_unit and is_scale and np.isfinite(self.translation).all())

    @overload
    def __matmul__(self, other: Transform) -> Transform: ...

    @overload
    def __matmul__(self, other: npt.NDArray[Any]) -> Floats: ...

    def __matmul__(self, other: Any) -> Any:
        """`a_from_b @ b_from_c`, or `a_from_b @ points_in_b` with points as rows of an n×3 array or one of 3."""
        if isinstance(other, Transform):
            quaternion = _product(self.quaternion, other.quaternion)
            return Transform(quaternion, self @ other.translation, self.scale * other.scale)
        points = np.asarray(other)
        if points.shape[-1:] != (3,):
            raise ValueError(f"points are rows of three numbers, not an array of shape {points.shape}")
        return points @ (self.scale * self.rotation).T + self.translation

    def __repr__(self) -> str:
        """All numbers, abbreviated."""
        t, q = self.translation, self.quaternion
        text = f"t=({t[0]:.4g}, {t[1]:.4g}, {t[2]:.4g}) q=({q[0]:.4g}, {q[1]:.4g}, {q[2]:.4g}, {q[3]:.4g})"
        return f"Transform({text})" if self.scale == 1.0 else f"Transform({text} scale={self.scale:.4g})"


def symmetric(upper_triangle: npt.ArrayLike, size: int) -> Floats:
    """The symmetric matrix with this upper triangle, row by row."""
    values = np.asarray(upper_triangle, dtype=np.float64)
    matrix = np.zeros((size, size))
    rows, columns = np.triu_indices(size)
    matrix[rows, columns] = values
    matrix[columns, rows] = values
    return matrix


def rigid(values: Any) -> Transform:
    """The transform of a message: x, y, z, w, tx, ty, tz, and the scale of a similarity."""
    numbers = np.ctypeslib.as_array(values)
    return Transform(numbers[:4], numbers[4:7], float(numbers[7]) if len(numbers) == 8 else 1.0)


class Intrinsics:
    """A camera without distortion: images are rectified."""

    __slots__ = ("fx", "fy", "cx", "cy", "width", "height")

    def __init__(self, fx: float, fy: float, cx: float, cy: float, width: int, height: int) -> None:
        """Focal lengths and principal point in pixels (integer at a pixel's centre), size in pixels."""
        self.fx, self.fy, self.cx, self.cy = fx, fy, cx, cy
        self.width, self.height = width, height

    @property
    def matrix(self) -> Floats:
        """The 3×3 matrix K."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def size(self) -> Tuple[int, int]:
        """Width and height in pixels."""
        return self.width, self.height

    def is_valid(self) -> bool:
        """Whether the values are possible for a camera."""
        numbers = np.isfinite([self.fx, self.fy, self.cx, self.cy]).all()
        return bool(numbers and self.fx > 0 and self.fy > 0 and self.width > 0 and self.height > 0)

    def __repr__(self) -> str:
        """All numbers, abbreviated."""
        return (
            f"Intrinsics(fx={self.fx:.2f}, fy={self.fy:.2f}, cx={self.cx:.2f}, cy={self.cy:.2f}, "
            f"width={self.width}, height={self.height})"
        )
