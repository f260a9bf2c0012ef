"""A key that nothing in a run reads is refused with why, and does change nothing."""

from __future__ import annotations

import pytest
import torch

from apcc_torch import compose
from apcc_torch.composition.identify import of_a_fit
from apcc_torch.composition.realtime import RealtimeSettings, of_a_realtime_run
from apcc_torch.composition.run_settings import ON_AN_ARM, RunSettings, SimulateSettings
from apcc_torch.composition.unread import check_given, of_a_simulation
from apcc_torch.errors import ConfigError
from apcc_torch.experiments import dynamic, kinematic
from apcc_torch.paper import arm_series
from apcc_torch.settings import names
from apcc_torch.simulation.progress import quiet
from composed import changed, composed, composed_identify, composed_realtime, raw_realtime

QUICK = ("experiment.duration=0.1", "controller.rate=50")
SHORT = (*QUICK, "experiment.setpoints=[[0.1,0.1,-0.5]]", "experiment.payloads=[0.1]", "plant.settle=0.1")


@pytest.mark.parametrize(
    ("experiment", "words", "why"),
    [
        (
            "kinematic",
            ("controller.velocity=commanded", "velocity_filter.window=25"),
            "controller.velocity is commanded",
        ),
        ("dynamic_run_2", ("velocity_filter.window=25",), "ShapeLaw needs no velocity"),
        ("dynamic_run_2", ("controller.velocity=commanded",), "ShapeLaw needs no velocity"),
        ("dynamic_run_2", ("sensors.inertial.heading=0.1",), "arm.sensed names no orientation and no tilt"),
        ("dynamic_run_2", ("sensors.curvature.noise=0.1",), "arm.curvature_sensors is null"),
        ("dynamic_run_2", ("plant.arm.sensed=[pose,pose,tilt]",), "arm.sensed and arm.curvature_sensors say it"),
        (
            "dynamic_run_2",
            ("controller.adaptive=false", "arm.curvature_sensors=[0.1]"),
            "algorithm 2 takes positions and poses alone",
        ),
        ("kinematic", ("controller.adaptive=false", "controller.velocity=commanded"), "controller.adaptive is false"),
        ("kinematic", ("controller.adaptive=false", "adaptation.gamma=3"), "controller.adaptive is false"),
        ("kinematic", ("plant.pid.K_P=3",), "experiment kinematic has no forces"),
        ("kinematic", ("arm.mass=2",), "experiment kinematic has no forces"),
        ("kinematic", ("experiment.setpoints=[[0,0,-0.3]]",), "experiment kinematic follows its sine"),
        ("kinematic", ("experiment.start_error=0.2",), "experiment.start_errors is zero"),
        ("kinematic", ("recording.rate=3",), "experiment kinematic replays no recording"),
        ("kinematic", ("prune.above=3",), "prune.after is null"),
        ("kinematic", ("batch_workers=3",), "there is no batch"),
        ("kinematic", ("feedback.mode=position", "feedback.angular_weight=0.3"), "feedback.mode is position"),
        ("dynamic_run_2", ("experiment.r_0=[0,0,-0.4]",), "experiment.setpoints are the targets"),
        ("dynamic_run_2", ("state=exact",), "experiment kinematic alone can know q"),
        ("dynamic_run_2", ("arm.masses=[1,1,1]", "arm.mass=2"), "arm.masses says it"),
        ("tracking", ("experiment.subset=training",), "there are no experiment.setpoints"),
        ("replay", ("plant.refine=3",), "experiment replay moves no arm"),
        ("replay", ("arm.lengths=[0.1]",), "from the recording"),
    ],
)
def test_what_nothing_in_a_simulation_reads_is_refused_with_why(
    experiment: str, words: tuple[str, ...], why: str
) -> None:
    config = changed(experiment, *words)
    check_given(of_a_simulation, [config], words[:-1])
    with pytest.raises(ConfigError, match=rf"^{words[-1].partition('=')[0]} is read by nothing: .*{why}"):
        check_given(of_a_simulation, [config], words)


def test_compose_refuses_it_and_choices_of_groups_too() -> None:
    with pytest.raises(ConfigError, match=r"^sensors is read by nothing: state is exact"):
        compose("experiment=kinematic", "state=exact", "sensors=mocap")
    assert compose("experiment=kinematic", "sensors=mocap", "velocity_filter.window=9")
    assert compose("experiment=dynamic_run_2_composite", "velocity_filter.window=9"), "the feed-forward reads it"


def test_in_a_sweep_a_key_has_to_be_read_by_one_run() -> None:
    standard, adaptive = (changed("kinematic", f"controller.adaptive={each}") for each in ("false", "true"))
    words = ["controller.adaptive=false,true", "adaptation.gamma=3"]
    check_given(of_a_simulation, [standard, adaptive], words)
    with pytest.raises(ConfigError, match=r"adaptation\.gamma is read by nothing"):
        check_given(of_a_simulation, [standard, standard], words)


