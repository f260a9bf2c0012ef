"""The camera is an orthographic projection, and the box holds what it is given."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from apcc_torch.report import style
from apcc_torch.report.space import Camera, Space, bounding_box

angles = st.floats(-180.0, 180.0)


@given(elevation=st.floats(-89.0, 89.0), azimuth=angles)
def test_the_picture_plane_is_orthonormal_and_faces_the_camera(elevation: float, azimuth: float) -> None:
    camera = Camera(elevation, azimuth)
    frame = np.vstack((camera.axes(), camera.towards()))
    assert frame @ frame.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(frame) == pytest.approx(1.0)
    assert camera.axes()[0, 2] == 0.0 and camera.axes()[1, 2] > 0  # the horizon is level, up is up


def test_known_views() -> None:
    p = np.array([1.0, 2.0, 3.0])
    assert Camera(0.0, 0.0).project(p) == pytest.approx((2.0, 3.0))  # from +x: y runs right, z up
    assert Camera(0.0, -90.0).project(p) == pytest.approx((1.0, 3.0))  # from -y: x runs right


def test_box_holds_the_base_and_all_finite_points() -> None:
    points = np.array([[0.3, -0.2, -0.6], [np.nan, 0.0, 0.0]])
    box = bounding_box(points, margin=0.05, least=0.5)
    assert (box.low <= (0.0, -0.2, -0.6)).all() and (box.high >= (0.3, 0.0, 0.0)).all()
    assert (box.high - box.low >= 0.5 * 0.6 - 1e-12).all()
    assert np.allclose(bounding_box(0.1 * points).high, 0.1 * bounding_box(points).high), "it goes with the arm"


@pytest.mark.parametrize("view", [(14.0, -62.0), (14.0, -14.0), (-20.0, 130.0), (0.0, 0.0)])
def test_axes_have_equal_scales_and_hold_the_box(view: tuple[float, float]) -> None:
    figure = style.new_figure(4.0, 4.0)
    box = bounding_box(np.array([[0.5, 0.3, -0.6]]))
    space = Space(figure.subplots(), box, Camera(*view))
    assert space.ax.get_aspect() == 1.0
    seen = space.camera.project(np.stack((box.low, box.high)))
    (left, right), (bottom, top) = space.ax.get_xlim(), space.ax.get_ylim()
    assert (seen[:, 0] > left).all() and (seen[:, 0] < right).all()
    assert (seen[:, 1] > bottom).all() and (seen[:, 1] < top).all()
    assert "z (m)" in {text.get_text() for text in space.ax.texts}


def test_a_line_is_the_projection_of_its_points() -> None:
    space = Space(style.new_figure().subplots(), bounding_box(np.ones((1, 3))), Camera(0.0, -90.0))
    points = np.random.default_rng(0).normal(size=(7, 3))
    assert space.plot(points).get_xydata() == pytest.approx(points[:, [0, 2]])
