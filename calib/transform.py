"""Rigid transforms that know the frames they join."""

from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

_ORTHONORMAL_WITHIN = 1e-6


@dataclass(frozen=True, eq=False)
class RigidTransform:
    """A rotation and a shift from frame ``source`` to frame ``target``: p_target = rotation p_source + translation_mm.

    Raises:
        ValueError: a wrong shape, a value that is not finite, or a matrix that is no proper rotation.
    """

    target: str
    source: str
    rotation: Array
    """(3, 3), orthonormal, determinant +1."""
    translation_mm: Array
    """(3,), mm, in the target frame."""

    def __post_init__(self) -> None:
        rotation = np.array(self.rotation, dtype=np.float64)
        translation = np.array(self.translation_mm, dtype=np.float64)
        name = f"transform {self.target} <- {self.source}"
        if rotation.shape != (3, 3) or translation.shape != (3,):
            raise ValueError(
                f"{name}: rotation {rotation.shape}, translation {translation.shape}; (3, 3) and (3,) wanted"
            )
        if not (np.isfinite(rotation).all() and np.isfinite(translation).all()):
            raise ValueError(f"{name}: holds a value that is not finite")
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > _ORTHONORMAL_WITHIN:
            raise ValueError(f"{name}: the rotation's rows are not orthonormal within {_ORTHONORMAL_WITHIN:g}")
        if np.linalg.det(rotation) < 0:
            raise ValueError(f"{name}: determinant -1, a mirror and no rotation")
        rotation.flags.writeable = translation.flags.writeable = False
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation_mm", translation)

    @classmethod
    def identity(cls, frame: str) -> Self:
        """The transform of a frame to itself that moves nothing."""
        return cls(frame, frame, np.eye(3), np.zeros(3))

    def apply(self, points_mm: npt.ArrayLike) -> Array:
        """Points (..., 3) of the source frame, in the target frame; mm."""
        return np.asarray(points_mm, dtype=np.float64) @ self.rotation.T + self.translation_mm

    def rotate(self, directions: npt.ArrayLike) -> Array:
        """Directions (..., 3) of the source frame, in the target frame: no shift."""
        return np.asarray(directions, dtype=np.float64) @ self.rotation.T

    def inverse(self) -> "RigidTransform":
        """The way back."""
        return RigidTransform(self.source, self.target, self.rotation.T, -self.rotation.T @ self.translation_mm)

    def __matmul__(self, other: "RigidTransform") -> "RigidTransform":
        """``other`` first, then this one.

        Raises:
            ValueError: the frames do not meet.
        """
        if self.source != other.target:
            raise ValueError(
                f"frames do not meet: {self.target} <- {self.source} after {other.target} <- {other.source}"
            )
        return RigidTransform(
            self.target, other.source, self.rotation @ other.rotation, self.apply(other.translation_mm)
        )
