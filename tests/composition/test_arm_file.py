"""An arm's file on a command line, as Hydra takes it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser

from apcc_torch.composition.arm_file import arm_override
from apcc_torch.errors import ConfigError, DataError
from apcc_torch.model.arm import Arm
from apcc_torch.model.arm_placement import Placement
from apcc_torch.model.arm_tendons import Tendons
from apcc_torch.reading import read
from composed import composed, composed_evaluate, composed_identify, composed_realtime

ARM = Arm(
    name="it's \\ 5 \\' mine, {really}",
    lengths=(0.2, 1e-05),
    base="standing",
    tendons=Tendons(angles=(0.0, 1.0), ends=(1, 2)),
    placement=Placement(rotation=(0.0, 0.1, 0.2)),
    mounts=[[0.0, 0.0, 0.1], [0.0, 0.0, 0.0]],
)


def test_a_file_is_spelled_out(tmp_path: Path) -> None:
    ARM.save(tmp_path / "mine.yaml")
    arguments = arm_override(["-m", f"arm={tmp_path}/mine.yaml", "arm.mass=2", "data=x.yaml"])
    assert arguments[:2] == ["-m", "~arm"] and arguments[3:] == ["arm.mass=2", "data=x.yaml"]
    override = OverridesParser.create().parse_override(arguments[2])
    assert override.key_or_group == "arm"
    assert read(override.value(), Arm) == ARM  # type: ignore[arg-type]


def test_a_file_without_a_name_is_called_as_the_file_is(tmp_path: Path) -> None:
    (tmp_path / "mine.yml").write_text("lengths: [0.1]\n")
    (tmp_path / "yours.yml").write_text("lengths: [0.2]\n")
    assert arm_override([f"arm={tmp_path}/mine.yml"]) == ["~arm", "arm={name:'mine',lengths:[0.1]}"]
    swept = arm_override([f"arm={tmp_path}/mine.yml,{tmp_path}/yours.yml"])
    assert swept == ["~arm", "arm={name:'mine',lengths:[0.1]},{name:'yours',lengths:[0.2]}"]


@pytest.mark.parametrize("name", ["${oc.env:HOME}", "../../elsewhere", "a\x1b[2J", "a\u202eb", "a\nb"])
def test_a_name_that_a_folder_cannot_have_is_refused(name: str, tmp_path: Path) -> None:
    """Runs are called by it: it leads nowhere else, and nothing in it is resolved."""
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump({"name": name, "lengths": [0.1]}))
    with pytest.raises(ConfigError, match=r"mine\.yaml: name must be printable, without / and \$\{"):
        arm_override([f"arm={tmp_path}/mine.yaml"])


def test_numbers_are_read_as_they_are_written(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("lengths: [2e-1, 0.2]\nbending_rigidity: [1e-2, 2.5e-3]\nmass: 3E-1\n")
    arm = Arm.load(tmp_path / "mine.yaml")
    assert arm.changed(name="arm") == Arm(lengths=[0.2, 0.2], bending_rigidity=[0.01, 0.0025], mass=0.3)
    named = arm.changed(name="1e3")
    named.save(tmp_path / "named.yaml")
    assert Arm.load(tmp_path / "named.yaml") == named


def test_names_are_left_to_hydra() -> None:
    assert arm_override(["arm=ftdcr_v6", "arm.mass=1", "data=arm.yaml"]) == [
        "arm=ftdcr_v6",
        "arm.mass=1",
        "data=arm.yaml",
    ]


def test_files_that_are_no_arms_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="cannot be read as an arm's file"):
        arm_override(["arm=nothing.yaml"])
    (tmp_path / "bad.yaml").write_text("lengths: [0.1]\nweight: 3\n")
    with pytest.raises(ConfigError, match=r"bad\.yaml: weight is no setting"):
        arm_override([f"arm={tmp_path}/bad.yaml"])
    with pytest.raises(ConfigError, match="arm must name files or names, not both"):
        arm_override([f"arm=trunk,{tmp_path}/bad.yaml"])


def test_what_identify_writes_is_an_arms_file_everywhere(tmp_path: Path) -> None:
    """parameters.json holds the arm, with numbers that YAML alone would take for text, and more beside it."""
    arm = ARM.changed(name="found", damping_ratio=1e-05)
    told = {"arm": arm.entries(), "usable": True, "parameters": [{"name": "offset: tendon 1", "value": 1e-05}]}
    path = tmp_path / "parameters.json"
    path.write_text(json.dumps(told, indent=2))
    assert Arm.load(path) == arm
    for composer, words in (
        (composed, ["experiment=setpoint"]),
        (composed_realtime, ["experiment=setpoint"]),
        (composed_evaluate, ["data=trunk_payload"]),
        (composed_identify, ["data=trunk"]),
    ):
        assert composer(*words, f"arm={path}").arm == arm
    assert arm.dynamics().gravity is not None and arm.routing().n_tendons == 2
