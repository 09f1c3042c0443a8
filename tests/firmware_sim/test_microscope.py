"""The pictures: geometry by law, appearance by what a reader of them depends on."""

import threading

import cv2
import numpy as np
import pytest

from firmware_sim.machine import Machine
from firmware_sim.microscope import Microscope
from firmware_sim.optics import draw_eyes
from firmware_sim.specimen import Rig, Specimen, draw_specimen

PLAIN = Rig(microscope_tilt_deg=0.0, perspective=0.0, distortion=0.0)


@pytest.fixture(scope="module")
def built() -> Microscope:
    return Microscope(Machine(Specimen(seed=4)))


@pytest.fixture
def scope(built: Microscope) -> Microscope:
    built.machine.restore_bone()
    built.machine.set_tip((23.0, -10.0, 12.0))
    built.machine.set_spindle(0.0)
    return built


def ring(scope: Microscope, n: int = 256) -> np.ndarray:
    angle = np.linspace(0, 2 * np.pi, n, endpoint=False)
    return np.array(scope.machine.specimen.skull.center_mm[:2]) + 2 * np.column_stack([np.cos(angle), np.sin(angle)])


def put_ball(scope: Microscope, center_mm: np.ndarray) -> None:
    tool = scope.machine.specimen.tool
    scope.machine.set_tip(center_mm - tool.ball_radius_mm * np.array(tool.axis))


def test_the_picture_lies_along_the_robot_as_agreed() -> None:
    left, right = draw_eyes(PLAIN)
    points = np.array([5.0, -10.0, 0.0]) + np.vstack([np.zeros(3), np.eye(3)])
    steps = [eye.project(points) for eye in (left, right)]
    for pixels in steps:
        down, across = pixels[1] - pixels[0], pixels[2] - pixels[0]
        assert down == pytest.approx([0, 25.4], abs=1.3)
        assert across == pytest.approx([25.2, 0], abs=1.3)
    disparity = steps[0][:, 0] - steps[1][:, 0]
    assert disparity[3] - disparity[0] == pytest.approx(6.4, abs=0.3)


def test_perspective_and_distortion_have_the_size_named() -> None:
    points = np.array([[5.0, -10.0, 0.0], [5.0, 0.0, 0.0], [5.0, -10.0, 10.0], [5.0, 0.0, 10.0]])
    spans = {}
    for name, rig in (("plain", PLAIN), ("near", PLAIN.model_copy(update={"perspective": 0.02}))):
        pixels = draw_eyes(rig)[0].project(points)
        spans[name] = (pixels[1, 0] - pixels[0, 0], pixels[3, 0] - pixels[2, 0])
    assert spans["near"][1] / spans["near"][0] == pytest.approx(1.02 * spans["plain"][1] / spans["plain"][0], abs=0.004)
    bent = draw_eyes(PLAIN.model_copy(update={"distortion": 0.01}))[0].project(points)
    plain = draw_eyes(PLAIN)[0].project(points)
    reach = plain[1, 0] - 480.0
    assert bent[1, 0] - plain[1, 0] == pytest.approx(reach * 0.01 * (reach / 480.0) ** 2, abs=0.3)


def test_pictures_have_the_agreed_form_and_repeat(scope: Microscope) -> None:
    left, right = scope.render(1.0)
    assert left.shape == right.shape == (540, 960, 3)
    assert left.dtype == np.uint8
    again = scope.render(1.0)
    assert (again[0] == left).all()
    assert (again[1] == right).all()
    later = scope.render(1.1)[0]
    noise = (later.astype(float) - left.astype(float)).std() / np.sqrt(2)
    assert 0.3 * 2.0 < noise < 2.0 * 2.0


def test_a_new_microscope_sees_the_same(scope: Microscope) -> None:
    scope.machine.carve(ring(scope), 0.3)
    put_ball(scope, np.array([5.0, -9.0, -1.0]))
    left, right = scope.render(2.0)
    fresh = Microscope(scope.machine).render(2.0)
    # Shaded in parts or as a whole: the same to a grey level.
    assert np.abs(fresh[0].astype(int) - left.astype(int)).max() <= 1
    assert np.abs(fresh[1].astype(int) - right.astype(int)).max() <= 1


