"""Plays the process that mills: feeds a page from a record, holds a supervisor, and tells what it hears.

    python feeder.py RUN_FOLDER PORT_FD [--withheld] [--pipe] [--until=SECONDS | --to-the-end]

It says the page's address, and later `asked` when it is asked to stop and `heard: WHY` when its supervisor has stopped
the motion. It leaves out that its record was stopped, unless it plays it to the end and leaves. With `--withheld` the
last points are asked about without a fresh frame; with `--pipe` PORT_FD takes the place of the supervisor's pipe.
"""

import signal
import sys
from pathlib import Path

import cv2

from calib.calibration_file import Calibration
from drivers.clock import SystemClock
from drivers.errors import DeviceError
from drivers.motion.interface import StopPath
from drivers.recorder import NullRecorder
from live.page import Page, Shown
from milling.guard import Guard
from milling.record import read_run

SCRIPT = ((b"!", 0.0), (b"\x18", 0.0))
SILENCE_S = 600.0


class Asked(Exception):  # noqa: N818  (a person's wish, not an error)
    """SIGINT."""


class RecordClock:
    """Stands where the record is."""

    t = 0.0

    def now_s(self) -> float:
        return self.t

    def sleep_s(self, duration_s: float) -> None:
        self.t += duration_s


def ask(*_: object) -> None:
    raise Asked


def main() -> None:
    folder, port, *wishes = sys.argv[1:]
    until_s = min((float(wish[8:]) for wish in wishes if wish.startswith("--until=")), default=float("inf"))
    whole = "--to-the-end" in wishes
    run = read_run(Path(folder))
    calibration = Calibration.load(run.folder / "calibration.toml", None)
    clock = SystemClock()
    # Whoever reads the pipe sees what is pressed; this goes on.
    signal.signal(signal.SIGINT, signal.SIG_IGN if "--pipe" in wishes else ask)
    # A pipe is no port; the supervisor that is not told to stop writes nothing.
    with Guard(StopPath(int(port), SCRIPT), clock, silence_s=SILENCE_S) as guard, Page() as page:
        print(page.address, flush=True)
        page.header(title="rehearsal", command="run", calibration=str(run.folder / "calibration.toml"))
        page.hand_over_stop(int(port) if "--pipe" in wishes else guard.stop_end)
        told = RecordClock()
        shown = Shown(NullRecorder(), page, told, calibration)
        try:
            for event in run.events:
                if (event["kind"] == "latched" and not whole) or event["t"] > until_s:
                    break
                told.t = event["t"]
                if event["kind"] == "frame":
                    image = cv2.imread(str(run.folder / event["file"]))
                    assert image is not None
                    shown.frame(event["name"], cv2.cvtColor(image, cv2.COLOR_BGR2RGB))
                else:
                    shown.event(event["kind"], **{key: event[key] for key in event if key not in {"t", "kind"}})
                clock.sleep_s(0.0003)
            if "--withheld" in wishes:
                for point in (3, 4, 9):
                    shown.event(
                        "asked", point=point, bite_mm=0.05, frame_age_s=0.4, depth_mm=0.1, reason="no fresh frame"
                    )
            while not whole:
                guard.beat()
                clock.sleep_s(0.01)
        except Asked:
            print("asked", flush=True)
            shown.event("latched", reaction="RETRACT", reason="stopped by a person")
        except DeviceError as error:
            print(f"heard: {error}", flush=True)
            shown.event("latched", reaction="RETRACT", reason=str(error))


if __name__ == "__main__":
    main()
