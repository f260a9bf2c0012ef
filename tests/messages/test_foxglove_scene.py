"""Messages of Foxglove's schemas, decoded by another library: poses and times are exact, what is unseen is left out."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from apcc_torch.lie import so3
from apcc_torch.messages.foxglove_scene import SceneMessages
from apcc_torch.viewing.drawn_size import DrawnSize
from apcc_torch.viewing.moment import Moment
from laws import generator

pytest.importorskip("foxglove", reason="foxglove-sdk is not installed")
pytest.importorskip("mcap")

from mcap.records import Schema

protobuf = pytest.importorskip("mcap_protobuf.decoder", reason="mcap-protobuf-support is not installed")

FACTORY = protobuf.DecoderFactory()
SIZE = DrawnSize(0.6, 0.016, False, 10.0)


def decoded(message: Any) -> Any:
    """A message by the schema that its class brings."""
    told = type(message).get_schema()
    schema = Schema(id=hash(told.name) % 1000 + 1, name=told.name, encoding=told.encoding, data=told.data)
    return FACTORY.decoder_for("protobuf", schema)(message.encode())


def poses(seed: int, count: int) -> np.ndarray:
    """(count, 4, 4) m."""
    rng = generator(seed)
    T = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    T[:, :3, :3] = so3.exp(2.0 * torch.randn(count, 3, generator=rng, dtype=torch.float64))
    T[:, :3, 3] = torch.randn(count, 3, generator=rng, dtype=torch.float64)
    return T.numpy()


@given(st.integers(0, 10**6), st.integers(0, 2**31 * 10**9 - 1), st.lists(st.booleans(), min_size=1, max_size=5))
@settings(max_examples=20, deadline=None)
def test_poses_and_times_come_back_and_the_unseen_are_left_out(seed: int, stamp: int, seen: list[bool]) -> None:
    make, T = SceneMessages(SIZE), poses(seed, len(seen))
    T[~np.array(seen)] = np.nan
    frames = decoded(make.transforms([(f"sensor_{k}", each) for k, each in enumerate(T)], stamp)).transforms
    places = decoded(make.poses(T, stamp))
    assert [f.child_frame_id for f in frames] == [f"sensor_{k}" for k, one in enumerate(seen) if one]
    assert len(places.poses) == sum(seen)
    assert places.timestamp.seconds * 10**9 + places.timestamp.nanos == stamp
    for pose, frame, place in zip(T[np.array(seen)], frames, places.poses, strict=True):
        assert frame.timestamp.seconds * 10**9 + frame.timestamp.nanos == stamp and frame.parent_frame_id == "world"
        assert [frame.translation.x, frame.translation.y, frame.translation.z] == pose[:3, 3].tolist()
        assert [place.position.x, place.position.y, place.position.z] == pose[:3, 3].tolist()
        x, y, z, w = (getattr(frame.rotation, axis) for axis in "xyzw")
        assert [getattr(place.orientation, axis) for axis in "xyzw"] == [x, y, z, w]
        turned = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])  # the z axis
        assert np.allclose(turned, pose[:3, 2], atol=1e-12)


def test_a_tube_lies_around_its_line_and_a_tendon_ends_where_it_does() -> None:
    line = np.stack((0.1 * np.sin(np.linspace(0.0, 2.0, 9)), np.zeros(9), -np.linspace(0.0, 0.3, 9)), axis=-1)
    aside = np.array((0.02, 0.0, 0.0))
    tendons = np.stack((line + aside, line - aside))
    tendons[1, 5:] = np.nan
    sensors = poses(1, 2)
    sensors[0] = np.nan
    moment = Moment(line[None], tendons, None, sensors, target=np.array([0.1, 0.2, -0.3]))
    parts = {entity.id: entity for entity in decoded(SceneMessages(SIZE).scene(moment, 5)).entities}
    assert set(parts) == {"section_1", "backbone", "tendons", "sensors", "target"}
    (mesh,) = parts["section_1"].triangles
    vertices = np.array([[p.x, p.y, p.z] for p in mesh.points])
    away = np.linalg.norm(vertices[:, None] - line, axis=-1).min(-1)
    assert away.max() == pytest.approx(SIZE.radius, rel=1e-5) and mesh.color.a < 1.0
    assert len(mesh.indices) % 3 == 0 and set(mesh.indices) == set(range(len(vertices)))
    assert [len(path.points) for path in parts["tendons"].lines] == [9, 5]
    (ball,) = parts["sensors"].spheres
    assert [ball.pose.position.x, ball.pose.position.y, ball.pose.position.z] == sensors[1, :3, 3].tolist()
    assert parts["target"].spheres[0].pose.position.z == -0.3
