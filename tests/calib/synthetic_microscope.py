"""A stereo microscope of pinholes toed in on each other, written apart from the code under test."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

SIZE_PX = (960, 540)


@dataclass(frozen=True)
class Microscope:
    """Looks down on (5, -10, 0) of {R}: picture right is +y, picture down is +x, both turned by tilt and roll."""

    toe_in_deg: float = 7.26
    tilt_deg: float = 12.0
    tilt_about_deg: float = 40.0
    yaw_deg: float = 2.0
    roll_deg: tuple[float, float] = (0.4, -0.3)
    px_per_mm: tuple[float, float] = (25.4, 25.6)
    perspective_per_mm: float = 0.002
    distortion: float = 0.01
    swapped: bool = False
    mirrored: tuple[bool, bool] = (False, False)

    def project(self, points_mm):
        """Pixels (n, 2) in the left and in the right picture."""
        eyes = [self._eye(np.asarray(points_mm, float), side) for side in (0, 1)]
        for side, mirrored in enumerate(self.mirrored):
            if mirrored:
                eyes[side][:, 0] = SIZE_PX[0] - eyes[side][:, 0]
        return (eyes[1], eyes[0]) if self.swapped else (eyes[0], eyes[1])

    def _eye(self, points, side):
        looking_down = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
        about = np.deg2rad(self.tilt_about_deg)
        tilt = Rotation.from_rotvec(np.deg2rad(self.tilt_deg) * np.array([np.cos(about), np.sin(about), 0]))
        yaw = Rotation.from_euler("z", self.yaw_deg, degrees=True)
        # The left eye looks towards picture right, the right eye towards picture left.
        phi = np.deg2rad(self.toe_in_deg) * (1 if side == 0 else -1)
        toe = np.array([[np.cos(phi), 0, -np.sin(phi)], [0, 1, 0], [np.sin(phi), 0, np.cos(phi)]])
        roll = Rotation.from_euler("z", self.roll_deg[side], degrees=True).as_matrix()
        seen = (points - [5.0, -10.0, 0.0]) @ (roll @ toe @ looking_down @ (tilt * yaw).as_matrix()).T
        q = self.px_per_mm[side] * seen[:, :2] / (1 + self.perspective_per_mm * seen[:, 2:])
        square = (q**2).sum(axis=1, keepdims=True) / (480.0**2 + 270.0**2)
        return np.array([480.0, 270.0]) + q * (1 + self.distortion * square)


ORTHOGRAPHIC = Microscope(
    tilt_deg=0, yaw_deg=0, roll_deg=(0, 0), px_per_mm=(1 / 0.03947,) * 2, perspective_per_mm=0, distortion=0
)
"""The paper's microscope as its own numbers imply it: two parallel projections toed in by 7.26 degrees."""

PLAIN = replace(ORTHOGRAPHIC, tilt_deg=12.0, yaw_deg=2.0)
"""The same, tilted against the robot."""


def box_samples(rng, n):
    """Random points of the paper's validation box."""
    return rng.uniform([0, -20, 0], [10, 0, 10], (n, 3))