def test_the_ball_is_drawn_round_its_projection(scope: Microscope) -> None:
    for center in ([5.0, -10.0, 1.0], [2.0, -17.0, 4.0], [8.0, -4.0, 8.0]):
        put_ball(scope, np.array(center))
        for side, pixel in zip(("left", "right"), scope.project([center]), strict=True):
            mask = scope.drill_mask(side)  # type: ignore[arg-type]
            rows, columns = np.nonzero(mask)
            x, y = pixel[0]
            # The half that the neck leaves free, away from the shank.
            away = np.hypot(columns - x, rows - y)
            lower = rows < y - 4
            assert away[lower].max() == pytest.approx(0.5 / 0.0394, abs=1.2)
            assert columns[lower].mean() == pytest.approx(x, abs=1.0)


def test_the_drill_leaves_the_picture_at_its_park_position(scope: Microscope) -> None:
    assert not scope.drill_mask("left").any()
    assert not scope.drill_mask("right").any()
    labels = scope.labels()
    assert labels.ball_visible == (False, False)
    assert labels.bregma_visible == labels.lambda_visible == (True, True)


def test_the_drill_hides_a_landmark(scope: Microscope) -> None:
    put_ball(scope, scope.machine.skull.bregma_mm + np.array([0, 0, 0.6]))
    labels = scope.labels()
    assert labels.ball_visible == (True, True)
    assert labels.bregma_visible == (False, False)


def test_both_eyes_see_the_same_surface(scope: Microscope) -> None:
    left, right = scope.render(0.0)
    around = np.array([[0.8, 0.9, 0], [-1.2, 1.5, 0], [1.5, -1.0, 0]]) + scope.machine.specimen.skull.center_mm
    around[:, 2] = scope.machine.skull.surface.outer_z(around[:, 0], around[:, 1])
    grey = [cv2.cvtColor(cv2.GaussianBlur(image, (5, 5), 1.0), cv2.COLOR_RGB2GRAY) for image in (left, right)]
    for a, b in zip(*scope.project(around), strict=True):
        patch = cv2.getRectSubPix(grey[0], (31, 31), tuple(a))
        search = cv2.getRectSubPix(grey[1], (43, 43), tuple(b))
        found = cv2.minMaxLoc(cv2.matchTemplate(search, patch, cv2.TM_CCOEFF_NORMED))
        assert found[1] > 0.7
        assert np.hypot(found[3][0] - 6, found[3][1] - 6) <= 1.5


def test_completion_per_pixel_agrees_with_the_bone(scope: Microscope) -> None:
    path = ring(scope)
    scope.machine.carve(path, 0.2)
    points = np.column_stack([path, scope.machine.skull.surface.outer_z(path[:, 0], path[:, 1]) - 0.2])[::16]
    wanted = scope.machine.completion_at(points)
    for side, pixels in zip(("left", "right"), scope.project(points), strict=True):
        seen = scope.completion_map_px(side)  # type: ignore[arg-type]
        read = [seen[round(y), round(x)] for x, y in pixels]
        assert read == pytest.approx(wanted, abs=0.05)
        assert np.isnan(seen[5, 5])
        assert seen[round(pixels[:, 1].mean()), round(pixels[:, 0].mean())] == 0.0


def test_bone_changes_little_while_thinning_and_clearly_at_penetration(scope: Microscope) -> None:
    """The colour along the kerf, as a reader of the pictures depends on it."""
    path = ring(scope)
    colours = []
    thickness = scope.machine.skull.remaining_at(path[:, 0], path[:, 1])
    for share in (0.4, 0.9, 1.15):
        scope.machine.restore_bone()
        scope.machine.carve(path, share * thickness)
        z = scope.machine.skull.surface.outer_z(path[:, 0], path[:, 1]) - share * thickness
        image = scope.render(0.0)[0]
        pixels = np.round(scope.project(np.column_stack([path, z]))[0]).astype(int)
        colours.append(image[pixels[:, 1], pixels[:, 0]].astype(float).mean(axis=0))
    redness = [c[0] / (c[1] + c[2]) for c in colours]
    assert redness[2] > redness[1] > redness[0]
    assert redness[2] - redness[1] > 0.08


