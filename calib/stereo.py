"""The paper's linear model of the stereo microscope, corrected.

    X = P_x (x_m - c_x)      Y = -P_y (y_m - c_y)      Z = (x_l - x_r)/h + d_e      (x_m, y_m: mean of left and right)

As printed, the second row multiplies x_l; P is said to be px/mm and h mm/px, the inverse of what they are; x right,
y down and z up make a left-handed frame that no rotation can fit; and x from the left eye alone leaves a shear, because
the eyes are toed in. The constants belong to one microscope: this model needs them beforehand, `camera_pair` does not.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from calib.transform import Array


@dataclass(frozen=True)
class StereoModel:
    """Pixels to the right-handed microscope frame {Mi}: X right, Y up in the picture, Z towards the eyes; mm."""

    pitch_x_mm_per_px: float = 0.03947
    pitch_y_mm_per_px: float = 0.03894
    center_px: tuple[float, float] = (480.0, 270.0)
    disparity_px_per_mm: float = 6.4
    """h: px of x_l - x_r for each mm of height."""
    depth_offset_mm: float = 0.0
    """d_e: height at which both eyes agree."""

    def points_from_pixels(self, left_px: npt.ArrayLike, right_px: npt.ArrayLike) -> Array:
        """Points (n, 3) in {Mi}, mm, from pixels (n, 2) of both eyes."""
        left, right = np.asarray(left_px, dtype=np.float64), np.asarray(right_px, dtype=np.float64)
        mean = (left + right) / 2
        return np.stack(
            [
                self.pitch_x_mm_per_px * (mean[..., 0] - self.center_px[0]),
                -self.pitch_y_mm_per_px * (mean[..., 1] - self.center_px[1]),
                (left[..., 0] - right[..., 0]) / self.disparity_px_per_mm + self.depth_offset_mm,
            ],
            axis=-1,
        )

    def project(self, points_mm: npt.ArrayLike) -> tuple[Array, Array]:
        """Pixels (n, 2) in the left and in the right eye of points (n, 3) in {Mi}."""
        points = np.asarray(points_mm, dtype=np.float64)
        x = self.center_px[0] + points[..., 0] / self.pitch_x_mm_per_px
        y = self.center_px[1] - points[..., 1] / self.pitch_y_mm_per_px
        half = self.disparity_px_per_mm * (points[..., 2] - self.depth_offset_mm) / 2
        return np.stack([x + half, y], axis=-1), np.stack([x - half, y], axis=-1)

    def covariance_mm2(self, sigma_px: tuple[float, float]) -> Array:
        """(3, 3) of one point's error when x and y of both eyes err independently by ``sigma_px``."""
        x_px2, y_px2 = np.square(sigma_px)
        return np.diag(
            [
                self.pitch_x_mm_per_px**2 * x_px2 / 2,
                self.pitch_y_mm_per_px**2 * y_px2 / 2,
                2 * x_px2 / self.disparity_px_per_mm**2,
            ]
        )


PAPER_MODEL = StereoModel()
