"""Programs of the package in processes of their own that need not import it first.

A process that has imported the programs waits for commands, and forks for each: what `python -m` would do, but for the
two seconds that importing takes. `python tests/started.py` is that process: a line of JSON in for each command, a line
with the exit code out.
"""

from __future__ import annotations

import atexit
import gc
import json
import os
import runpy
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Mapping
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import IO, Any, NoReturn

from hydra.core.plugins import Plugins

PROGRAMS = ("apcc_torch.simulate", "apcc_torch.robot")
NOTHING = "/dev/null"


def ran(
    module: str, arguments: list[str], cwd: Path, env: Mapping[str, str], timeout: float = 300.0
) -> subprocess.CompletedProcess[str]:
    """`python -m module arguments`, started in the folder `cwd` with the environment `env`, and ended.

    A module that is the path of a file is run as `python path arguments`.

    Raises:
        subprocess.TimeoutExpired: It was killed, as it went on for longer than `timeout` s.
    """
    server = _server(env["PYTHONPATH"])
    assert server.stdin is not None and server.stdout is not None
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        files = [f"/proc/{os.getpid()}/fd/{file.fileno()}" for file in (out, err)]
        asked = {"module": module, "arguments": arguments, "cwd": str(cwd), "env": dict(env), "files": files}
        server.stdin.write(json.dumps(asked | {"timeout": timeout}) + "\n")
        server.stdin.flush()
        code = json.loads(server.stdout.readline())
        if code is None:
            raise subprocess.TimeoutExpired(module, timeout)
        told = [_text(file) for file in (out, err)]
    return subprocess.CompletedProcess([module, *arguments], code, *told)


@cache
def _server(path: str) -> subprocess.Popen[str]:
    """The process that waits; it ends when this one does and closes its input."""
    return subprocess.Popen(
        [sys.executable, __file__],
        env=os.environ | {"PYTHONPATH": path},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def _text(file: IO[bytes]) -> str:
    file.seek(0)
    return file.read().decode(errors="replace")


def serve() -> None:
    """Waits for commands until there will be none."""
    for name in PROGRAMS:
        import_module(name)
        del sys.modules[name]  # it is about to be run as __main__
    # What programs load at their first steps.
    Plugins.instance()
    for name in ("torch._dynamo", "torch.fx.experimental.symbolic_shapes"):
        import_module(name)
    gc.freeze()
    while line := sys.stdin.readline():
        asked = json.loads(line)
        child = os.fork()
        if child == 0:
            _run(asked)
        sys.stdout.write(json.dumps(_ended(child, asked["timeout"])) + "\n")
        sys.stdout.flush()


def _ended(child: int, timeout: float) -> int | None:
    """The exit code of a child, None where it had to be killed."""
    deadline = time.monotonic() + timeout
    while True:
        pid, status = os.waitpid(child, os.WNOHANG)
        if pid:
            return os.waitstatus_to_exitcode(status)
        if time.monotonic() > deadline:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return None
        time.sleep(0.01)


def _run(asked: Mapping[str, Any]) -> NoReturn:
    """The whole life of a child."""
    code = 1
    try:
        for name, number in ((NOTHING, 0), *zip(asked["files"], (1, 2), strict=True)):
            file = os.open(name, os.O_RDWR)
            os.dup2(file, number)
            os.close(file)
        os.environ.clear()
        os.environ.update(asked["env"])
        os.chdir(asked["cwd"])
        named = asked["module"]
        sys.argv = [named, *asked["arguments"]]
        if named.endswith(".py"):
            sys.path[0] = os.path.dirname(named)
            runpy.run_path(named, run_name="__main__")
        else:
            sys.path[0] = os.getcwd()
            runpy.run_module(named, run_name="__main__", alter_sys=True)
        code = 0
    except SystemExit as ended:
        code = ended.code if isinstance(ended.code, int) else int(ended.code is not None)
        if isinstance(ended.code, str):
            sys.stderr.write(f"{ended.code}\n")
    except BaseException:
        traceback.print_exc()
    # As an interpreter ends: threads, exit handlers, buffers.
    threading._shutdown()  # type: ignore[attr-defined]
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


if __name__ == "__main__":
    serve()
