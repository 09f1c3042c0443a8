"""How deep the tip went below what it was permitted, by the record's own events and the bench's truth.

Independent of the ledger: a point is permitted the deepest depth below its contact that was ever granted there, and
between two points the tip may be where a smooth path through such depths leads.
"""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from milling.contact import STEP_MM
from milling.spline import periodic_spline
from milling.trajectory import closed_path

Floats = npt.NDArray[np.float64]

FELT_MM: Final = 1.5 * STEP_MM
"""The last two steps of a contact are permitted ones; the contact is the middle of the first."""
BETWEEN: Final = 16
"""Places from one point to the next."""
BESIDE_MM: Final = 0.2
"""Farther from the path the tip is on its way through the air, where no depth is permitted or needed."""


class Overrun:
    """Fed with events as they are recorded, and with places of the tip."""

    def __init__(self) -> None:
        self.greatest_mm = 0.0
        """Of all places told so far; 0 where the tip was never below."""
        self._contact: dict[int, float] = {}
        self._permitted: Floats = np.zeros(0)
        self._knots: Floats = np.zeros(0)
        self._length_mm = 0.0
        self._tip_xy: Floats = np.zeros((0, 2))
        self._lowest_z: Floats = np.zeros(0)

    def event(self, kind: str, fields: Mapping[str, Any]) -> None:
        """What of an event permits anything."""
        match kind:
            case "trajectory":
                tip = np.asarray(fields["tip_mm"], dtype=np.float64)
                theta_rad = 2 * np.pi * np.arange(1, len(tip) + 1) / len(tip)
                path = closed_path(theta_rad, tip[:, :2])
                self._knots, self._length_mm = np.asarray(path.x[:-1]), float(path.x[-1])
                self._tip_xy = path(np.linspace(0.0, self._length_mm, BETWEEN * len(tip), endpoint=False))
                self._permitted = np.full(len(tip), FELT_MM)
                self._contact = {}
            case "contact":
                self._contact[int(fields["point"]) - 1] = float(fields["z_mm"])
                self._draw()
            case "asked" | "cut" if fields.get("reason", "") == "":
                index = int(fields["point"]) - 1
                if fields["depth_mm"] > self._permitted[index]:
                    self._permitted[index] = fields["depth_mm"]
                    self._draw()

    def at(self, tip_mm: Floats) -> None:
        """The tip is there."""
        if not len(self._lowest_z):
            return
        away = np.hypot(*(self._tip_xy - tip_mm[:2]).T)
        nearest = int(np.argmin(away))
        if away[nearest] < BESIDE_MM:
            self.greatest_mm = max(self.greatest_mm, float(self._lowest_z[nearest] - tip_mm[2]))

    def _draw(self) -> None:
        if len(self._contact) < len(self._permitted):
            return
        top = np.array([self._contact[index] for index in range(len(self._permitted))])
        along = np.linspace(0.0, self._length_mm, len(self._tip_xy), endpoint=False)
        z = periodic_spline(self._knots, top - self._permitted, self._length_mm)(along)
        # A path that was once permitted stays so: a neighbour's bite bends the smooth path up a little elsewhere.
        self._lowest_z = z if not len(self._lowest_z) else np.minimum(self._lowest_z, z)
