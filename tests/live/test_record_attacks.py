"""A record against those who want other files of it than its pictures."""

import signal
import socket
import subprocess
import sys
from pathlib import Path

import httpx
import pytest

from drivers.clock import SystemClock
from live.player import Player
from milling.record import RunRecorder, read_run


def recorded(folder: Path, file: str) -> Player:
    with RunRecorder(folder, {}, SystemClock()) as recorder:
        recorder.event("frame", name="left", file=file)
    return Player(read_run(folder))


@pytest.mark.parametrize(
    "file",
    [
        "frames/../header.json",
        "../secret.jpg",
        "/etc/passwd",
        "frames/../../00001-a.jpg",
        "frames/00001-a.jpg\n",
        "frames/%2e%2e",
    ],
)
def test_a_record_that_names_other_files_shows_none(tmp_path: Path, file: str) -> None:
    (tmp_path / "secret.jpg").write_text("secret")
    player = recorded(tmp_path / "run", file)
    for name in (file, file.removeprefix("frames/"), Path(file).name, "header.json", "../header.json", ""):
        assert player.picture(name) is None


def test_a_picture_that_is_a_link_out_of_the_record_is_not_shown(tmp_path: Path) -> None:
    (tmp_path / "secret.jpg").write_text("secret")
    player = recorded(tmp_path / "run", "frames/00001-left.jpg")
    assert player.picture("00001-left.jpg") is None
    link = tmp_path / "run" / "frames" / "00001-left.jpg"
    link.symlink_to(tmp_path / "secret.jpg")
    assert player.picture("00001-left.jpg") is None
    link.unlink()
    link.write_bytes(b"jpeg")
    assert player.picture("00001-left.jpg") == link.resolve()


@pytest.mark.parametrize(
    "path", ["/frames/..%2f..%2fsecret.jpg", "/frames/%2e%2e/header.json", "/frames/../header.json"]
)
def test_no_path_leads_out_of_a_record(tmp_path: Path, path: str) -> None:
    (tmp_path / "secret.jpg").write_text("secret")
    recorded(tmp_path / "run", "frames/00001-left.jpg")
    command = [sys.executable, "-m", "cli.main", "live", str(tmp_path / "run")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        try:
            assert process.stdout is not None
            address = httpx.URL(process.stdout.readline().split()[1])
            with httpx.Client(trust_env=False, timeout=20.0) as client:
                assert client.get(address).status_code == 200
                assert client.get(address.copy_with(path="/run.json", query=None)).status_code == 200
                host = address.netloc.decode()
                cookie = "; ".join(f"{name}={value}" for name, value in client.cookies.items())
            with socket.create_connection((address.host, address.port or 80)) as raw:
                raw.sendall(f"GET {path} HTTP/1.1\r\nHost: {host}\r\nCookie: {cookie}\r\n\r\n".encode())
                assert raw.recv(4096).split()[1] == b"404"
        finally:
            process.send_signal(signal.SIGINT)