def test_what_is_refused_changes_nothing() -> None:
    idle = (
        "arm.mass=2",
        "arm.tendon_offset=0.02",
        "plant.refine=3",
        "arm.layout=independent",
    )
    logs = [kinematic.simulate(changed("kinematic", *QUICK, *words), progress=quiet).log for words in ((), idle)]
    for one, other in zip(*logs, strict=True):
        torch.testing.assert_close(one, other, rtol=0.0, atol=0.0)
    idle = ("velocity_filter.window=9", "experiment.omega=2", "experiment.start_errors=2", "recording.rate=7")
    runs = [dynamic.simulate(changed("dynamic_run_2", *SHORT, *words), progress=quiet).log for words in ((), idle)]
    for one, other in zip(*runs, strict=True):
        torch.testing.assert_close(one, other, rtol=0.0, atol=0.0, equal_nan=True)


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (("controller.rate=50",), "loop.rate is the rate here"),
        (("ramp.duration=3",), "experiment.kind is not tendons"),
        (("calibration.lengths=false",), "calibration.file names none"),
        (("series.figures=false",), "there are no series.runs"),
        (("page.port=81",), "view is not browser"),
        (("stream.port=81", "view=browser"), "view is not foxglove"),
        (("adaptation.normalisation=3", "controller.adaptive=false"), "controller.adaptive is false"),
    ],
)
def test_what_nothing_in_a_run_in_real_time_reads(words: tuple[str, ...], why: str) -> None:
    base = ("experiment=setpoint", "adaptation=normalised")
    with pytest.raises(ConfigError, match=f"is read by nothing: {why}"):
        check_given(of_a_realtime_run, [composed_realtime(*base, *words)], words)


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (("controller.K=3",), "a calibration runs no controller"),
        (("adaptation=none",), "a calibration runs no controller"),
        (("experiment.duration=3",), "a calibration runs no controller"),
        (("view=false",), "a calibration runs no loop"),
        (("loop.hold=0",), "a calibration runs no loop"),
        (("guards.overruns=3",), "a calibration runs no loop"),
        (("calibration.rest_tolerance=0.1",), "a run that uses the calibration reads it"),
        (("calibration.pull=0.01",), r"calibration\.check_signs is false"),
        (("loop.rate=100",), r"calibration\.check_signs is false"),
        (("ramp.duration=3",), "experiment.kind is not tendons"),
    ],
)
def test_what_no_calibration_reads(words: tuple[str, ...], why: str) -> None:
    with pytest.raises(ConfigError, match=f"is read by nothing: {why}"):
        check_given(of_a_realtime_run, [composed_realtime("experiment=calibration", *words)], words)


def test_a_series_reads_its_own_keys() -> None:
    planned = arm_series.planned(raw_realtime("experiment=experiment_2"))
    assert len(planned) > 1
    check_given(of_a_realtime_run, planned, ["series.only=[run_1]", "series.figures=false"])
    with pytest.raises(ConfigError, match=r"ramp\.goal is read by nothing: experiment\.kind is not tendons"):
        check_given(of_a_realtime_run, planned, ["ramp.goal=[1]"])


def test_what_a_calibration_reads() -> None:
    read = (
        "calibration.frames=3",
        "calibration.file=x",
        "plant.pid.K_P=3",
        "hardware.sensor.rate=90",
        "arm.base=standing",
    )
    pulled = ("calibration.check_signs=true", "loop.rate=100", "guards.effort_cap=50", "calibration.pull=0.01")
    for words in (read, pulled):
        check_given(of_a_realtime_run, [composed_realtime("experiment=calibration", *words)], words)


def test_what_no_fit_reads() -> None:
    words = ("arm=ftdcr_v6", "fit.slide_travel=0", "spread.friction=0.3")
    with pytest.raises(ConfigError, match=r"spread\.friction is read by nothing: fit\.slide_travel is zero"):
        check_given(of_a_fit, [composed_identify(*words)], words)


def test_a_key_of_another_command_is_named_with_it() -> None:
    alone = tuple(name for name in names(RealtimeSettings) if name not in names(SimulateSettings))
    assert set(alone) == set(ON_AN_ARM)
    both = {*names(RunSettings), "figures"}
    assert set(RealtimeSettings.elsewhere) == set(names(SimulateSettings)) - both
    with pytest.raises(ConfigError, match=r"^experiment=experiment_2 is for python -m apcc_torch\.robot: it sets "):
        composed("experiment=experiment_2")
    with pytest.raises(ConfigError, match=r"^guards is no setting here, but one of python -m apcc_torch\.robot$"):
        compose("experiment=kinematic", "guards.overruns=3")
