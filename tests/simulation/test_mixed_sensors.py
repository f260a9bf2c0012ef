"""Inertial units and gratings as they are simulated: noise, drift, offsets, delay, and what they do not measure."""

from __future__ import annotations

import math

import pytest
import torch

from apcc_torch import compose
from apcc_torch.experiments.dynamic import metrics, simulate
from apcc_torch.lie import so3
from apcc_torch.model.sensor_kinds import SensorKinds
from apcc_torch.simulation.curvature_sensors import CurvatureSensors, CurvatureSensorsSettings
from apcc_torch.simulation.inertial_units import InertialUnits, InertialUnitsSettings
from apcc_torch.simulation.sensors import PoseSensors
from laws import generator, normal, poses

D = torch.float64
KINDS = SensorKinds(("orientation", "position", "pose", "tilt"))


def test_a_sensor_tells_what_it_measures_and_nothing_else() -> None:
    T = poses((5, 4), D, generator())
    sensors = PoseSensors(kinds=KINDS)
    _, seen, mask = sensors(sensors.initial_state(T), T)
    placed, turned = torch.isfinite(seen[..., :3, 3]).all(-1), torch.isfinite(seen[..., :3, :3]).flatten(-2).all(-1)
    assert placed.tolist() == [[False, True, True, False]] * 5 and turned.tolist() == [[True, False, True, True]] * 5
    torch.testing.assert_close(seen[:, [0, 2, 3], :3, :3], T[:, [0, 2, 3], :3, :3], rtol=0, atol=1e-15)
    assert torch.equal(seen[:, 1:3, :3, 3], T[:, 1:3, :3, 3]) and bool(mask.all())


def test_a_heading_walks_from_an_offset_and_a_mounting_stays() -> None:
    N, steps, period = 4000, 50, 0.04
    settings = InertialUnitsSettings(heading=0.2, heading_drift=0.1, mounting=0.05)
    units, R, draw = InertialUnits(settings, period=period), so3.exp(normal((N, 1, 3), D, generator(1))), generator(2)
    state = first = units.initial_state(R[..., 0, 0], draw)
    for _ in range(steps):
        state, seen = units(state, R, normal((N, 1, 4), D, draw))
    walked = (state.heading - first.heading).flatten()
    assert float(first.heading.std()) == pytest.approx(0.2, rel=4 / math.sqrt(2 * N))
    assert float(walked.std()) == pytest.approx(0.1 * math.sqrt(steps * period), rel=4 / math.sqrt(2 * N))
    assert torch.equal(state.mounting, first.mounting)
    assert float(state.mounting.std()) == pytest.approx(0.05, rel=4 / math.sqrt(6 * N))
    z = torch.nn.functional.pad(state.heading.unsqueeze(-1), (2, 0))
    torch.testing.assert_close(seen, so3.exp(z) @ R @ so3.exp(state.mounting), rtol=0, atol=1e-12)


def test_curvature_has_its_noise_offset_and_the_delay_of_the_others() -> None:
    N = 4000
    gratings, draw = CurvatureSensors(CurvatureSensorsSettings(noise=0.1, offset=0.3)), generator(3)
    true = normal((N, 2, 2), D, draw)
    state = gratings.initial_state(true, 1, draw)
    assert float(state.offset.std()) == pytest.approx(0.3, rel=4 / math.sqrt(8 * N))
    late, seen = gratings(state, true + 5.0, normal((N, 2, 2), D, draw))
    assert float((seen - true - state.offset).std()) == pytest.approx(0.1, rel=4 / math.sqrt(8 * N))
    _, next_seen = gratings(late, true, None)
    torch.testing.assert_close(next_seen, true + 5.0 + state.offset, rtol=0, atol=1e-12)


def test_poses_are_drawn_as_they_were_beside_other_kinds() -> None:
    """New kinds draw after what was there: a seed gives the poses that it gave."""
    T, all_pose = poses((3, 4), D, generator()), PoseSensors(1e-3, 0.02, dropout=0.2)
    mixed = PoseSensors(1e-3, 0.02, dropout=0.2, kinds=KINDS, inertial=InertialUnitsSettings(tilt_noise=0.1))
    have, want = (each.draw(T, generator(4)) for each in (mixed, all_pose))
    assert have.noise is not None and want.noise is not None and torch.equal(have.noise, want.noise)
    assert have.inertial is not None and want.inertial is None and have.inertial.shape == (3, 2, 4)


def test_an_experiment_runs_on_a_mixed_set_from_its_arms_keys() -> None:
    config = compose(
        "experiment=dynamic_run_2",
        "plant=rod",
        "sensors=mocap",
        "arm.sensed=[orientation,tilt,pose]",
        "arm.curvature_sensors=[0.1,0.3]",
        "plant.refine=1",
        "sensors.inertial.tilt_noise=0.01",
        "sensors.inertial.heading=0.2",
        "sensors.curvature.noise=0.05",
        "experiment.duration=0.1",
        "experiment.setpoints=[[0.05,0.0,-0.55]]",
        "experiment.payloads=[0.1,0.3]",
        "plant.settle=0.3",
        "compile=off",
        "progress=false",
    ).settings
    told = metrics(simulate(config))
    assert told["diverged_rows"] == 0 and told["rows"] == 2
    assert told["shape_error_end_mm"] < 30.0