def test_drops_can_be_poured(scope: Microscope) -> None:
    at = scope.machine.skull.bregma_mm + np.array([1.5, 0.8, 0])
    x, y = np.round(scope.project([at])[0][0]).astype(int)
    before = scope.render(0.0)[0][y - 2 : y + 3, x - 2 : x + 3].astype(float).mean(axis=(0, 1))
    scope.pour(at[:2], 0.4, "blood")
    after = scope.render(0.0)[0][y - 2 : y + 3, x - 2 : x + 3].astype(float).mean(axis=(0, 1))
    assert after[1] < 0.7 * before[1]


def test_a_film_of_blood_reddens_bone_and_kerf_alike(scope: Microscope) -> None:
    path = ring(scope)
    scope.machine.carve(path, 0.1)
    floor = np.column_stack([path, scope.machine.skull.surface.outer_z(path[:, 0], path[:, 1]) - 0.1])
    inside = np.round(scope.project(floor)[0]).astype(int)
    beside = inside + np.array([30, 0])
    green = []
    for cover in (0.0, 0.3, 0.6):
        scope.smear(cover)
        image = scope.render(0.0)[0].astype(float)
        green.append([image[at[:, 1], at[:, 0], 1].mean() for at in (inside, beside)])
    assert (np.diff(green, axis=0) < -5.0).all()


def test_a_picture_may_be_taken_while_the_machine_cuts(scope: Microscope) -> None:
    path = ring(scope, 400)
    failures: list[BaseException] = []

    def mill() -> None:
        try:
            for k in range(0, 400, 4):
                scope.machine.carve(path[k : k + 5], 0.2, closed=False)
        except BaseException as error:  # a thread's failure must reach the test
            failures.append(error)

    thread = threading.Thread(target=mill)
    thread.start()
    for k in range(4):
        scope.render(float(k))
    thread.join(20.0)
    assert not thread.is_alive()
    assert not failures
    assert (scope.completion_map_px() > 0.2).sum() > 500


def test_an_eggshell_has_no_landmarks_and_looks_pale() -> None:
    scope = Microscope(Machine(draw_specimen(3, "eggshell")))
    labels = scope.labels()
    assert labels.bregma_visible == labels.lambda_visible == (False, False)
    image = scope.render(0.0)[0][200:340, 400:560].astype(float)
    assert image.mean() > 100


def test_a_photograph_lies_over_the_landmarks(tmp_path: object) -> None:
    """A photograph with two coloured discs as bregma and lambda shows them where the truth says."""
    photo = np.full((400, 400, 3), 150, np.uint8)
    cv2.circle(photo, (210, 130), 5, (0, 0, 220), -1)
    cv2.circle(photo, (200, 230), 5, (220, 0, 0), -1)
    path = f"{tmp_path}/photo.png"
    cv2.imwrite(path, photo)
    specimen = Specimen.model_validate(
        {"appearance": {"texture": path, "bregma_px": (210, 130), "lambda_px": (200, 230), "wetness": 0.0}, "seed": 2}
    )
    scope = Microscope(Machine(specimen))
    image = scope.render(0.0)[0].astype(int)
    labels = scope.labels()
    for pixel, channel in ((labels.bregma_px[0], 0), (labels.lambda_px[0], 2)):
        strong = image[..., channel] - image[..., 2 - channel] > 45
        x0, y0 = np.round(pixel).astype(int) - 20
        rows, columns = np.nonzero(strong[y0 : y0 + 41, x0 : x0 + 41])
        assert [columns.mean() + x0, rows.mean() + y0] == pytest.approx(list(pixel), abs=1.0)
