"""A URDF is read as its format says, and what a mount cannot have is refused by name."""

from __future__ import annotations

import math
import random
import re
from pathlib import Path

import pytest
import torch

from apcc_torch.errors import ConfigError, DataError
from apcc_torch.model.mount import RigidMount
from apcc_torch.model.urdf import joints_between

GANTRY = (Path(__file__).parents[2] / "examples" / "urdf" / "gantry.urdf").read_text()
LIMIT = '<limit lower="-1" upper="2" effort="5" velocity="3"/>'


def urdf(inner: str = LIMIT, kind: str = "revolute", more: str = "") -> str:
    """Links a, b and one joint j between them."""
    return (
        f'<robot name="r"><link name="a"/><link name="b"/><joint name="j" type="{kind}"><parent link="a"/>'
        f'<child link="b"/>{inner}</joint>{more}</robot>'
    )


def test_what_is_not_given_is_the_formats_default() -> None:
    (joint,) = joints_between(urdf('<limit effort="5" velocity="3"/>'), None, "b")
    assert joint.axis.tolist() == [1.0, 0.0, 0.0] and torch.equal(joint.origin, torch.eye(4, dtype=torch.float64))
    assert (joint.lower, joint.upper, joint.velocity) == (0.0, 0.0, 3.0)
    (free,) = joints_between(urdf("", "continuous"), None, "b")
    assert (free.lower, free.upper, free.velocity) == (-math.inf, math.inf, math.inf)
    (bolted,) = joints_between(urdf('<axis xyz="0 0 0"/><mimic joint="k"/>', "fixed"), None, "b")
    assert bolted.moves == "fixed"


def test_only_what_is_in_between_is_read() -> None:
    hand = '<link name="c"/><joint name="k" type="floating"><parent link="b"/><child link="c"/></joint>'
    drives = '<transmission name="t"><joint name="j"><hardwareInterface/></joint></transmission>'
    text = urdf(LIMIT + '<dynamics damping="1"/><safety_controller k_velocity="1"/>', more=hand + drives)
    assert [joint.name for joint in joints_between(text, None, "b")] == ["j"]
    assert joints_between(text, "b", "b") == []
    spaced = text.replace("<robot", '<robot xmlns="http://www.ros.org" xmlns:xacro="http://ros.org/wiki/xacro"')
    assert [joint.name for joint in joints_between(f"\ufeff{spaced}", None, "b")] == ["j"]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("gantry.urdf", r"not a URDF \(a file's path must be a Path\): "),
        ('<?xml version="1.0"?><model/>', "not a URDF: it must hold a <robot>, and holds a <model>"),
        ("<robot/>", "not a URDF: it has no link"),
        ("\ud800", "not a URDF"),
        (urdf('<mimic joint="k"/>' + LIMIT), "joint j: <mimic> is none that a mount can have"),
        (urdf('<axis xyz="0 0 0"/>' + LIMIT), "joint j: axis xyz must point somewhere, got 0 0 0"),
        (urdf('<axis xyz="1e200 1e200 0"/>' + LIMIT), "joint j: axis xyz must point somewhere"),
        (urdf("<axis/>" + LIMIT), "joint j: <axis> must have xyz"),
        (urdf('<axis xzy="0 0 1"/>' + LIMIT), "joint j: <axis> has xzy, which is not read: it may have xyz"),
        (urdf('<axis xyz="0 1"/>' + LIMIT), "joint j: axis xyz must be three numbers, got '0 1'"),
        (urdf('<axis xyz="0 nan 1"/>' + LIMIT), "joint j: axis xyz must be a finite number, got 'nan'"),
        (urdf('<origin xyz="0 0 ${h}"/>' + LIMIT), r"joint j: origin xyz must be a finite number, got '\${h}'"),
        (urdf('<origin rpy="0 0 1e999"/>' + LIMIT), "joint j: origin rpy must be a finite number, got '1e999'"),
        (urdf('<origin quat_xyzw="0 0 0 1"/>' + LIMIT), "joint j: <origin> has quat_xyzw, which is not read"),
        (urdf('<limit effort="1"/>'), "joint j: <limit> must have velocity"),
        (urdf('<limit velocity="1"/>'), "joint j: <limit> must have effort"),
        (urdf('<limit velocity="1"/>', "continuous"), "joint j: <limit> must have effort"),
        (urdf(""), "joint j: a revolute joint must have a <limit> with effort and velocity"),
        (urdf("", "prismatic"), "joint j: a prismatic joint must have a <limit>"),
        (urdf('<limit effort="1" velocity="-1"/>'), "joint j: limit velocity must not be negative, got -1"),
        (
            urdf('<limit lower="1" effort="1" velocity="1"/>'),
            "joint j: limit lower must not be above upper, got 1 and 0",
        ),
        (urdf(LIMIT + LIMIT), "joint j: there must be one <limit>, got 2"),
        (urdf('<parent link="b"/>' + LIMIT), "joint j: there must be one <parent>, got 2"),
        (urdf(kind="floating"), "joint j: a floating joint is none that a mount can have"),
        (urdf(kind="planar"), "joint j: a planar joint is none"),
        (urdf(kind="hinge"), "joint j: type must be one of revolute, continuous, .*, got hinge"),
        (urdf().replace(' type="revolute"', ""), "joint j: type must be one of .*, got None"),
        (urdf().replace('child link="b"', 'child link="c"'), "joint j: <child> must name a link that is there, got c"),
        (urdf().replace('<parent link="a"/>', ""), "joint j: <parent> must name a link that is there, got None"),
        (urdf(more='<link name="a"/>'), "has 2 links of the name a"),
        (urdf(more="<link/>"), "has a <link> without a name"),
        (urdf(more='<link name="c"/>'), "is no tree: it has several roots, a, c"),
        (
            urdf(more='<link name="c"/><joint name="k" type="fixed"><parent link="c"/><child link="b"/></joint>'),
            "is no tree: link b is the child of two joints, j and k",
        ),
        (
            urdf(more='<joint name="k" type="fixed"><parent link="b"/><child link="a"/></joint>'),
            "is no tree: link a hangs on itself",
        ),
        (
            urdf(more='<joint name="j" type="fixed"><parent link="b"/><child link="a"/></joint>'),
            "2 joints of the name j",
        ),
    ],
)
def test_refusals(text: str, said: str) -> None:
    with pytest.raises(DataError, match=said) as refused:
        RigidMount(text, "b")
    assert re.fullmatch(r"the mount's (text|URDF)[^\n]*", str(refused.value))


