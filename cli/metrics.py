"""`mill metrics`: what Prometheus scrapes: the newest run, from its growing record.

The run does not know of it: its record is read when somebody asks, by a process of its own.
"""

import importlib.util
from pathlib import Path
from typing import TYPE_CHECKING

import click

from cli.runs import folder_option
from drivers.errors import ConfigError

if TYPE_CHECKING:
    from wsgiref.types import StartResponse, WSGIEnvironment

    from cli.run_metrics import RunMetrics

PORT = 9_464
PATIENCE_S = 5.0
"""With a connection that says nothing."""


@click.command()
@click.option(
    "--port", type=click.IntRange(1, 65_535), default=PORT, show_default=True, metavar="PORT", help="On the loopback."
)
@folder_option
def metrics(port: int, folder: Path) -> None:
    """Serve figures of the newest run to Prometheus, on this computer only; Ctrl-C ends it.

    May stay up for ever, and is asked at http://127.0.0.1:PORT/metrics. It reads the records in the folder of runs: the
    run itself does not know of it.
    """
    if importlib.util.find_spec("prometheus_client") is None:
        raise ConfigError("metrics need prometheus_client, not installed: pip install 'micromill[metrics]'")
    from wsgiref.simple_server import WSGIRequestHandler, make_server

    from cli.run_metrics import RunMetrics

    class Quiet(WSGIRequestHandler):
        timeout = PATIENCE_S

        def log_message(self, *_: object) -> None:
            """Say nothing."""

    figures = RunMetrics(folder)
    try:
        server = make_server("127.0.0.1", port, Answers(figures, port), handler_class=Quiet)
    except OSError as error:
        raise ConfigError(f"port {port}: {error.strerror}; end what has it, or name another --port") from error
    with server, figures:
        click.echo(f"http://127.0.0.1:{port}/metrics\nCtrl-C ends it.")
        server.serve_forever()


class Answers:
    """A WSGI application: the figures, to who asks this computer by its own name, and nothing else."""

    def __init__(self, figures: "RunMetrics", port: int) -> None:
        self._figures = figures
        self._hosts = {f"127.0.0.1:{port}", f"localhost:{port}"}

    def __call__(self, asked: "WSGIEnvironment", respond: "StartResponse") -> list[bytes]:
        """One request."""
        from prometheus_client import CONTENT_TYPE_PLAIN_0_0_4

        if asked.get("HTTP_HOST") not in self._hosts:
            # A page of another site may let its name point here (DNS rebinding).
            status, body = "421 Misdirected Request", b"this answers under 127.0.0.1 and localhost alone\n"
        elif asked["REQUEST_METHOD"] != "GET":
            status, body = "405 Method Not Allowed", b"this is only looked at\n"
        elif asked["PATH_INFO"] != "/metrics":
            status, body = "404 Not Found", b"ask for /metrics\n"
        else:
            status, body = "200 OK", self._figures.text()
        kind = CONTENT_TYPE_PLAIN_0_0_4 if status.startswith("200") else "text/plain; charset=utf-8"
        respond(status, [("content-type", kind), ("x-content-type-options", "nosniff"), ("cache-control", "no-store")])
        return [body]
