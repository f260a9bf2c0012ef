"""Arms as files for others: MuJoCo's statics are ours, and the URDF has the arm's places and masses."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from apcc_torch.errors import ShapeError
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.arm import Arm
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.model.link_chain import ChainSettings, LinkChain
from apcc_torch.model.loads import Loads
from apcc_torch.model.mjcf import mjcf_text
from apcc_torch.model.statics import equilibrium
from apcc_torch.model.urdf import joints_between
from apcc_torch.model.urdf_file import urdf_text
from apcc_torch.model_file import main
from laws import generator, uniform

pytest.importorskip("mujoco", reason="mujoco is not installed")

import mujoco
from mujoco_rest import AtRest

kinematics = pytest.importorskip("pytorch_kinematics", reason="pytorch_kinematics is not installed")

D = torch.float64
FINE = 4
"""Parts of a section of the arm that the models are compared with."""


def random_arm(seed: int) -> Arm:
    """An arm of two to four sections with racks and sensors anywhere, that hangs or stands without falling."""
    rng = generator(seed)
    n_b = 2 + seed % 3
    lengths = uniform((n_b,), 0.08, 0.2, D, rng)
    whole = lengths.sum()
    racks, sensors = ((whole * uniform((2,), 0.3, 1.0, D, rng)).sort().values for _ in range(2))
    return Arm(
        name=f"random_{seed}",
        lengths=lengths.tolist(),
        racks=racks.tolist(),
        sensors=sensors.tolist(),
        layout=("coupled", "independent")[seed % 2],
        base=("hanging", "standing")[seed % 2],
        mass=float(uniform((1,), 0.1, 0.3, D, rng)),
        tendon_offset=0.015,
        tendons_per_rack=3 + seed % 2,
        bending_rigidity=0.15,
        axial_rigidity=60.0,
    )


ARMS = {name: Arm.load(name) for name in ("arm_1", "arm_2", "trunk")} | {f"random_{k}": random_arm(k) for k in (1, 2)}


@cache
def chain(name: str) -> LinkChain:
    return LinkChain(ARMS[name], ChainSettings())


@cache
def model(name: str) -> Any:
    """The arm's model, loaded where a warning is an error."""
    said: list[str] = []
    mujoco.set_mju_user_warning(said.append)
    try:
        loaded = mujoco.MjModel.from_xml_string(mjcf_text(chain(name)))
        mujoco.mj_forward(loaded, mujoco.MjData(loaded))
    finally:
        mujoco.set_mju_user_warning(None)
    assert not said, said
    return loaded


def poses(arm: Arm, q: torch.Tensor, abscissae: torch.Tensor, parts: int) -> torch.Tensor:
    """(k, 4, 4) of material points, m."""
    lengths = arm.refined(parts)
    return PCCBackbone(arm.n_sections * parts, arm.base_rotation()).pose(q, lengths, *decouple(abscissae, lengths))


