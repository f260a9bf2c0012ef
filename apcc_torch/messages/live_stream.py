"""A run on an arm, live, for Foxglove: a server of its websocket protocol, in a process of its own.

The server keeps some messages for every client and drops the oldest where one does not read on: neither it nor the run
waits for a client.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from apcc_torch.errors import ConfigError, in_a_line
from apcc_torch.messages.foxglove_library import EXTRA, foxglove
from apcc_torch.messages.foxglove_stream import FoxgloveStream, Streamed
from apcc_torch.messages.run_layout import Numbers
from apcc_torch.messages.topic import ServerSink
from apcc_torch.plain_text import plain_logger
from apcc_torch.viewing.live_process import Showing, Watched
from apcc_torch.viewing.moment import Moment
from apcc_torch.web_address import EVERYWHERE, WebAddress

log = plain_logger(__name__)

BACKLOG = 64
"""Messages that are kept for a client that does not read on."""


class LiveStream:
    """Streams samples of a run to whoever connects.

    Attributes:
        server: Of foxglove's.

    Raises:
        ConfigError: foxglove-sdk is not installed, or the port is taken.
    """

    def __init__(self, address: WebAddress, watched: Watched) -> None:
        library: Any = foxglove()
        self.watched = watched
        context = library.Context()
        try:
            self.server = library.start_server(
                name=watched.name,
                host=address.host,
                port=address.port,
                capabilities=[library.Capability.Time],
                context=context,
                message_backlog_size=BACKLOG,
            )
        except (OSError, RuntimeError) as error:
            raise ConfigError(f"{address.url} cannot be served: {in_a_line(error)}") from error
        sink = ServerSink(context)
        self.stream = FoxgloveStream(sink, Streamed.of(watched.size, watched.outline))
        for topic in self.stream.topics:
            sink.advertise(topic)
        self.told, self.last = b"", b""
        if address.host in EVERYWHERE:
            log.warning("everyone who reaches this machine can see the run")

    def show(self, sample: NDArray[np.void]) -> None:
        """Streams a sample, as far as it is another one than the last."""
        state, message = (sample[name].item().decode() for name in ("state", "message"))
        began = int(sample["began"])
        if (told := f"{state}: {message}".encode()) != self.told and state:
            self.told = told
            self.stream.remark("run", told.decode(), state == "fault", began + round(1e9 * float(sample["time"])))
        seen = sample[["stamp", "q_bar", "pi_hat", "T", "effort"]].tobytes()
        if seen == self.last or not sample["count"]:
            return
        self.last = seen
        stamp = began + round(1e9 * float(sample["stamp"]))
        q, pi_hat = torch.from_numpy(sample["q_bar"]), torch.from_numpy(sample["pi_hat"])
        outline = self.watched.outline
        sections, tendons = outline(q, pi_hat)
        tip = outline.poses(q, pi_hat, pi_hat.sum(-1, keepdim=True))[0]
        error, time = float(np.linalg.norm(sample["e"])), float(sample["stamp"])
        numbers = Numbers(time, error, sample["x_d"], tip[:3, 3], sample["q_bar"], sample["pi_hat"], sample["effort"])
        self.stream.measured(sample["T"], stamp)
        self.stream.instant(tip, numbers, stamp)
        self.stream.scene(Moment(sections, tendons, sample["effort"], sample["T"], target=sample["x_d"]), stamp)
        self.server.broadcast_time(stamp)


STREAM = Showing("foxglove", EXTRA, LiveStream)
"""To Foxglove."""