def test_links_that_do_not_lead_to_each_other(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="the mount's link a does not hang on link b"):
        RigidMount(urdf(), "a", root_link="b")
    with pytest.raises(DataError, match=r"the mount's URDF .*none\.urdf cannot be read"):
        RigidMount(tmp_path / "none.urdf", "b")
    (tmp_path / "latin.urdf").write_bytes(b"<robot name='\xe9'/>")
    with pytest.raises(DataError, match=r"the mount's URDF .*latin\.urdf cannot be read"):
        RigidMount(tmp_path / "latin.urdf", "b")


WORDS = ("0", "1", "-1", "1e400", "nan", "inf", "1_0", "", "0 0 0", "revolute", "continuous", "floating", "lift")
TAGS = (
    "<mimic joint='turn'/>",
    "<limit/>",
    "<axis/>",
    "<origin/>",
    "<link name='lift'/>",
    "<joint/>",
    "<",
    "&",
    "\x00",
)


def mutated(rng: random.Random) -> str:
    """The gantry with up to two changes: values, attributes, elements and letters that come, go or are others."""
    text = GANTRY
    for _ in range(rng.choice((1, 1, 2))):
        pattern = rng.choice((r'"[^"]*"', r'\w+="[^"]*"', r"<[^>]*>", r"."))
        at = rng.choice(list(re.finditer(pattern, text)) or [re.match("", text)])
        assert at is not None
        other = {'"': f'"{rng.choice(WORDS)}"', "<": rng.choice(TAGS)}.get(at[0][:1], rng.choice(WORDS))
        new = rng.choice(("", 2 * at[0], other))
        text = text[: at.start()] + new + text[at.end() :]
    return text


def test_whatever_the_text_the_mount_is_finite_or_refused() -> None:
    rng, kept = random.Random(3), 0
    for _ in range(300):
        text = mutated(rng)
        try:
            mount = RigidMount(text, "flange")
        except (DataError, ConfigError):
            continue
        kept += 1
        joints = torch.linspace(-1.0, 1.0, mount.n_joints, dtype=torch.float64)
        pose, jacobian = mount.pose_and_body_jacobian(joints)
        assert pose.isfinite().all() and jacobian.isfinite().all(), text
        assert bool((mount.lower <= mount.upper).all()) and bool((mount.velocity >= 0).all()), text
        axes = torch.stack([joint.axis for joint in joints_between(text, None, "flange")])
        torch.testing.assert_close(axes.norm(dim=-1), torch.ones(len(axes), dtype=torch.float64))
    assert 30 < kept < 270  # of both there are many


def test_a_chain_too_long_is_refused() -> None:
    links = "".join(f'<link name="l{k}"/>' for k in range(400))
    joints = "".join(
        f'<joint name="j{k}" type="fixed"><parent link="l{k}"/><child link="l{k + 1}"/></joint>' for k in range(399)
    )
    with pytest.raises(DataError, match="has 399 joints in a row, and may have 100"):
        RigidMount(f'<robot name="r">{links}{joints}</robot>', "l399")
