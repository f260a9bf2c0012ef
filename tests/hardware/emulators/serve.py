"""An emulator's own process: orders come in as JSON lines, answers go out; it ends with its standard input."""

from __future__ import annotations

import json
import os
import select
import sys
from pathlib import Path

from hardware.emulators.line import Line


def serve(kind: type[Line]) -> None:
    motors, models = ({int(k): v for k, v in json.loads(text).items()} for text in sys.argv[2:4])
    line = kind(Path(sys.argv[1]), motors, models)
    orders = sys.stdin.fileno()
    pending = b""
    os.write(1, b"{}\n")
    try:
        while True:
            ready, _, _ = select.select([orders, *([line.master] if line.master >= 0 else [])], [], [])
            if line.master in ready:
                line.receive()
            if orders in ready:
                data = os.read(orders, 65536)
                if not data:
                    return
                *lines, pending = (pending + data).split(b"\n")
                for text in lines:
                    answer = json.dumps(line.command(json.loads(text))).encode() + b"\n"
                    while answer:
                        answer = answer[os.write(1, answer) :]
    finally:
        line.unplug()
