"""Takes out of a text who works here: names of user and computer, home folders, passwords in URLs."""

import getpass
import html
import json
import os
import pwd
import re
import socket
from pathlib import Path
from urllib.parse import quote

_NOBODY = {"root", "mill", "localhost"}
"""Names that tell of nobody."""
_HOMES = re.compile(r"/(?:home|Users)/[^/\s\"'<>,;:]+")
_IN_URLS = re.compile(r"(?<=://)[^/@\s\"']+@")


def anonymous(text: str) -> str:
    """The text with ``~`` for home folders, USER and HOST for their names; URLs without user and password."""
    text = _IN_URLS.sub("", text)
    for home in sorted({str(Path.home()), pwd.getpwuid(os.getuid()).pw_dir} - {"/"}, key=len, reverse=True):
        for form in _forms(home):
            text = re.sub(re.escape(form) + r"(?![\w-])", "~", text)
    text = _HOMES.sub("~", text)
    for names, word in ((_hosts(), "HOST"), (_users(), "USER")):
        # The longest first: a full name holds the short one.
        for name in sorted(names - _NOBODY, key=len, reverse=True):
            for form in _forms(name):
                text = re.sub(rf"(?<![^\W_]){re.escape(form)}(?![^\W_])", word, text, flags=re.IGNORECASE)
    return text


def _users() -> set[str]:
    entry = pwd.getpwuid(os.getuid())
    # Who became root by sudo is named there.
    names = {getpass.getuser(), entry.pw_name, entry.pw_gecos.partition(",")[0], os.environ.get("SUDO_USER", "")}
    return {name for name in names if name}


def _hosts() -> set[str]:
    name = socket.gethostname()
    return {each for each in (name, name.partition(".")[0], os.uname().nodename) if each}


def _forms(name: str) -> set[str]:
    """The name as text, in JSON, in JSON within JSON, in HTML and in a URL."""
    escaped = json.dumps(name)[1:-1]
    return {name, escaped, json.dumps(escaped)[1:-1], html.escape(name), quote(name)}
