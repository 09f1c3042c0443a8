"""Foxglove: its standard schemas, into an MCAP file or over its WebSocket to a viewer that is open now."""

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any

import foxglove
import numpy as np
from foxglove import channels, messages
from foxglove.websocket import ChannelView, Client, ServerListener

from cli.viewers.viewer import FIGURES, FRAME, Color, Eye, Floats, Level, Marks

LEVELS = {
    "info": messages.LogLevel.Info,
    "warning": messages.LogLevel.Warning,
    "error": messages.LogLevel.Error,
}
LINE_MM, DOT_MM = 0.03, 0.12
RING_PX, BALL_PX, TEXT_PX = 5.0, 1.5, 14.0
ONE_PIXEL_UP = 6.0
_FLOAT32 = messages.PackedElementFieldNumericType.Float32


class FoxgloveViewer:
    """Logs to whatever listens on a context; see ``Viewer``."""

    def __init__(self, context: foxglove.Context, header: dict[str, Any]) -> None:
        """Topics of a run that began at ``header["date"]``, or in 1970 where the record does not tell."""
        self._began_ns = round(_began(header).timestamp()) * 1_000_000_000
        self._eyes = {
            eye: channels.CompressedImageChannel(f"/eyes/{eye}", context=context) for eye in ("left", "right")
        }
        self._marks = {
            eye: channels.ImageAnnotationsChannel(f"/eyes/{eye}/marks", context=context) for eye in ("left", "right")
        }
        self._tip = channels.PoseInFrameChannel("/drill/tip", context=context)
        self._surface = channels.PointCloudChannel("/skull/surface", context=context)
        self._ring = channels.SceneUpdateChannel("/window", context=context)
        self._log = channels.LogChannel("/log", context=context)
        self._figures = {
            topic: foxglove.Channel(f"/{topic}", schema=_json_schema(topic), context=context) for topic in FIGURES
        }
        self._last: dict[tuple[int, str], tuple[Any, Any, int]] = {}

    def picture(self, t_s: float, eye: Eye, jpeg: bytes) -> None:
        """As the record keeps it; nothing is coded anew."""
        stamp = self._stamp(t_s)
        image = messages.CompressedImage(timestamp=stamp, frame_id=f"eye_{eye}", data=jpeg, format="jpeg")
        self._tell(self._eyes[eye], image, t_s)

    def marks(self, t_s: float, eye: Eye, marks: Marks) -> None:
        """Dots on the ring, names at the landmarks, a circle round the ball."""
        stamp = self._stamp(t_s)
        points = [messages.Point2(x=place[0], y=place[1]) for place in marks.ring_px]
        ring = messages.PointsAnnotation(
            timestamp=stamp,
            type=messages.PointsAnnotationType.Points,
            points=points,
            outline_colors=[_color(color) for color in marks.colors],
            thickness=RING_PX,
        )
        names = [
            messages.TextAnnotation(
                timestamp=stamp,
                position=messages.Point2(x=place[0], y=place[1] - ONE_PIXEL_UP),
                text=name,
                font_size=TEXT_PX,
                text_color=_color((255, 255, 255)),
                background_color=messages.Color(r=0.0, g=0.0, b=0.0, a=0.6),
            )
            for name, place in marks.landmarks_px.items()
        ]
        balls = []
        if marks.ball_px is not None:
            (x, y), radius = marks.ball_px
            balls = [
                messages.CircleAnnotation(
                    timestamp=stamp,
                    position=messages.Point2(x=x, y=y),
                    diameter=2 * radius,
                    thickness=BALL_PX,
                    outline_color=_color((119, 221, 255)),
                )
            ]
        drawn = messages.ImageAnnotations(timestamp=stamp, circles=balls, points=[ring] if points else [], texts=names)
        self._tell(self._marks[eye], drawn, t_s)

    def tip(self, t_s: float, tip_mm: Floats, axis: Floats) -> None:
        """The pose's x axis points up the shank."""
        x, y, z, w = _turn_x_onto(axis)
        pose = messages.Pose(position=_vector(tip_mm), orientation=messages.Quaternion(x=x, y=y, z=z, w=w))
        told = messages.PoseInFrame(timestamp=self._stamp(t_s), frame_id=FRAME, pose=pose)
        self._tell(self._tip, told, t_s)

    def surface(self, t_s: float, points_mm: Floats) -> None:
        """Points x, y, z as 32-bit floats."""
        fields = [
            messages.PackedElementField(name=name, offset=4 * index, type=_FLOAT32) for index, name in enumerate("xyz")
        ]
        cloud = messages.PointCloud(
            timestamp=self._stamp(t_s),
            frame_id=FRAME,
            pose=messages.Pose(position=_vector((0.0, 0.0, 0.0)), orientation=messages.Quaternion(w=1.0)),
            point_stride=12,
            fields=fields,
            data=points_mm.astype("<f4").tobytes(),
        )
        self._tell(self._surface, cloud, t_s)

    def ring(self, t_s: float, name: str, points_mm: Floats, colors: Sequence[Color]) -> None:
        """One entity of the scene for each ring; a later one of its name takes its place."""
        line = messages.LinePrimitive(
            type=messages.LinePrimitiveLineType.LineLoop,
            thickness=LINE_MM,
            points=[messages.Point3(x=x, y=y, z=z) for x, y, z in points_mm.tolist()],
            colors=[_color(color) for color in colors],
        )
        dots = [
            messages.SpherePrimitive(
                pose=messages.Pose(position=_vector(place), orientation=messages.Quaternion(w=1.0)),
                size=_vector((DOT_MM, DOT_MM, DOT_MM)),
                color=_color(color),
            )
            for place, color in zip(points_mm.tolist(), colors, strict=True)
        ]
        entity = messages.SceneEntity(
            timestamp=self._stamp(t_s), frame_id=FRAME, id=name, lines=[line], spheres=dots if name == "depth" else []
        )
        self._tell(self._ring, messages.SceneUpdate(entities=[entity]), t_s, name)

    def figures(self, t_s: float, topic: str, values: dict[str, Any]) -> None:
        """JSON by the schema of ``FIGURES``; ``t_s`` counts from the beginning of the record."""
        self._figures[topic].log({"t_s": t_s, **values}, log_time=self._ns(t_s))

    def words(self, t_s: float, level: Level, where: str, text: str) -> None:
        """A line of the log panel."""
        told = messages.Log(timestamp=self._stamp(t_s), level=LEVELS[level], name=where, message=text or where)
        self._log.log(told, log_time=self._ns(t_s))

    def tell_again(self, topic: str) -> None:
        """The newest of a topic once more, for somebody who came late; nothing for figures and words."""
        for channel, told, at_ns in list(self._last.values()):
            if channel.topic() == topic:
                channel.log(told, log_time=at_ns)

    def _tell(self, channel: Any, told: Any, t_s: float, name: str = "") -> None:
        at_ns = self._ns(t_s)
        self._last[channel.id(), name] = (channel, told, at_ns)
        channel.log(told, log_time=at_ns)

    def _ns(self, t_s: float) -> int:
        return self._began_ns + round(t_s * 1e9)

    def _stamp(self, t_s: float) -> messages.Timestamp:
        seconds, ns = divmod(self._ns(t_s), 1_000_000_000)
        return messages.Timestamp(sec=seconds, nsec=ns)


