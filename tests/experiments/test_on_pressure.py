"""Every experiment on an arm with chambers: what runs, and what has no meaning there and says so."""

from __future__ import annotations

from pathlib import Path

import pytest

from apcc_torch.errors import ConfigError
from apcc_torch.experiments import dynamic, kinematic, realtime_run
from apcc_torch.hardware.stops import StopReason
from composed import composed, composed_realtime

ON_AIR = ("arm=soft_trunk", "figures=false", "compile=off")
DYNAMIC = ("dynamic_run_1", "dynamic_run_2", "dynamic_run_2_tuned", "dynamic_single", "setpoint", "tracking")
OF_ARM_2 = ("robot_2", "robot_2_single", "robot_2_tuned")
IN_REAL_TIME = ("hardware=lockstep", "view=false", "loop.hold=0.1", "loop.warm_up=5", "hardware.world.step=0.01")


@pytest.mark.parametrize("name", [*DYNAMIC, *OF_ARM_2])
def test_every_dynamic_experiment_moves_it_by_pressure(name: str) -> None:
    config = composed(f"experiment={name}", *ON_AIR, "experiment.duration=0.03", "plant.settle=0.02")
    log = dynamic.simulate(config).log
    assert log.pressure.shape == (4, log.x.shape[1], 6) and (log.pressure[0] == 2e4).all(), "it starts at rest"
    assert 0.0 <= log.pressure.min() < 1.99e4 and log.pressure.max() <= 1.2e5, "the valves follow what is told"
    assert max(config.experiment.payloads) <= 0.02, "payloads are in proportion to the arm"


def test_other_true_arms_and_kinematics_run_too() -> None:
    rod = composed("experiment=dynamic_single", *ON_AIR, "plant=rod", "experiment.duration=0.02", "plant.settle=0.02")
    assert dynamic.simulate(rod).log.pressure.min() < 2e4
    alone = kinematic.simulate(composed("experiment=kinematic", *ON_AIR, "experiment.duration=0.05"))
    assert alone.log.x.isfinite().all()


def test_tracking_runs_in_real_time(tmp_path: Path) -> None:
    words = "experiment=tracking", "experiment.payloads=[0.0]", "experiment.duration=0.2", "plant.settle=0.2"
    outcome, _ = realtime_run.run(composed_realtime(*words, *ON_AIR, *IN_REAL_TIME), tmp_path)
    assert outcome.reason is StopReason.DURATION, outcome.message


def test_what_is_of_tendons_alone_is_refused() -> None:
    config = composed("experiment=dynamic_run_2_composite", *ON_AIR)
    with pytest.raises(ConfigError, match="needs tendons"):
        dynamic.simulate(config)
