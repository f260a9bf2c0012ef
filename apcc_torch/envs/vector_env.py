"""Thousands of arms as one Gymnasium `VectorEnv` of torch tensors, on any device."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from torch import Tensor

from apcc_torch.annotations import check_type, shown
from apcc_torch.envs.outcome import View
from apcc_torch.envs.rendering import Picture, Renderer, Window, load_renderer
from apcc_torch.envs.row_trees import replaced, select, taken
from apcc_torch.envs.simulator import EnvState, Simulator, SimulatorSettings
from apcc_torch.envs.stepping import stepping
from apcc_torch.envs.streams import streams
from apcc_torch.envs.tasks import Reach
from apcc_torch.errors import ConfigError, DtypeError, ShapeError, ValueRangeError
from apcc_torch.model.arm import Arm
from apcc_torch.settings import About, resolved

DTYPES = {"float64": torch.float64, "float32": torch.float32}


class ArmVectorEnv(VectorEnv[Tensor, Tensor, Tensor]):
    """N environments as one batch. The tasks' classes say what is observed, done and rewarded.

    Observations, rewards and flags are tensors on `device`; actions are tensors or arrays. Every row draws from a
    random stream of its own, so what happens to one row, resets included, changes no bit of another, and row i of a
    seed draws the same whatever the number of rows.

    A row whose state leaves its bounds, or whose action is not a number, stays where it was and is truncated;
    `info["truncated_reason"]` (N,) says why, see `TruncatedReason`.

    `reset(options={"reset_mask": mask})` resets the rows where the (N,) bool mask is True and leaves the others as
    they are, their random streams too; with a seed, the rows reset start that seed's streams.

    Args:
        num_envs: N.
        max_episode_steps: Steps after which a row is truncated; None or -1 for no limit.
        arm: What the arms are nominally: an `Arm`, its file, or its name in conf/arm.
        dtype: Of the physics, "float64" or "float32". Observations and rewards are float32.
        device: A torch device.
        autoreset_mode: What happens to a row that is done: reset in the next step, in the same step, or not.
        render_mode: "rgb_array", or None for none.
        render_rows: How many rows `render` draws, the first ones.
        renderers: What draws in each render mode, "module:class".
        compile: How the step is run: "off", eagerly; "aot", as machine code, which is built once, in seconds,
            and kept; "auto", so where it can be had, on a GPU through torch's compiler; "inductor", through that. True
            is "inductor".
        **settings: What the arms do and what is drawn for them, see the task's `settings_type`.

    Raises:
        ConfigError, ValueRangeError: An argument has no meaning.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (Gymnasium's own form)
        "render_modes": ["rgb_array"],
        "render_fps": 25,
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }
    task: ClassVar[type[Reach]]
    settings_type: ClassVar[type[SimulatorSettings]]

    def __init__(
        self,
        num_envs: int = 1,
        max_episode_steps: int | None = None,
        *,
        arm: Arm | str | Path = "arm_1",
        dtype: str | torch.dtype = "float64",
        device: str | torch.device = "cpu",
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        render_rows: int = 4,
        renderers: Mapping[str, str] | None = None,
        compile: str | bool = "off",
        **settings: Any,
    ) -> None:
        check_type("num_envs", num_envs, "int")
        About(least=1).check("num_envs", num_envs)
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ConfigError(
                f"render_mode must be one of {', '.join(self.metadata['render_modes'])}, got {render_mode!r}"
            )
        limit = None if max_episode_steps == -1 else max_episode_steps
        s = resolved(self.settings_type, (), {"max_episode_steps": limit, **settings})
        arm = _one_arm(arm)
        self.num_envs = num_envs
        self.render_mode, self.render_rows, self.renderers = render_mode, render_rows, renderers or {}
        self.device = torch.device(device)
        like = torch.empty(0, dtype=_dtype(dtype), device=self.device)
        self.simulator = Simulator(self.task(arm, like, s), arm, like, s)
        mode = ("inductor" if compile else "off") if isinstance(compile, bool) else compile
        self._stepping = stepping(self.simulator, num_envs, mode)
        self.autoreset_mode = _mode(autoreset_mode)
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        bounds = self.simulator.bounds.cpu().numpy()
        self.single_observation_space = spaces.Box(-bounds, bounds, dtype=np.float32)
        self.single_action_space = spaces.Box(-1.0, 1.0, (self.simulator.action_size,), dtype=np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._state: EnvState | None = None
        self._view: View | None = None
        self._done = torch.zeros(num_envs, dtype=torch.bool, device=self.device)
        self._renderer: Renderer | None = None
        self._window: Window | None = None

    @property
    def state(self) -> EnvState | None:
        """Everything about the rows as it is now; None before the first reset. It may be kept, and set again."""
        return None if self._state is None else self._stepping.snapshot(self._state)

    @state.setter
    def state(self, state: EnvState | None) -> None:
        self._state = state

    @torch.no_grad()
    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Tensor, dict[str, Any]]:
        """Starts new episodes, of all rows or of those that `options["reset_mask"]` names.

        Returns:
            Observations (N, o), those of rows that are not reset as they were, and info.
        """
        super().reset(seed=seed)
        mask = None if options is None else options.get("reset_mask")
        if self._state is None or mask is None:
            if self._state is not None and seed is None:
                stream = self._state.stream
            else:
                stream = streams(int(self.np_random.integers(2**63)), self.num_envs, self.device)
            self._state, self._view = self._stepping.begun(stream)
            self._done = torch.zeros_like(self._done)
        else:
            rows = self._checked_mask(mask)
            if seed is not None:
                fresh = streams(int(self.np_random.integers(2**63)), self.num_envs, self.device)
                self._state = self._state._replace(stream=select(rows, fresh, self._state.stream))
            self._renew(rows)
            self._done = self._done & ~rows
        assert self._view is not None  # made above or by the first reset
        return self._view.observation.clone(), self._info(self._view, torch.zeros_like(self._state.step))

    @torch.no_grad()
    def step(self, actions: Tensor | NDArray[Any]) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        """One control period of every row; see `gymnasium.vector.VectorEnv.step`.

        Raises:
            ConfigError: `reset` was not called, or a finished row was not reset with autoreset disabled.
            ShapeError: `actions` is not (N, a).
        """
        if self._state is None:
            raise ConfigError("reset must be called before the first step")
        action = self._checked_action(actions)
        was_done = self._done
        any_done = bool(was_done.any())
        if any_done and self.autoreset_mode is AutoresetMode.DISABLED:
            raise ConfigError('rows that are done must be reset with options={"reset_mask": mask} before the next step')
        self._state, outcome, observation = self._stepping(self._state, action)
        view, reward, truncated, reason = outcome
        self._view = view
        if any_done:  # the next step after an episode's end: it resets, and its action is not used
            self._renew(was_done)
            observation = self._view.observation.clone()
            reward, truncated, reason = (
                reward.masked_fill(was_done, 0.0),
                truncated & ~was_done,
                reason.masked_fill(was_done, 0),
            )
        self._done = truncated.clone()  # what is returned may be written to
        info = self._info(self._view, reason)
        if self.autoreset_mode is AutoresetMode.SAME_STEP:
            if bool(truncated.any()):
                self._renew(truncated)
                observation = self._view.observation.clone()
                last = {**info, **{f"_{name}": truncated for name in info}}
                info = {
                    **self._info(self._view, reason),
                    "final_obs": view.observation.clone(),
                    "_final_obs": truncated,
                }
                info |= {"final_info": last, "_final_info": truncated}
            self._done = torch.zeros_like(truncated)
        return observation, reward, torch.zeros_like(truncated), truncated, info

    def render(self) -> tuple[NDArray[Any], ...] | None:
        """Pictures of the first `render_rows` rows, (H, W, 3) uint8 each; None without a render mode."""
        if self.render_mode is None:
            return None
        return tuple(self.drawing().frame(self.picture(row)) for row in range(min(self.num_envs, self.render_rows)))

    def drawing(self) -> Renderer:
        """What draws pictures, loaded when it is first needed."""
        if self._renderer is None:
            self._renderer = load_renderer(self.renderers, "rgb_array", self.simulator.description)
        return self._renderer

    def window(self) -> Window:
        """What shows one row to a person, loaded likewise."""
        if self._window is None:
            self._window = load_renderer(self.renderers, "human", self.simulator.description)
        return self._window

    def picture(self, row: int) -> Picture:
        """What a renderer draws of a row.

        Raises:
            ConfigError: `reset` was not called.
        """
        if self._state is None:
            raise ConfigError("reset must be called before render")
        return self.simulator.picture(taken(self._state, torch.tensor([row], device=self.device)))

    def close_extras(self, **kwargs: Any) -> None:
        """Closes the window, if there is one."""
        if self._window is not None:
            self._window.close()

    def _renew(self, rows: Tensor) -> None:
        """New episodes for the rows (N,) bool, the others untouched."""
        assert self._state is not None and self._view is not None  # there was a reset
        index = rows.nonzero().squeeze(-1)
        fresh, view = self._stepping.begun(taken(self._state.stream, index))
        self._state = replaced(self._state, index, fresh)
        self._view = replaced(self._view, index, view)

    def _info(self, view: View, reason: Tensor) -> dict[str, Any]:
        success = view.error < self.simulator.task.tolerance
        return {"error": view.error.float(), "is_success": success, "truncated_reason": reason.clone()}

    def _checked_action(self, actions: Tensor | NDArray[Any]) -> Tensor:
        try:
            action = torch.as_tensor(actions, device=self.device)
        except (TypeError, ValueError, RuntimeError) as error:
            raise DtypeError(f"actions must be numbers, got {shown(actions)}") from error
        if action.is_complex() or action.dtype == torch.bool:
            raise DtypeError(f"actions must be numbers, got {action.dtype}")
        want = (self.num_envs, self.simulator.action_size)
        if tuple(action.shape) != want:
            raise ShapeError(f"actions must have shape {want}, got {tuple(action.shape)}")
        return action.detach()

    def _checked_mask(self, mask: Any) -> Tensor:
        rows = torch.as_tensor(mask, device=self.device)
        if rows.dtype != torch.bool:
            raise DtypeError(f"reset_mask must be bool, got {rows.dtype}")
        if tuple(rows.shape) != (self.num_envs,):
            raise ShapeError(f"reset_mask must have shape ({self.num_envs},), got {tuple(rows.shape)}")
        if not bool(rows.any()):
            raise ValueRangeError("reset_mask must be True for at least one row")
        return rows


def _one_arm(told: Arm | str | Path) -> Arm:
    arm = told if isinstance(told, Arm) else Arm.load(told)
    places = (arm.rest_lengths(), arm.sensor_places(), arm.true_sensor_places())
    if any(each.dim() > 1 for each in places) or arm.dynamics().batch_marker.dim():
        raise ConfigError("arm must be one arm: rows of an environment differ by its ranges")
    if arm.sensor_kinds() is not None or arm.curvature_sensors is not None:
        raise ConfigError("arm must have sensed and curvature_sensors null: an environment's sensors tell positions")
    return arm


def _dtype(given: str | torch.dtype) -> torch.dtype:
    if given in DTYPES.values():
        return given  # type: ignore[return-value]
    if given not in DTYPES:
        raise ConfigError(f"dtype must be one of {', '.join(DTYPES)}, got {given!r}")
    return DTYPES[given]


def _mode(given: AutoresetMode | str) -> AutoresetMode:
    names = {mode.value: mode for mode in AutoresetMode} | AutoresetMode.__members__
    if isinstance(given, AutoresetMode):
        return given
    if given not in names:
        raise ConfigError(f"autoreset_mode must be one of {', '.join(AutoresetMode.__members__)}, got {given!r}")
    return names[given]