@contextmanager
def into_mcap(path: Path, header: dict[str, Any]) -> Iterator[FoxgloveViewer]:
    """A viewer that writes an MCAP file, chunk by chunk."""
    context = foxglove.Context()
    with foxglove.open_mcap(path, allow_overwrite=True, context=context) as file:
        file.write_metadata("run", {key: json.dumps(value) for key, value in header.items()})
        yield FoxgloveViewer(context, header)


@contextmanager
def served(header: dict[str, Any], port: int) -> Iterator[tuple[FoxgloveViewer, str]]:
    """A viewer that tells whoever connects on this computer, and the address for it. It listens to nobody.

    Raises:
        OSError: the port is taken.
    """
    context = foxglove.Context()
    viewer = FoxgloveViewer(context, header)
    server = foxglove.start_server(
        name=f"mill {header.get('rig', '')}".strip(),
        host="127.0.0.1",
        port=port,
        capabilities=[],
        server_listener=_Latecomers(viewer),
        context=context,
    )
    try:
        yield viewer, f"ws://127.0.0.1:{server.port}"
    finally:
        server.stop()


class _Latecomers(ServerListener):
    """Tells whoever subscribes how things stand; the rest of what a client may send is heard by nobody."""

    def __init__(self, viewer: FoxgloveViewer) -> None:
        self._viewer = viewer

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        self._viewer.tell_again(channel.topic)


def _began(header: dict[str, Any]) -> datetime:
    return datetime.fromisoformat(header.get("date", "1970-01-01T00:00:00+00:00"))


def _json_schema(topic: str) -> dict[str, Any]:
    fields: dict[str, dict[str, Any]] = {
        "t_s": {"type": "number", "description": "seconds from the beginning of the record"}
    }
    for name, (kind, meaning) in FIGURES[topic].items():
        fields[name] = {"type": kind, "description": meaning}
        if kind == "array":
            fields[name]["items"] = {"type": ["number", "null"]}
    return {"type": "object", "title": f"mill.{topic}", "properties": fields}


def _turn_x_onto(axis: Floats) -> tuple[float, float, float, float]:
    """Unit quaternion x, y, z, w of the shortest turn from (1, 0, 0) onto a unit vector."""
    w = 1.0 + float(axis[0])
    if w < 1e-9:
        return 0.0, 0.0, 1.0, 0.0
    turn = np.array([0.0, -axis[2], axis[1], w])
    x, y, z, w = (float(value) for value in turn / np.linalg.norm(turn))
    return x, y, z, w


def _vector(place: Any) -> messages.Vector3:
    return messages.Vector3(x=float(place[0]), y=float(place[1]), z=float(place[2]))


def _color(color: Color) -> messages.Color:
    red, green, blue = (channel / 255 for channel in color)
    return messages.Color(r=red, g=green, b=blue, a=1.0)
