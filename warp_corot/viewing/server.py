"""viser's server, behind the gate and without its tunnel."""

from __future__ import annotations

import contextlib
import io
from typing import TYPE_CHECKING, Any

from warp_corot.errors import InputError

from .gate import Gate, check_port, guarded, is_closed

if TYPE_CHECKING:
    from viser import ViserServer


def library() -> Any:
    """The package viser.

    Raises:
        InputError: It is not installed.
    """
    try:
        import viser
    except ImportError as error:
        raise InputError(f'the page needs viser ({error}): pip install "warp-corot[view]"') from None
    return viser


def open_server(gate: Gate, port: int, title: str) -> ViserServer:
    """Start the server.

    Args:
        gate: Decides who may enter.
        port: The port, 0 for any free one.
        title: The title of the page.

    Raises:
        InputError: viser is not installed, the port is taken, or this version of viser would not ask the gate.
    """
    viser = library()
    check_port(gate.host, port)
    with guarded(gate), contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host=gate.host, port=port, label=title, verbose=False)
    bound = server.get_port()
    try:
        if port not in (0, bound):
            raise InputError(f"port is {port}, which is taken; it must be free, or 0 for any")
        if not is_closed(gate, bound):
            raise InputError(f"viser {viser.__version__} does not ask who may enter; the page needs another version")
        _without_tunnel(server)
    except BaseException:
        stop(server)
        raise
    return server


def stop(server: ViserServer) -> None:
    """Stop the server, quietly."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def _without_tunnel(server: ViserServer) -> None:
    """Prevent visitors from publishing the page through a tunnel."""
    from viser import _messages

    server._connection.unregister_handler(_messages.ShareUrlRequest)
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    server.gui.main_panel.dock_right()
