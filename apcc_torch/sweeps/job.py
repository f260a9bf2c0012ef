"""One job of a sweep: run it in a process of its own, put its folder into place, say what became of it."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

from omegaconf import DictConfig

from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.composition.stacking import Point
from apcc_torch.errors import ApccError
from apcc_torch.experiments.folder import metrics_text, progress_told
from apcc_torch.experiments.run import objective_in, run, settings_of
from apcc_torch.plain_text import plain_logger
from apcc_torch.processes import end_with
from apcc_torch.sweeps import batch_run as batch
from apcc_torch.sweeps.own_process import run_isolated
from apcc_torch.sweeps.sweep_folder import PROGRESS, SweepFolder, job_name

log = plain_logger("apcc_torch.simulate")

HEAD = "APCC_SWEEP_HEAD"
"""Environment variable with the process that a launcher's workers end with."""


def run_job(
    cfg: DictConfig,
    draft: Path,
    overrides: Sequence[str],
    log_name: str,
    points: Callable[[], Sequence[Point]] | None = None,
) -> float | None:
    """Runs a job, unless the sweep is resumed and has it already.

    It does not raise: whatever happens to one job, the sweep's others go on.

    Args:
        cfg: Its composed configuration.
        draft: Where it writes, a hidden folder in the sweep's folder.
        overrides: What distinguishes it, as the user gave it.
        log_name: Name of its log file.
        points: Makes the points of a batch; None for a single run.

    Returns:
        Its objective, for a search to lower: infinite where the run diverged, was pruned or failed. None if it
        ended well and no objective is named.
    """
    logging.raiseExceptions = False  # a full disk is told once, not by every line that the log lacks
    _end_with_head()
    sweep = SweepFolder(draft.parent)
    try:
        config = settings_of(cfg, draft)
        done = sweep.find(config, job_name(draft)) if config.resume else None
        if done is not None:
            value = objective_in(done, config.objective)
            sweep.rename_job(done, overrides)
            sweep.discard(draft)
            return value
        chosen = None if points is None else points()
        why = run_isolated(_work, (config, draft, chosen), draft / log_name)
        (draft / PROGRESS).unlink(missing_ok=True)
        if why is None:
            value = objective_in(draft, config.objective)
            sweep.publish(draft, config, overrides)
            return value
    except (ApccError, OSError) as error:
        why = str(error)
    except Exception as error:
        log.exception("the job could not be run")
        why = f"{type(error).__name__}: {error}"
    # Named at once and in the job's own log; the sweep's end names it again.
    log.error("%s", why)
    try:
        sweep.fail(draft, overrides, why)
    except OSError as error:
        log.error("%s", error)
    return math.inf


@cache
def _end_with_head() -> None:
    head = int(os.environ.get(HEAD, os.getpid()))
    if head != os.getpid():
        end_with(head)


def _work(config: SimulateSettings, draft: Path, points: Sequence[Point] | None) -> None:
    with progress_told(draft / PROGRESS):
        metrics = run(config, draft) if points is None else batch.run(config, points, draft)
    log.info("done\n%s", metrics_text(metrics))
