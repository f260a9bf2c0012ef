"""The first second of a program, in which torch is imported: Ctrl-C ends it there as it ends any command.

Python's own handler would print where in torch it was. Programs install theirs as soon as they work (`processes`).
"""

from __future__ import annotations

import os
import signal
import sys


def is_program() -> bool:
    """Whether this process is a program of the package, and not another one that imports it."""
    name = sys.argv[0] if sys.argv else ""
    module = name == "-m" and any(word.startswith(("apcc_torch.", "-mapcc_torch.")) for word in sys.orig_argv)
    return module or os.path.basename(name).startswith("apcc-")


if is_program() and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, signal.SIG_DFL)
