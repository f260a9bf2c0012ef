"""A recording from settings to a folder: an arm that bends in a plane it does not know of is followed."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from apcc_torch.errors import ConfigError, DataError
from apcc_torch.estimation.rest_calibration import RestCalibration
from apcc_torch.experiments import replay
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.recordings.recording import Recording, save_recording
from apcc_torch.recordings.replay_log import ReplayLog
from composed import changed

LENGTHS = torch.tensor([0.1, 0.12, 0.11], dtype=torch.float64)
FRAMES, REST = 60, 20
BASE = ("replay.base_position=[0,0,0]", "replay.direction=[0,0,1]")
QUICK = ("figures=false", "progress=false", "recording.layout=table", *BASE)


def bends() -> torch.Tensor:
    """(FRAMES, 9) configurations: at rest, then every section bends, without elongation."""
    moving = (torch.arange(FRAMES, dtype=torch.float64) - REST).clamp(min=0.0).unsqueeze(-1) / 100
    size = torch.tensor([0.3, -0.2, 0.0] * 3, dtype=torch.float64)
    return size * torch.sin(2.0 * moving)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of a standing arm whose base is the recording's origin."""
    backbone = PCCBackbone(3)
    T = backbone.pose(bends(), LENGTHS, *decouple(LENGTHS.cumsum(0), LENGTHS))
    quaternion = Rotation.from_matrix(T[..., :3, :3].reshape(-1, 3, 3).numpy()).as_quat()
    still = (torch.arange(FRAMES) >= REST).to(torch.float64).unsqueeze(-1)
    recording = Recording(
        ("low", "middle", "tip"),
        torch.arange(FRAMES, dtype=torch.float64) / 100,
        T[..., :3, 3].clone(),
        torch.from_numpy(quaternion).reshape(FRAMES, 3, 4),
        torch.ones(FRAMES, 3, dtype=torch.bool),
        still,
        target=T[:, -1, :3, 3].clone(),
    )
    path = tmp_path_factory.mktemp("recorded") / "recording.csv"
    save_recording(recording, path)
    return path


def run(folder: Path, data: Path | None, *changes: str) -> dict[str, float]:
    return replay.run(changed("replay", *QUICK, *([f"data={data}"] if data else []), *changes), folder)


def test_folder_holds_what_was_returned_and_the_arm_is_followed(recorded: Path, tmp_path: Path) -> None:
    metrics = run(tmp_path, recorded, "figures=true")
    assert json.loads((tmp_path / "metrics.json").read_text()) == metrics
    assert all(math.isfinite(value) for value in metrics.values())
    assert metrics["frames"] == FRAMES and metrics["gated_position_frames_tip"] == 0
    assert metrics["sensor_error_linear_mean_mm"] < 0.5 and metrics["sensor_error_angular_mean_rad"] < 0.01
    assert (tmp_path / "figures" / "replay.png").is_file() and (tmp_path / "versions.json").is_file()
    calibration = RestCalibration.load(tmp_path / "calibration.json")
    torch.testing.assert_close(calibration.abscissae, LENGTHS.cumsum(0), rtol=0, atol=1e-4)
    with np.load(tmp_path / "trajectory.npz") as data:
        assert set(data) == set(ReplayLog._fields)
        # The calibrated frame may be turned about the arm's axis; how much every section bends is the same.
        bend = np.hypot(data["q_bar"][:, 0::3], data["q_bar"][:, 1::3])
        true = bends().numpy()
        np.testing.assert_allclose(bend, np.hypot(true[:, 0::3], true[:, 1::3]), atol=0.02)


def test_the_same_recording_gives_the_same_numbers(recorded: Path, tmp_path: Path) -> None:
    first, again = (run(tmp_path / name, recorded.parent, "replay.frames=30") for name in "ab")
    assert first["frames"] == 30
    assert {**first, "wall_s": 0} == {**again, "wall_s": 0}


def test_a_controller_that_adapts_is_driven_by_the_recorded_target(recorded: Path, tmp_path: Path) -> None:
    metrics = run(tmp_path, recorded, "controller.adaptive=true", "replay.frames=30")
    assert metrics["frames"] == 30
    with np.load(tmp_path / "trajectory.npz") as data:
        assert np.isfinite(data["pi_hat"]).all()


def test_what_is_missing_is_named_and_nothing_is_written(recorded: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="data must name"):
        run(tmp_path, None)
    with pytest.raises(DataError, match=r"nowhere\.csv"):
        run(tmp_path, tmp_path / "nowhere.csv")
    with pytest.raises(ConfigError, match="layout"):
        run(tmp_path, recorded, "recording.layout=rows")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kept", [(), ("u",), ("phi",), ("target",), ("tracked",), ("u", "phi", "target", "tracked")])
def test_what_is_optional_may_be_missing(kept: tuple[str, ...], recorded: Path, tmp_path: Path) -> None:
    lines = [line.split(",") for line in recorded.read_text().splitlines()]
    lines = [[*line, "phi1" if k == 0 else str(k)] for k, line in enumerate(lines)]
    optional = ("u1", "phi1", "target_", "_tracked")
    wanted = [k for k, c in enumerate(lines[0]) if not any(o in c for o in optional) or any(o in c for o in kept)]
    path = tmp_path / "recording.csv"
    path.write_text("\n".join(",".join(line[k] for k in wanted) for line in lines) + "\n")
    # Without inputs the rest is told by stillness.
    still = run(tmp_path / "still", path, "replay.frames=5")
    metrics = run(tmp_path / "run", path, "replay.frames=5", f"replay.rest={REST}")
    assert still["sensor_error_linear_mean_mm"] == pytest.approx(metrics["sensor_error_linear_mean_mm"], abs=1e-3)
    assert metrics["frames"] == 5 and metrics["sensor_error_linear_mean_mm"] < 0.5
