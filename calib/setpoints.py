"""Where the drill goes to calibrate: the paper's five setpoints, and sequences chosen for the error they leave.

A sequence is judged before anything moves: with the nominal microscope, the covariance that its setpoints would leave
is known, and so is the error at every point of the validation box and of the skull (I-optimal design). The true rig
differs by its tilt and scale, which changes these errors by a few per cent.
"""

from collections.abc import Sequence
from functools import lru_cache
from itertools import product

import numpy as np
import numpy.typing as npt

from calib.camera_fit import EYE_MODELS, free_basis
from calib.camera_pair import N_PARAMETERS, CameraPair, Optics, eye_jacobians
from calib.stereo import PAPER_MODEL
from calib.transform import Array
from drivers.errors import OutOfTravelError
from drivers.motion.interface import Travel, Vector

PAPER_SETPOINTS: tuple[Vector, ...] = (
    (0.0, -20.0, 0.0),
    (10.0, -20.0, 0.0),
    (5.0, -10.0, 0.0),
    (10.0, 0.0, 0.0),
    (0.0, 0.0, 0.0),
)
"""The paper's sequence: all at z = 0, so that height and handedness stay unobserved."""
VERIFY_SETPOINT: Vector = (5.0, -10.0, 2.0)
"""In free air above the skull, where an error would hurt."""
FREE_AIR = Travel((0.0, -20.0, 0.0), (10.0, 0.0, 10.0))
"""The box of {R} that holds no specimen."""
DEFAULT_COUNT = 16

_NOMINAL_PERSPECTIVE_PER_MM = 0.002


def default_setpoints(count: int = DEFAULT_COUNT, travel: Travel = FREE_AIR) -> tuple[Vector, ...]:
    """Tip positions in free air and inside ``travel``, chosen for the error at box and skull, in a short order.

    Raises:
        OutOfTravelError: the travel holds no free air.
        ValueError: more setpoints than there are candidates.
    """
    return _default_setpoints(count, travel)


@lru_cache(maxsize=8)
def _default_setpoints(count: int, travel: Travel) -> tuple[Vector, ...]:
    low = np.maximum(FREE_AIR.low_mm, travel.low_mm)
    high = np.minimum(FREE_AIR.high_mm, travel.high_mm)
    if (high < low).any():
        raise OutOfTravelError(
            f"the travel {travel.low_mm} to {travel.high_mm} mm does not meet the free air over the specimen, "
            f"{FREE_AIR.low_mm} to {FREE_AIR.high_mm} mm; check origin_mm in the rig file"
        )
    candidates = grid(low, high, (5, 5, 4))
    chosen = choose(candidates, count, np.vstack([box_points(), skull_points()]))
    return short_order(candidates[chosen])


def grid(low_mm: npt.ArrayLike, high_mm: npt.ArrayLike, counts: tuple[int, int, int]) -> Array:
    """Points (n, 3) of a regular grid that includes its corners."""
    axes = [
        np.linspace(a, b, n)
        for a, b, n in zip(np.asarray(low_mm, float), np.asarray(high_mm, float), counts, strict=True)
    ]
    return np.array(list(product(*axes)))


def box_points() -> Array:
    """The paper's validation box, evenly."""
    return grid(FREE_AIR.low_mm, FREE_AIR.high_mm, (4, 6, 4))


def skull_points(radius_mm: float = 4.0) -> Array:
    """Where bone may be milled: rings up to the largest window, from the crown of the skull to its flanks."""
    angles = np.arange(12) * np.pi / 6
    return np.array(
        [
            (5.0 + r * np.cos(angle), -10.0 + r * np.sin(angle), z)
            for r in (radius_mm / 2, radius_mm)
            for z in (-1.5, -4.0)
            for angle in angles
        ]
    )


def nominal_pair() -> CameraPair:
    """The paper's microscope looking straight down on the box, with a little perspective and no covariance."""
    optics = Optics((5.0, -10.0, 3.0), PAPER_MODEL.center_px, float(np.hypot(*PAPER_MODEL.center_px)))
    # Image x runs along +y of {R}, image y along +x; heights in {Mi} count from z = 0 of {R}.
    basis = np.array(optics.origin_mm) + np.vstack([np.zeros(3), np.eye(3)])
    in_mi = np.stack([basis[:, 1] + 10.0, 5.0 - basis[:, 0], basis[:, 2]], axis=1)
    eyes = []
    for pixels in PAPER_MODEL.project(in_mi):
        eye = np.zeros(N_PARAMETERS)
        eye[:2] = pixels[0] - optics.center_px
        eye[2:8] = (pixels[1:] - pixels[0]).T.ravel()
        eye[8:11] = _NOMINAL_PERSPECTIVE_PER_MM * free_basis("perspective", eye)[8:11, 8]
        eyes.append(eye)
    covariance = np.zeros((2 * N_PARAMETERS, 2 * N_PARAMETERS))
    return CameraPair(optics, eyes[0], eyes[1], covariance, (0.0, 0.0))


