"""What stands in space on a page: base, arm, tendons, sensors, virtual model, target."""

from __future__ import annotations

from typing import Any

import numpy as np

from apcc_torch.report import style
from apcc_torch.viewing.moment import Array, Moment
from apcc_torch.viewing.page import Page
from apcc_torch.viewing.tube import tube

LAYERS = ("arm", "tendons", "sensors", "uncertainty", "model")
"""What can be hidden."""
SLACK, TIGHT = style.faded(style.MUTED, 0.8), style.faded(style.VERMILION, 1.0)
ARM_OPACITY = 0.42
"""Of the arm's tube, so that the model in it is seen."""
LINEAR = 2.2
"""Exponent that makes a colour one of light, which is how lines take theirs."""


class Scene:
    """Nodes of a page, made when they are first shown and moved from then on.

    Args:
        page: Where.
        length: Of the arm, m.
        radius: Of its tube, m.
        upward: Whether it stands; else it hangs.
        full_tension: Tension of a tendon that is drawn as tight, N.

    Attributes:
        enlarged: How many standard deviations an ellipsoid's axes are.
    """

    def __init__(
        self, page: Page, length: float, radius: float, upward: bool = False, full_tension: float = 1.0
    ) -> None:
        self.scene = page.server.scene
        self.server = page.server
        self.length, self.radius = length, radius
        self.nodes: dict[str, Any] = {}
        self.visible = dict.fromkeys(LAYERS, True)
        self.full_tension = full_tension
        self.enlarged = 30.0
        self._ball = _ball()
        self._draw_room(upward)

    def _draw_room(self, upward: bool) -> None:
        length, radius = self.length, self.radius
        floor = -0.012 * length if upward else -1.45 * length
        self.scene.configure_environment_map(hdri=None)
        self.scene.add_light_hemisphere("/light/sky", ground_color=(198, 204, 212), intensity=1.5)
        self.scene.add_light_directional(
            "/light/sun", intensity=2.2, position=(1.5 * length, -1.2 * length, 3.0 * length)
        )
        self.scene.configure_default_lights(enabled=False)
        self.scene.add_grid(
            "/room/floor",
            width=2.0 * length,
            height=2.0 * length,
            cell_size=0.1,
            section_size=0.1,
            cell_color=_rgb(style.GRID),
            section_color=_rgb(style.GRID),
            shadow_opacity=0.0,
            position=(0.0, 0.0, floor),
        )
        plate, thick = 5.0 * radius, 0.8 * radius
        self.scene.add_cylinder(
            "/room/base",
            radius=0.5 * plate,
            height=thick,
            color=(150, 158, 168),
            position=(0.0, 0.0, (-0.5 if upward else 0.5) * thick),
        )
        self.scene.add_frame("/room/axes", axes_length=3.2 * radius, axes_radius=0.12 * radius)

    def show(self, moment: Moment) -> None:
        """Shows an instant, whole in one picture."""
        with self.server.atomic():
            self._show_arm(moment.sections)
            if moment.model is not None:
                self._mesh("model", "/model", tube(moment.model, 0.36 * self.radius), color=_rgb(style.INK))
            if moment.tendons is not None:
                self._show_tendons(moment.tendons, moment.tension)
            if moment.sensors is not None:
                self._show_sensors(moment.sensors, moment.covariance)
            if moment.target is not None:
                self._show_target(moment.target)

    def hide(self, layer: str, visible: bool) -> None:
        """Shows or hides a layer, one of `LAYERS`."""
        self.visible[layer] = visible
        for name, node in self.nodes.items():
            if name.partition("/")[0] == layer:
                node.visible = visible

    def target_control(self, at: Array) -> Any:
        """viser's handle of a target that can be dragged, in place of the shown one; at (3,) m."""
        far = 1.5 * self.length
        control = self.scene.add_transform_controls(
            "/target",
            scale=0.2 * self.length,
            line_width=3.0,
            disable_rotations=True,
            translation_limits=((-far, far),) * 3,
            depth_test=False,
            position=tuple(float(v) for v in at),
        )
        self.scene.add_icosphere("/target/ball", radius=0.8 * self.radius, color=_rgb(style.TARGET))
        self.nodes["target"] = control
        return control

    def _add(self, name: str, make: Any) -> None:
        node = make()
        node.visible = self.visible.get(name.partition("/")[0], True)
        self.nodes[name] = node

    def _mesh(self, name: str, path: str, mesh: tuple[Array, Array], **look: Any) -> None:
        vertices, faces = mesh
        if name in self.nodes:
            self.nodes[name].vertices = vertices
        else:
            self._add(name, lambda: self.scene.add_mesh_simple(path, vertices, faces, side="double", **look))

    def _show_arm(self, sections: Array) -> None:
        for i, points in enumerate(sections):
            color = _rgb(style.SERIES[i % len(style.SERIES)])
            mesh = tube(points, self.radius)
            self._mesh(f"arm/{i}", f"/arm/section_{i + 1}", mesh, color=color, opacity=ARM_OPACITY)

    def _show_tendons(self, paths: Array, tension: Array | None) -> None:
        """As pieces of lines; those that do not run lie in one point."""
        pieces = np.stack((paths[:, :-1], paths[:, 1:]), axis=-2)  # (n_a, Q - 1, 2, 3)
        runs = np.isfinite(pieces).all((-1, -2))
        color = np.broadcast_to(np.array(SLACK), (len(paths), 3))
        if tension is not None:
            pull = np.nan_to_num(tension).clip(min=0.0)
            share = (pull / self.full_tension).clip(max=1.0)[:, None]
            color = (1.0 - share) * color + share * np.array(TIGHT)
        points = np.where(runs[..., None, None], pieces, 0.0).reshape(-1, 2, 3).astype(np.float32)
        colors = np.broadcast_to(color[:, None, None], pieces.shape).reshape(-1, 2, 3)
        colors = (255 * colors**LINEAR).round().astype(np.uint8)
        if "tendons" in self.nodes:
            self.nodes["tendons"].points, self.nodes["tendons"].colors = points, colors
            return
        look = {"thickness": 0.2 * self.radius, "thickness_units": "world"}
        self._add("tendons", lambda: self.scene.add_line_segments("/tendons", points, colors, **look))

    def _show_sensors(self, T: Array, covariance: Array | None) -> None:
        if T.ndim == 2:
            wxyz = np.broadcast_to(np.array((1.0, 0.0, 0.0, 0.0)), (len(T), 4))
            self._instances("sensors/balls", T.astype(np.float32), wxyz, np.full((len(T), 3), 1.35 * self.radius))
            return
        seen = np.asarray(np.isfinite(T).all((-1, -2)))
        T = np.where(seen[:, None, None], T, np.eye(4))
        places = T[:, :3, 3].astype(np.float32)
        self._instances("sensors/collars", places, _quaternions(T[:, :3, :3]), seen[:, None] * np.ones((1, 3)))
        self._instances("sensors/axes", places, _quaternions(T[:, :3, :3]), seen[:, None] * np.ones((1, 3)))
        if covariance is None:
            return
        known = seen & np.isfinite(covariance).all((-1, -2))
        size, turn = np.linalg.eigh(np.where(known[:, None, None], covariance, np.eye(3)))
        turn[..., 0] *= np.sign(np.linalg.det(turn))[:, None]
        axes = self.enlarged * np.sqrt(size.clip(min=0.0)) * known[:, None]
        self._instances("uncertainty/ellipsoids", places, _quaternions(turn), axes.astype(np.float32))

    def _instances(self, name: str, places: Array, wxyz: Array, scales: Array) -> None:
        """Copies of one thing (k of them), each at its place."""
        scales = np.maximum(scales, 1e-6).astype(np.float32)  # nothing is seen of what is so small
        if name in self.nodes:
            node = self.nodes[name]
            node.batched_positions, node.batched_wxyzs, node.batched_scales = places, wxyz, scales
            return
        if name == "sensors/axes":
            look: dict[str, Any] = {"axes_length": 2.6 * self.radius, "axes_radius": 0.1 * self.radius}
            self._add(name, lambda: self.scene.add_batched_axes(f"/{name}", wxyz, places, scales, **look))
            return
        collar = name == "sensors/collars"
        mesh = _collar(self.radius) if collar else self._ball
        look = {"batched_scales": scales, "lod": "off"}
        known = name.startswith("sensors/")
        look["batched_colors"] = _rgb(style.SENSOR if known else style.PURPLE)
        look["opacity"] = None if known else 0.35
        self._add(name, lambda: self.scene.add_batched_meshes_simple(f"/{name}", *mesh, wxyz, places, **look))

    def _show_target(self, target: Array) -> None:
        if target.ndim == 2:
            if "target" in self.nodes:
                self.nodes["target"].points = target.astype(np.float32)
                return
            look = {"thickness": 0.3 * self.radius, "thickness_units": "world"}
            pieces = np.stack((target[:-1], target[1:]), axis=1)
            self._add("target", lambda: self.scene.add_line_segments("/target", pieces, _rgb(style.TARGET), **look))
            return
        if "target" not in self.nodes:
            ball = {"radius": 0.8 * self.radius, "color": _rgb(style.TARGET)}
            self._add("target", lambda: self.scene.add_icosphere("/target", **ball))
        self.nodes["target"].position = tuple(float(v) for v in target)


def _rgb(color: str) -> tuple[int, int, int]:
    r, g, b = (round(255 * part) for part in style.faded(color, 1.0))
    return r, g, b


def _quaternions(R: Array) -> Array:
    """(k, 4) w, x, y, z of rotations (k, 3, 3)."""
    from viser.transforms import SO3  # an extra, which the page has found by now

    wxyz: Array = SO3.from_matrix(R).wxyz
    return wxyz


def _collar(radius: float) -> tuple[Array, Array]:
    half = 0.3 * radius
    return tube(np.array([(0.0, 0.0, -half), (0.0, 0.0, half)]), 1.18 * radius)


def _ball() -> tuple[Array, Array]:
    """A sphere of radius 1."""
    from trimesh.creation import icosphere  # viser brings it

    mesh = icosphere(subdivisions=2)
    return mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32)