def load(what: str, name: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """What our statics and MuJoCo's are told."""
    arm, rng = ARMS[name], generator(5)
    if what == "force":
        force = uniform((3,), -0.3, 0.3, D, rng)
        return {"loads": Loads(torch.cat((torch.zeros(3, dtype=D), force)))}, {"force": force.tolist()}
    if what == "tendons":
        tensions = uniform((arm.n_tendons,), 0.0, 3.0, D, rng)
        return {"routing": arm.routing(), "tensions": tensions}, {"tensions": tensions.tolist()}
    return {}, {}


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize("what", ["gravity", "force", "tendons"])
def test_mujoco_at_rest_is_where_our_statics_are(name: str, what: str) -> None:
    arm = ARMS[name]
    ours, theirs = load(what, name)
    found = equilibrium(arm.dynamics(FINE), **ours)
    rest = AtRest(model(name), **theirs)
    assert bool(found.converged) and rest.residual < 1e-8
    length = float(arm.rest_lengths().sum())
    T = poses(arm, found.q, torch.cat((arm.sensor_places(), torch.tensor([length], dtype=D))), FINE)
    for site, pose in zip([*(f"sensor_{i + 1}" for i in range(len(T) - 1)), "tip"], T.numpy(), strict=True):
        assert np.linalg.norm(rest.data.site(site).xpos - pose[:3, 3]) < 0.01 * length, site
        assert np.abs(rest.data.site(site).xmat.reshape(3, 3) - pose[:3, :3]).max() < 0.05, site
    # The coarse arm of the controller's model is a little further off.
    coarse = equilibrium(arm.dynamics(), **ours)
    tip = poses(arm, coarse.q, torch.tensor([length], dtype=D), 1)[0, :3, 3].numpy()
    assert np.linalg.norm(rest.data.site("tip").xpos - tip) < 0.01 * length


def test_more_elements_come_closer() -> None:
    arm = ARMS["trunk"]
    ours, theirs = load("tendons", "trunk")
    length = arm.rest_lengths().sum(-1, keepdim=True)
    tip = poses(arm, equilibrium(arm.dynamics(8), **ours).q, length, 8)[0, :3, 3].numpy()
    off = []
    for elements in (2, 4, 8):
        loaded = mujoco.MjModel.from_xml_string(mjcf_text(LinkChain(arm, ChainSettings(elements=elements))))
        off.append(float(np.linalg.norm(AtRest(loaded, **theirs).data.site("tip").xpos - tip)))
    assert off[1] < off[0] / 2 and off[2] < off[1] / 2


@pytest.mark.parametrize("name", ["arm_1", "random_1"])
def test_a_simulation_settles_at_rest_without_a_warning(name: str) -> None:
    arm, loaded = ARMS[name], model(name)
    tensions = np.full(arm.n_tendons, 1.0)
    data = mujoco.MjData(loaded)
    data.ctrl[:] = tensions
    for _ in range(2000):
        mujoco.mj_step(loaded, data)
    assert not data.warning.number.any() and np.abs(data.qvel).max() < 1e-2
    rest = AtRest(loaded, tensions)
    assert np.linalg.norm(data.site("tip").xpos - rest.data.site("tip").xpos) < 1e-3


def test_everything_has_a_name_and_its_number() -> None:
    arm, loaded = ARMS["arm_1"], model("arm_1")
    assert loaded.ntendon == loaded.nu == arm.n_tendons == 9
    data = mujoco.MjData(loaded)
    data.ctrl[:] = np.arange(9.0)
    mujoco.mj_forward(loaded, data)
    assert data.sensor("pull_4_force").data == pytest.approx([3.0])
    assert data.sensor("tip_position").data == pytest.approx([0.0, 0.0, -0.6], abs=1e-9)
    assert data.sensor("sensor_2_position").data == pytest.approx([0.0, 0.0, -0.36], abs=1e-9)
    assert data.sensor("sensor_1_orientation").data == pytest.approx([0.0, 1.0, 0.0, 0.0], abs=1e-12)
    assert data.sensor("tendon_7_length").data == pytest.approx([0.6], abs=1e-9)
    # A tendon's length changes as our model has it, where each of a section's elements bends by its share.
    q = torch.tensor([0.2, -0.1, 0.01, -0.3, 0.1, 0.0, 0.1, 0.2, -0.005], dtype=D)
    for section in range(3):
        for k in range(6):
            number = 6 * section + k + 1
            for joint, share in ((f"bend_x_{number}", 0), (f"bend_y_{number}", 1)):
                data.joint(joint).qpos[:] = q[3 * section + share] / 6
            for half in "ab":
                data.joint(f"stretch_{number}{half}").qpos[:] = q[3 * section + 2] / 12
    mujoco.mj_forward(loaded, data)
    y = arm.routing().lengths(q, arm.rest_lengths())
    lengths = torch.tensor([data.sensor(f"tendon_{i + 1}_length").data[0] for i in range(9)], dtype=D)
    assert torch.allclose(lengths - arm.routing().anchors, y, atol=5e-4)
    T = PCCBackbone(3, arm.base_rotation()).tip(q, arm.rest_lengths()).numpy()
    assert np.linalg.norm(data.site("tip").xpos - T) < 2e-3


@pytest.mark.parametrize("name", ARMS)
def test_the_urdf_has_the_arms_places_and_masses(name: str) -> None:
    arm, text = ARMS[name], urdf_text(chain(name))
    root = ElementTree.fromstring(text)
    mass = sum(float(each.get("value", "0")) for each in root.iter("mass"))
    assert mass == pytest.approx(float(arm.section_masses().sum()), rel=1e-9)
    tree = kinematics.build_chain_from_urdf(text.encode()).to(dtype=D)
    zero = torch.zeros(len(tree.get_joint_parameter_names()), dtype=D)
    found = tree.forward_kinematics(zero)
    straight = torch.zeros(3 * arm.n_sections, dtype=D)
    T = poses(arm, straight, torch.cat((arm.sensor_places(), arm.rest_lengths().sum(-1, keepdim=True))), 1)
    for link, pose in zip([*(f"sensor_{i + 1}" for i in range(len(T) - 1)), "tip"], T, strict=True):
        assert torch.allclose(found[link].get_matrix()[0], pose, atol=1e-6), link  # it holds float32
    # Our own reader, which refuses what the format does not allow, finds the same chain.
    ours = joints_between(text, None, "tip")
    place = torch.eye(4, dtype=D)
    for joint in ours:
        place = place @ joint.origin
    assert torch.allclose(place, T[-1], atol=1e-9)
    moves = [joint.moves for joint in ours]
    assert moves.count("revolute") == moves.count("prismatic") == 12 * arm.n_sections
    assert all(joint.lower < 0 < joint.upper for joint in ours if joint.moves != "fixed")


def test_the_urdf_loads_in_mujoco_with_the_same_masses() -> None:
    loaded = mujoco.MjModel.from_xml_string(urdf_text(chain("arm_1")))
    same = model("arm_1")
    assert loaded.nv == same.nv and [loaded.joint(k).name for k in range(loaded.njnt)] == [
        same.joint(k).name for k in range(same.njnt)
    ]
    fixed = chain("arm_1").links[0].mass  # what does not move is the world's
    assert loaded.body_mass.sum() + fixed == pytest.approx(1.0, rel=1e-9)
    assert np.array_equal(loaded.dof_damping, same.dof_damping)
    data, other = mujoco.MjData(loaded), mujoco.MjData(same)
    for model_, each in ((loaded, data), (same, other)):
        mujoco.mj_forward(model_, each)
    assert data.xpos[-1] == pytest.approx(other.xpos[-1], abs=1e-9)
    # In the same pose gravity asks the same of the joints.
    pose = 0.05 * np.sin(np.arange(loaded.nq))
    forces = []
    for model_, each in ((loaded, data), (same, other)):
        each.qpos[:] = pose
        mujoco.mj_forward(model_, each)
        forces.append(each.qfrc_bias.copy())
    assert forces[0] == pytest.approx(forces[1], abs=1e-9)


def test_a_bend_at_rest_is_the_zero_of_both() -> None:
    arm = Arm(
        lengths=[0.2, 0.25], mass=0.01, rest_bend=[[0.4, 0.0], [0.0, -0.3]], bending_rigidity=10.0, axial_rigidity=1e4
    )
    bent = LinkChain(arm, ChainSettings(elements=20))
    q = torch.tensor([0.4, 0.0, 0.0, 0.0, -0.3, 0.0], dtype=D)
    tip = PCCBackbone(2, arm.base_rotation()).tip(q, arm.rest_lengths())
    tree = kinematics.build_chain_from_urdf(urdf_text(bent).encode()).to(dtype=D)
    zero = torch.zeros(len(tree.get_joint_parameter_names()), dtype=D)
    assert torch.allclose(tree.forward_kinematics(zero)["tip"].get_matrix()[0, :3, 3], tip, atol=2e-4)
    rest = AtRest(mujoco.MjModel.from_xml_string(mjcf_text(bent)))
    assert rest.data.site("tip").xpos == pytest.approx(tip.numpy(), abs=1e-3)


def test_the_program_writes_a_file_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "arm.xml"
    main(["arm_2", str(file), "--elements", "2"])
    assert capsys.readouterr().out == f"{file}: 19 links of 1 kg, 9 tendons\n"
    assert mujoco.MjModel.from_xml_path(str(file)).nv == 24
    for words, said in (
        ([str(file)], "is there already: name another file, or overwrite=true writes over it"),
        ([str(tmp_path / "arm.sdf")], "must end with .xml or .urdf, which says its format"),
        ([str(tmp_path / "b.xml"), "--elements", "0"], "elements must be in [1, 200], got 0"),
    ):
        with pytest.raises(SystemExit) as ended:
            main(["arm_2", *words])
        assert ended.value.code == 2 and said in capsys.readouterr().err
    main(["arm_2", str(file), "overwrite=true"])
    assert mujoco.MjModel.from_xml_path(str(file)).nv == 72


def test_an_arm_of_rows_is_refused() -> None:
    rows = Arm(lengths=torch.tensor([[0.1, 0.2], [0.1, 0.3]], dtype=D))
    with pytest.raises(ShapeError, match="must be those of one arm"):
        LinkChain(rows, ChainSettings())
