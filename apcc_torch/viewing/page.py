"""A page in the browser, with viser: a scene and a panel of controls."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from apcc_torch.errors import ConfigError
from apcc_torch.plain_text import plain_logger
from apcc_torch.web_address import EVERYWHERE, WebAddress

log = plain_logger(__name__)

FIELD_OF_VIEW = math.radians(40.0)
BRAND = (0, 114, 178)
EXTRA = "a view in the browser needs viser: pip install 'apcc-torch[view]'"


class Page:
    """A page that is served until it is closed; good for `with`.

    Everybody who opens it sees the same, and may use its controls. It is not shared beyond its address, whoever asks.

    Args:
        address: Where.
        title: Above its controls.
        length: Of the arm, m; the camera stands so that its reach is in sight.
        upward: Whether the arm stands; else it hangs.

    Attributes:
        server: viser's.
        address: With the port that was chosen.

    Raises:
        ConfigError: viser is not installed, the port is taken, or the host is none of this machine.
    """

    def __init__(self, address: WebAddress, title: str, length: float, upward: bool = False) -> None:
        try:
            import rich
            import viser
        except ModuleNotFoundError as error:
            raise ConfigError(EXTRA) from error
        self.console = rich.get_console()
        self.address = address.free()
        with self._silent():
            self.server: Any = viser.ViserServer(host=self.address.host, port=self.address.port, verbose=False)
        if self.server.get_port() != self.address.port:  # somebody took it since
            self.close()
            raise ConfigError(f"page.port={self.address.port} is taken: choose another one, or 0 for any that is free")
        # A page of viser's can be sent through a server of others by anyone who opens it.
        setattr(self.server, "request_share_url", _not_shared)  # noqa: B010
        gui, scene = self.server.gui, self.server.scene
        gui.set_panel_label(title)
        gui.configure_theme(control_width="medium", show_logo=False, show_share_button=False, brand_color=BRAND)
        gui.main_panel.dock_right()
        scene.set_up_direction("+z")
        middle = 0.5 * length if upward else -0.5 * length
        camera = self.server.initial_camera
        camera.position = (0.98 * length, -1.47 * length, middle + 0.25 * length)
        camera.look_at = (0.0, 0.0, middle)
        camera.fov, camera.near, camera.far = FIELD_OF_VIEW, 0.01 * length, 60.0 * length
        if self.address.host in EVERYWHERE:
            log.warning("everyone who reaches this machine can open the page and use its controls")

    @contextmanager
    def _silent(self) -> Iterator[None]:
        """viser prints where it serves; programs say so themselves."""
        before, self.console.quiet = self.console.quiet, True
        try:
            yield
        finally:
            self.console.quiet = before

    def close(self) -> None:
        """Ends the server and its threads."""
        with self._silent():
            self.server.stop()

    def __enter__(self) -> Page:
        return self

    def __exit__(self, *unused: object) -> None:
        self.close()


def _not_shared(*unused: Any, **unused_too: Any) -> None:
    log.warning("the page is not shared: it stays at its address")
