"""Rerun: a recording file, or a server that its viewer connects to."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any

import rerun
import rerun.blueprint as view

from cli.viewers.viewer import FIGURES, FRAME, Color, Eye, Floats, Level, Marks

TIMELINE = "run"
LEVELS = {"info": "INFO", "warning": "WARN", "error": "ERROR"}
LINE_MM, DOT_MM, SHANK_MM = 0.015, 0.06, 3.0
RING_PX, BALL_PX = 2.5, 1.5
BALL_COLOR: Color = (119, 221, 255)


class RerunViewer:
    """Logs into one recording; see ``Viewer``."""

    def __init__(self, recording: rerun.RecordingStream) -> None:
        """Of Rerun's own two time lines, when a row was logged and as which, neither tells of the run."""
        self._to = recording
        recording.set_log_time_enabled(False)
        recording.set_log_tick_enabled(False)

    def picture(self, t_s: float, eye: Eye, jpeg: bytes) -> None:
        """As the record keeps it; nothing is coded anew."""
        self._log(t_s, f"eyes/{eye}", rerun.EncodedImage(contents=jpeg, media_type="image/jpeg"))
        # Without it pictures pile up in memory faster than they are written.
        self._to.flush()

    def marks(self, t_s: float, eye: Eye, marks: Marks) -> None:
        """Dots on the ring, names at the landmarks, a circle where the ball is."""
        self._log(
            t_s,
            f"eyes/{eye}/ring",
            rerun.Points2D(marks.ring_px, colors=marks.colors, radii=rerun.Radius.ui_points(RING_PX)),
        )
        names = list(marks.landmarks_px)
        places = [marks.landmarks_px[name] for name in names]
        self._log(t_s, f"eyes/{eye}/landmarks", rerun.Points2D(places, labels=names, show_labels=True))
        centers, radii = ([], []) if marks.ball_px is None else ([marks.ball_px[0]], [marks.ball_px[1]])
        halves = [(radius, radius) for radius in radii]
        self._log(
            t_s,
            f"eyes/{eye}/ball",
            rerun.Boxes2D(centers=centers, half_sizes=halves, colors=[BALL_COLOR] * len(centers)),
        )

    def tip(self, t_s: float, tip_mm: Floats, axis: Floats) -> None:
        """The tip, and the shank from it."""
        self._log(t_s, f"{FRAME}/drill/tip", rerun.Points3D([tip_mm], radii=DOT_MM, colors=[BALL_COLOR]))
        shank = rerun.Arrows3D(origins=[tip_mm], vectors=[SHANK_MM * axis], colors=[BALL_COLOR])
        self._log(t_s, f"{FRAME}/drill/shank", shank)

    def surface(self, t_s: float, points_mm: Floats) -> None:
        """A cloud of points."""
        self._log(t_s, f"{FRAME}/surface", rerun.Points3D(points_mm, radii=DOT_MM, colors=[(200, 190, 170)]))

    def ring(self, t_s: float, name: str, points_mm: Floats, colors: Sequence[Color]) -> None:
        """A closed line, and a dot at each point."""
        closed = [*points_mm.tolist(), points_mm[0].tolist()]
        self._log(t_s, f"{FRAME}/{name}/line", rerun.LineStrips3D([closed], radii=LINE_MM, colors=[colors[0]]))
        self._log(t_s, f"{FRAME}/{name}/points", rerun.Points3D(points_mm, radii=DOT_MM, colors=colors))

    def figures(self, t_s: float, topic: str, values: dict[str, Any]) -> None:
        """Numbers become curves, an array as many as it is long; text stands in the log."""
        for name, (kind, _) in FIGURES[topic].items():
            value = values[name]
            if kind != "string" and value is not None:
                row = value if kind == "array" else [value]
                scalars = [float("nan") if each is None else float(each) for each in row]
                self._log(t_s, f"figures/{topic}/{name}", rerun.Scalars(scalars))

    def words(self, t_s: float, level: Level, where: str, text: str) -> None:
        """A line of the log."""
        self._log(t_s, "log", rerun.TextLog(f"{where}: {text}" if text else where, level=LEVELS[level]))

    def _log(self, t_s: float, entity: str, told: Any) -> None:
        self._to.set_time(TIMELINE, duration=t_s)
        self._to.log(entity, told)


@contextmanager
def into_rrd(path: Path, name: str, header: dict[str, Any]) -> Iterator[RerunViewer]:
    """A viewer that writes an .rrd file as it goes."""
    with _recording(name, header, rerun.FileSink(path)) as recording:
        yield RerunViewer(recording)


@contextmanager
def served(name: str, header: dict[str, Any], port: int) -> Iterator[tuple[RerunViewer, str]]:
    """A viewer that tells whoever connects on this computer, from the beginning, and the address for it."""
    with _recording(name, header, rerun.GrpcServerSink(bind_ip="127.0.0.1", port=port)) as recording:
        yield RerunViewer(recording), f"rerun+http://127.0.0.1:{port}/proxy"


@contextmanager
def _recording(name: str, header: dict[str, Any], sink: Any) -> Iterator[rerun.RecordingStream]:
    recording = rerun.RecordingStream("mill", recording_id=f"{name}-{header.get('date', '')}")
    recording.set_sinks(sink, default_blueprint=_layout())
    recording.send_recording_name(name)
    if "date" in header:
        recording.send_recording_start_time_nanos(round(datetime.fromisoformat(header["date"]).timestamp() * 1e9))
    try:
        yield recording
    finally:
        recording.flush()
        recording.disconnect()


def _layout() -> Any:
    """Eyes and space above, curves and words below."""
    return view.Blueprint(
        view.Vertical(
            view.Horizontal(
                view.Spatial2DView(origin="eyes/left", name="left eye"),
                view.Spatial2DView(origin="eyes/right", name="right eye"),
                view.Spatial3DView(origin=FRAME, name="surface and path, mm"),
            ),
            view.Horizontal(
                view.TimeSeriesView(origin="figures/depth", name="depth, mm"),
                view.TimeSeriesView(origin="figures/completion/completion", name="completion"),
                view.TimeSeriesView(origin="figures/spindle/torque_share", name="torque"),
                view.TextLogView(origin="log", name="what happened"),
            ),
            row_shares=[3, 2],
        ),
        view.TimePanel(timeline=TIMELINE),
        collapse_panels=True,
    )
