"""How a call is timed: many times, in one process, after a warm-up; medians, tails and spread."""

from __future__ import annotations

import gc
import statistics
import time
from collections.abc import Callable, Sequence

import torch


def finished(device: str) -> None:
    """Waits for what a device was given to do: on a GPU a call only queues its work."""
    if device.startswith("cuda"):
        torch.cuda.synchronize(device)


def timed(
    call: Callable[[], object],
    budget: float,
    least: int = 5,
    device: str = "cpu",
    pause: float = 0.0,
    before: Callable[[], object] | None = None,
) -> dict[str, float]:
    """Times a call again and again.

    Args:
        call: What is timed.
        budget: About how long in all, s.
        least: Fewest samples.
        device: On which it works.
        pause: Before each call, s.
        before: What is done before each call, and not timed.
    """
    call()
    finished(device)
    samples: list[float] = []
    end, worked = time.perf_counter() + budget, time.process_time()
    while len(samples) < least or time.perf_counter() < end:
        if pause:
            time.sleep(pause)
        if before is not None:
            before()
        started = time.perf_counter()
        call()
        finished(device)
        samples.append(time.perf_counter() - started)
    # Of all threads: what the call costs, however busy the machine is otherwise.
    return summary(samples) | {"cpu_us": 1e6 * (time.process_time() - worked) / len(samples)}


FLUSHED = 64 << 20
"""Bytes that are written to put everything else out of the caches."""


def flush_caches() -> None:
    """Puts code and data of what was called before out of the processor's caches."""
    torch.zeros(FLUSHED, dtype=torch.uint8).add_(1)


def wait(microseconds: float) -> None:
    """Reads the clock for so long: what the tail of such a loop is on this machine, which interrupts it."""
    end = time.perf_counter() + 1e-6 * microseconds
    while time.perf_counter() < end:
        pass


def timed_steps(
    step: Callable[..., object], inputs: Sequence[tuple[object, ...]], steps: int, device: str = "cpu"
) -> dict[str, float]:
    """Times so many steps, the inputs in turn, as a loop in real time would: the garbage collector waits outside."""
    for given in inputs[:20]:
        step(*given)
    finished(device)
    samples: list[float] = []
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        for k in range(steps):
            given = inputs[k % len(inputs)]
            started = time.perf_counter()
            step(*given)
            finished(device)
            samples.append(time.perf_counter() - started)
    finally:
        gc.enable()
        gc.unfreeze()
    return summary(samples)


def summary(samples: list[float]) -> dict[str, float]:
    """Statistics of times in s, as microseconds."""
    ordered = sorted(1e6 * sample for sample in samples)
    last = len(ordered) - 1
    return {
        "median_us": statistics.median(ordered),
        "min_us": ordered[0],
        "p10_us": ordered[round(0.1 * last)],
        "p90_us": ordered[round(0.9 * last)],
        "p999_us": ordered[round(0.999 * last)],
        "calls": float(len(ordered)),
    }
