"""`clear-strategies view RUN`: view a saved run or a PLY file in the browser."""

from __future__ import annotations

import argparse
import logging
import socket
import time
import webbrowser
from collections.abc import Sequence
from contextlib import suppress

from clear_strategies import console
from clear_strategies.commands import parser_of
from clear_strategies.errors import SettingError
from clear_strategies.jobs import exit_codes

_log = logging.getLogger(__name__)


def main(arguments: Sequence[str]) -> None:
    """Open the viewer and serve it until Ctrl-C."""
    parser = parser_of("view", "Look at a saved run, or a PLY file, in the browser. The run's own rasterizer draws.")
    parser.add_argument("--port", type=_port, default=8080, help="%(default)s, or the next one that is free")
    hosts = "%(default)s: this machine only; 0.0.0.0: every machine that reaches this one"
    parser.add_argument("--host", default="127.0.0.1", help=hosts)
    parser.add_argument("--no-browser", action="store_true", help="do not open a browser")
    options = parser.parse_args(arguments)
    console.show(verbose=options.verbose)
    _require_own(options.host)
    from clear_strategies.jobs.saved import open_splat

    exit_codes.require("view")
    splat = open_splat(options.run, options.rasterizer)
    _log.info("%s", splat.source)
    from clear_strategies.viewing.server import SplatViewer

    viewer = SplatViewer(
        splat.painter, {saved.name: saved.camera for saved in splat.cameras}, title=splat.name, photo=splat.photo,
        port=options.port, host=options.host, out=splat.folder / "rendered",
    )  # fmt: skip
    _log.info("%s (Ctrl-C ends it)", viewer.address)
    if not options.no_browser:
        webbrowser.open(viewer.address)
    with suppress(KeyboardInterrupt):
        while True:
            time.sleep(3600)  # on Windows, Ctrl-C interrupts no other wait
    viewer.close()


def _port(text: str) -> int:
    if not (text.isdecimal() and int(text) <= 65535):
        raise argparse.ArgumentTypeError(f"must be a whole number from 0 to 65535, got {text}")
    return int(text)


def _require_own(host: str) -> None:
    """Raise a SettingError for an address of another machine, for which the viewer's server would wait forever."""
    try:
        socket.create_server((host, 0), family=socket.AF_INET6 if ":" in host else socket.AF_INET).close()
    except OSError as error:
        remedy = "Take 127.0.0.1, for this machine alone, or 0.0.0.0, for all that reach it"
        rule = f"must be an address of this machine, got {host} ({error.strerror})"
        raise SettingError(f"--host: {rule}. {remedy}.") from error
