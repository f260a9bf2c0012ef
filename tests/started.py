"""Programs of the package in processes of their own that need not import it first.

A process that has imported the programs waits for commands, and forks for each: what `python -m` would do, but for the
two seconds that importing takes. `python tests/started.py` is that process. A line of JSON in begins a program and is
answered by the number of its process; a line in with that number is answered by the exit code.
"""

from __future__ import annotations

import atexit
import gc
import json
import os
import resource
import runpy
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import IO, Any, NoReturn, Self

from hydra.core.plugins import Plugins

PROGRAMS = ("apcc_torch.simulate", "apcc_torch.robot")
NOTHING = "/dev/null"


class Program:
    """A program of the package that runs, as `subprocess.Popen` has one; killed where the block that uses it fails.

    Args:
        module: As `python -m` takes it; the path of a file is run as `python path`.
        arguments: Its command line.
        cwd: The folder that it starts in.
        env: Its environment.
        session: It leads a session of its own.
        largest: Bytes of the largest file that it may write; None: no limit.
    """

    def __init__(
        self,
        module: str,
        arguments: Sequence[str],
        cwd: Path,
        env: Mapping[str, str],
        *,
        session: bool = False,
        largest: int | None = None,
    ) -> None:
        self.args = [module, *arguments]
        self.returncode: int | None = None
        self._path = env["PYTHONPATH"]
        with ExitStack() as files:
            self._told = [files.enter_context(tempfile.TemporaryFile()) for _ in ("out", "err")]
            paths = [f"/proc/{os.getpid()}/fd/{file.fileno()}" for file in self._told]
            asked = {"module": module, "arguments": list(arguments), "cwd": str(cwd), "env": dict(env), "files": paths}
            self.pid: int = _answer(self._path, asked | {"session": session, "largest": largest})
            self._open = files.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *unused: object) -> None:
        if kind is not None:
            self.kill()
        self.wait()
        self._open.close()

    def poll(self) -> int | None:
        """Its exit code; None while it runs."""
        with suppress(subprocess.TimeoutExpired):
            self.wait(0.0)
        return self.returncode

    def wait(self, timeout: float = 300.0) -> int:
        """Its exit code, once it has ended.

        Raises:
            subprocess.TimeoutExpired: It goes on for longer than `timeout` s.
        """
        if self.returncode is None:
            self.returncode = _answer(self._path, {"pid": self.pid, "timeout": timeout})
        if self.returncode is None:
            raise subprocess.TimeoutExpired(self.args, timeout)
        return self.returncode

    def communicate(self, timeout: float = 300.0) -> tuple[str, str]:
        """What it has written to its output and to its error output, once it has ended; raises as `wait`."""
        self.wait(timeout)
        out, err = map(_text, self._told)
        return out, err

    def send_signal(self, number: int) -> None:
        """Sends it a signal."""
        if self.returncode is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        """Ends it at once."""
        self.send_signal(signal.SIGKILL)


def ran(
    module: str,
    arguments: Sequence[str],
    cwd: Path,
    env: Mapping[str, str],
    timeout: float = 300.0,
    largest: int | None = None,
) -> subprocess.CompletedProcess[str]:
    """A program that has ended; its arguments are those of `Program`.

    Raises:
        subprocess.TimeoutExpired: It was killed, as it went on for longer than `timeout` s.
    """
    with Program(module, arguments, cwd, env, largest=largest) as program:
        told = program.communicate(timeout)
        return subprocess.CompletedProcess(program.args, program.wait(), *told)


def _answer(path: str, asked: Mapping[str, Any]) -> Any:
    """What the process that waits says to a line."""
    server = _server(path)
    assert server.stdin is not None and server.stdout is not None
    server.stdin.write(json.dumps(asked) + "\n")
    server.stdin.flush()
    return json.loads(server.stdout.readline())


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
        if "pid" in asked:
            answer = _ended(**asked)
        elif not (answer := os.fork()):
            _run(asked)
        sys.stdout.write(json.dumps(answer) + "\n")
        sys.stdout.flush()


def _ended(pid: int, timeout: float) -> int | None:
    """The exit code of a child, None where it still runs."""
    deadline = time.monotonic() + timeout
    while True:
        found, status = os.waitpid(pid, os.WNOHANG)
        if found:
            return os.waitstatus_to_exitcode(status)
        if time.monotonic() >= deadline:
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
        if asked["session"]:
            os.setsid()
        if asked["largest"] is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (asked["largest"], asked["largest"]))
        os.environ.clear()
        os.environ.update(asked["env"])
        os.chdir(asked["cwd"])
        named = asked["module"]
        sys.argv = [named, *asked["arguments"]]
        start = [named] if named.endswith(".py") else ["-m", named]
        sys.orig_argv = [sys.executable, *start, *asked["arguments"]]
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