def planned_pair(setpoints_mm: npt.ArrayLike, *, sigma_px: float, model: str = "radial") -> CameraPair:
    """The nominal microscope with the covariance that these setpoints would leave: ask it for ``sigma_at`` any point.

    Raises:
        ValueError: the setpoints do not determine the model.
    """
    points, nominal = np.asarray(setpoints_mm, dtype=np.float64), nominal_pair()
    covariance = np.zeros_like(nominal.covariance)
    for start, eye in ((0, nominal.left), (N_PARAMETERS, nominal.right)):
        basis = free_basis(model, eye)
        jacobian = (eye_jacobians(eye, nominal.optics, points)[2] @ basis).reshape(-1, basis.shape[1])
        if np.linalg.matrix_rank(jacobian) < basis.shape[1]:
            raise ValueError(
                f"{len(points)} setpoints do not determine the {basis.shape[1]} parameters of model {model!r}"
            )
        part = slice(start, start + N_PARAMETERS)
        covariance[part, part] = sigma_px**2 * basis @ np.linalg.inv(jacobian.T @ jacobian) @ basis.T
    return CameraPair(nominal.optics, nominal.left, nominal.right, covariance, (sigma_px, sigma_px))


def choose(candidates_mm: Array, count: int, region_mm: Array, *, model: str = "radial") -> list[int]:
    """Indices of ``count`` different candidates that leave the least mean square error over ``region_mm``.

    Greedy from nothing, then exchanges while one helps (Fedorov). The mean square error is tr(M^-1 W), where M is the
    information of the chosen setpoints and W how the parameters move the region's points.

    Raises:
        ValueError: fewer candidates than asked for, or fewer setpoints than the model needs.
    """
    if not EYE_MODELS[model] / 2 <= count <= len(candidates_mm):
        raise ValueError(
            f"{count} setpoints from {len(candidates_mm)} candidates; {model!r} needs {EYE_MODELS[model] // 2} or more"
        )
    nominal = nominal_pair()
    by_point = np.concatenate(
        [eye_jacobians(eye, nominal.optics, region_mm)[1] for eye in (nominal.left, nominal.right)], axis=1
    )
    gain = np.linalg.solve(by_point.transpose(0, 2, 1) @ by_point, by_point.transpose(0, 2, 1))
    information, weight = [], []
    for eye, side in ((nominal.left, slice(0, 2)), (nominal.right, slice(2, 4))):
        basis = free_basis(model, eye)
        rows = eye_jacobians(eye, nominal.optics, candidates_mm)[2] @ basis
        information.append(rows.transpose(0, 2, 1) @ rows)
        moved = gain[:, :, side] @ (eye_jacobians(eye, nominal.optics, region_mm)[2] @ basis)
        weight.append(np.einsum("nij,nik->jk", moved, moved) / len(region_mm))
    both, weights = np.stack(information), np.stack(weight)
    # Enough to invert before the parameters are determined, far too little to matter afterwards.
    ridge = 1e-6 * np.eye(EYE_MODELS[model])

    def errors(base: Array) -> Array:
        """The mean square error after adding each candidate to ``base`` (2, p, p)."""
        inverse = np.linalg.inv(base[:, None] + both + ridge)
        return np.asarray(np.einsum("ecij,eji->c", inverse, weights))

    chosen: list[int] = []
    for _ in range(count):
        scores = errors(both[:, chosen].sum(axis=1))
        scores[chosen] = np.inf
        chosen.append(int(np.argmin(scores)))
    best, improved = np.inf, True
    while improved:
        improved = False
        for place in range(count):
            others = chosen[:place] + chosen[place + 1 :]
            scores = errors(both[:, others].sum(axis=1))
            scores[others] = np.inf
            if scores.min() < best * (1 - 1e-9):
                best, improved = float(scores.min()), True
                chosen[place] = int(np.argmin(scores))
    return chosen


def short_order(points_mm: npt.ArrayLike) -> tuple[Vector, ...]:
    """The points in an order with little travel: nearest neighbour from the highest corner, then 2-opt."""
    points = np.asarray(points_mm, dtype=np.float64)
    distance = np.linalg.norm(points[:, None] - points[None], axis=2)
    order = [int(np.lexsort((points[:, 1], points[:, 0], points[:, 2]))[-1])]
    while len(order) < len(points):
        reach = distance[order[-1]].copy()
        reach[order] = np.inf
        order.append(int(np.argmin(reach)))
    improved = True
    while improved:
        improved = False
        for i in range(1, len(order) - 1):
            for j in range(i + 1, len(order)):
                turned = order[:i] + order[i : j + 1][::-1] + order[j + 1 :]
                if _length(distance, turned) < _length(distance, order) - 1e-9:
                    order, improved = turned, True
    return tuple((float(x), float(y), float(z)) for x, y, z in points[order])


def _length(distance: Array, order: Sequence[int]) -> float:
    return float(distance[order[:-1], order[1:]].sum())
