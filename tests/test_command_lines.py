"""What a command does not take it refuses in one sentence that says what may be meant, with exit code 2."""

from __future__ import annotations

import os
import pickle
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from apcc_torch import benchmark, evaluate, export, identify, robot, robot_log, simulate
from apcc_torch.report import __main__ as report


@pytest.mark.parametrize(
    ("main", "words", "said"),
    [
        (simulate.main, "experiment=kinematics", "experiment has no choice 'kinematics'; did you mean kinematic?"),
        (simulate.main, "experiment=kinematic adaptation=sectons", "'sectons'; did you mean plant=sections?"),
        (simulate.main, "experiment=kinematic arm=naminal", "arm has no choice 'naminal'; it has arm_1, arm_2, "),
        (simulate.main, "experiment=kinematic feedback.mod=pose", "feedback.mod is no setting; did you mean mode?"),
        (simulate.main, "experiment=kinematic controller.K=[1,", "'controller.K=[1,' cannot be read: "),
        (simulate.main, "experiment=null", "Config group override must be a string or a list"),
        (simulate.main, "experiment=kinematic --multirum", "there is no argument --multirum; did you mean --multirun?"),
        (simulate.main, "experiment=kinematic --config-name nope", "Cannot find primary config 'nope'"),
        (robot.main, "--config-dir {}/nope experiment=setpoint", "nope"),
        (benchmark.main, "--cfg x", "there is no x; it has job, hydra, all"),
        (simulate.main, "-cd {} experiment=kinematics", "did you mean kinematic?"),
        (simulate.main, "experiment=kinematics -cd {} seed=1", "did you mean kinematic?"),
        (robot.main, "experiment=setpont", "experiment has no choice 'setpont'; did you mean setpoint?"),
        (
            robot.main,
            "experiment=setpoint state=exact",
            "state is no setting here, but one of python -m",
        ),
        (identify.main, "arm=ftdcr data=trunk", "arm has no choice 'ftdcr'; did you mean ftdcr_v6?"),
        (identify.main, "data=trnk", "data has no choice 'trnk'; did you mean trunk?"),
        (evaluate.main, "data=trunk_paylod", "data has no choice 'trunk_paylod'; did you mean trunk_payload?"),
        (evaluate.main, "data=trunk data.tran=x", "data.tran is no setting; did you mean train?"),
        (export.main, "presicion=single", "presicion is no setting; did you mean precision?"),
        (benchmark.main, "grid=smal", "grid has no choice 'smal'; did you mean small?"),
        (robot_log.main, "inf x", "there is no inf; did you mean info?"),
        (robot_log.main, "replay x --alow-class y", "there is no argument --alow-class; did you mean --allow-class?"),
        (report.main, "x --metrik y", "there is no argument --metrik; did you mean --metric?"),
    ],
)
def test_what_is_mistyped_is_refused_in_a_sentence(
    main: Callable[[], Any],
    words: str,
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["command", *words.format(tmp_path).split()])
    with pytest.raises(SystemExit) as ended:
        main()
    told = capsys.readouterr().err
    assert ended.value.code == 2 and said in told and len(told.splitlines()) == 1, told
    assert not list(tmp_path.iterdir()) and "HYDRA_FULL_ERROR" not in os.environ


@pytest.mark.parametrize("program", [simulate, benchmark, evaluate, export, identify, robot])
@pytest.mark.parametrize("option", ["--experimental-rerun {}", "--experimental-rerun={}", "--exp={}"])
def test_no_program_unpickles_a_file(
    program: ModuleType,
    option: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Hydra would rerun a job from a pickle, which runs what its author wrote into it."""
    file, mark = tmp_path / "config.pickle", tmp_path / "ran"
    file.write_bytes(pickle.dumps(Touching(mark)))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["command", *option.format(file).split()])
    with pytest.raises(SystemExit) as ended:
        program.main()
    told = capsys.readouterr().err
    assert ended.value.code == 2 and "--experimental-rerun is refused" in told and told.count("\n") == 1, told
    assert not mark.exists() and list(tmp_path.iterdir()) == [file]


class Touching:
    """Leaves a file where it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.path,)


@pytest.mark.parametrize(
    ("module", "work", "words"), [(report, "report", ["x"]), (robot_log, "read_log", ["info", "x"])]
)
def test_what_only_reads_is_stopped_in_a_word(
    module: ModuleType, work: str, words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(module, work, lambda *_: signal.raise_signal(signal.SIGINT))
    with pytest.raises(SystemExit) as ended:
        module.main(words)
    assert ended.value.code == 130 and capsys.readouterr() == ("", "stopped by Ctrl-C\n")
