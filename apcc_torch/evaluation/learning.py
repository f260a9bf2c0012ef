"""Methods that know nothing of arms: regressions of scikit-learn's, all on the same features."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from apcc_torch.errors import ConfigError
from apcc_torch.evaluation.frames import Frames
from apcc_torch.evaluation.method import LEARNING, Known, Method
from apcc_torch.evaluation.tasks import Task
from apcc_torch.identification.split import thinned

Array = NDArray[Any]
Estimator = Any
"""Of scikit-learn, which ships no types."""

MOST = 1500
"""Moments that a regression whose cost grows with their square or cube sees; the others see all."""
CHOICES = 800
"""Moments that its hyperparameters are chosen on, by five stretches held back in turn."""
LAGS = 5
"""Moments of the past, evenly spread over what an arm's fit sees of it, that a lagged regression sees."""


def held(frames: Frames, task: Task) -> Tensor:
    """From where a regression counts (N, k, 3) or nothing: the sample before, where a task shows it."""
    return frames.past.positions[:, 0] if task.ahead else torch.zeros_like(frames.positions)


class Regression(Method):
    """A regression from what is shown to all bodies, one for each task; where a load may be followed, from `seen`.

    One step ahead every regression is lagged: it sees the two samples before, and says how far bodies move on.

    Args:
        known: See `Method`.
    """

    family = LEARNING
    most: ClassVar[int | None] = None
    lagged: ClassVar[bool] = False
    slack: ClassVar[bool] = False
    motors_only: ClassVar[bool] = False

    def __init__(self, known: Known) -> None:
        super().__init__(known)
        self._train: Frames | None = None
        self._learned: dict[Task, Estimator] = {}

    def estimator(self, x: Array, y: Array) -> Estimator:
        """What is fitted, with what has to be chosen chosen on features (N, p) and positions (N, 3 k)."""
        raise NotImplementedError

    def answers(self, task: Task) -> bool:
        """See `Method.answers`."""
        return not (self.motors_only and (task.shown or not task.motors))

    def fit(self, train: Frames) -> None:
        """See `Method.fit`."""
        self._train, self._learned = train, {}

    def predict(self, test: Frames, task: Task, seen: Frames | None = None) -> Tensor:
        """See `Method.predict`."""
        train = self._train if seen is None else seen
        assert train is not None, "fit comes before predict"
        if seen is not None or task not in self._learned:
            index = train.past.seen if task.ahead else torch.arange(len(train))
            some = train.at(index if self.most is None else thinned(index, self.most))
            self._learned[task] = self.learned(some, some.positions - held(some, task), task)
        return held(test, task) + self.said(self._learned[task], test, task)

    def learned(self, train: Frames, wanted: Tensor, task: Task) -> Estimator:
        """A regression of `wanted` (N, k, 3) at the moments of `train`.

        Raises:
            ConfigError: scikit-learn is not installed.
        """
        try:
            from sklearn.pipeline import make_pipeline
            from sklearn.preprocessing import StandardScaler
        except ImportError as error:
            raise ConfigError('it needs scikit-learn: pip install "apcc-torch[evaluate]"') from error
        x, y = self.features(train, task), wanted.flatten(1).numpy()
        return make_pipeline(StandardScaler(), self.estimator(x, y)).fit(x, y)

    def said(self, model: Estimator, test: Frames, task: Task) -> Tensor:
        """What a regression says at the moments of `test` (M, k, 3)."""
        return torch.from_numpy(model.predict(self.features(test, task))).view_as(test.positions)

    def features(self, frames: Frames, task: Task) -> Array:
        """What is shown, as columns (N, p)."""
        columns = [frames.positions[:, list(task.shown)].flatten(1)]
        if task.orientations:
            columns.append(frames.rotations[:, list(task.shown)].flatten(1).nan_to_num())
        if task.motors:
            history = frames.drive.history
            lags = history.shape[1] - 1
            lagged = self.lagged or task.ahead
            steps = sorted({round(lags * j / LAGS) for j in range(LAGS + 1)}) if lagged else [0]
            columns += [history[:, step] for step in steps]
            if self.slack:
                columns = [column.clamp(**end) for column in columns for end in ({"min": 0.0}, {"max": 0.0})]
            if lagged:
                columns.append(frames.drive.slide)
        if task.ahead:
            last, before = frames.past.positions.flatten(2).unbind(1)
            columns += [frames.past.drive.history[:, 0], last, last - before]
        return torch.cat(columns, -1).numpy()


class Mean(Regression):
    """The mean of the training positions."""

    def answers(self, task: Task) -> bool:
        """See `Method.answers`."""
        return not task.ahead

    def estimator(self, x: Array, y: Array) -> Estimator:
        """See `Regression.estimator`."""
        from sklearn.dummy import DummyRegressor

        return DummyRegressor()


class Persistence(Method):
    """Every body stays where it was at the sample before."""

    family = LEARNING

    def answers(self, task: Task) -> bool:
        """See `Method.answers`."""
        return task.ahead

    def fit(self, train: Frames) -> None:
        """See `Method.fit`."""

    def predict(self, test: Frames, task: Task, seen: Frames | None = None) -> Tensor:
        """See `Method.predict`."""
        return test.past.positions[:, 0]


class SteadyMotion(Persistence):
    """Every body moves on as it did before."""

    def predict(self, test: Frames, task: Task, seen: Frames | None = None) -> Tensor:
        """See `Method.predict`."""
        return 2.0 * test.past.positions[:, 0] - test.past.positions[:, 1]


class Linear(Regression):
    """Least squares, with a ridge that only keeps it determined."""

    def estimator(self, x: Array, y: Array) -> Estimator:
        """See `Regression.estimator`."""
        from sklearn.linear_model import Ridge

        return Ridge(alpha=1e-6)


class KernelMethod(Regression):
    """Kernel ridge regression on the motors of the last moments too; its two numbers are chosen on training data."""

    most, lagged = MOST, True

    def estimator(self, x: Array, y: Array) -> Estimator:
        """See `Regression.estimator`."""
        from sklearn.kernel_ridge import KernelRidge
        from sklearn.model_selection import GridSearchCV, KFold
        from sklearn.preprocessing import StandardScaler

        scale = 1.0 / x.shape[1]
        grid = {"alpha": [1e-4, 1e-3, 1e-2, 1e-1], "gamma": [scale * share for share in (0.01, 0.03, 0.1, 0.3, 1.0)]}
        few = np.linspace(0, len(x) - 1, min(len(x), CHOICES)).astype(int)
        search = GridSearchCV(KernelRidge(kernel="rbf"), grid, cv=KFold(5), scoring="neg_mean_squared_error")
        scaled, target = (StandardScaler().fit_transform(values[few]) for values in (x, y))
        return centred(KernelRidge(kernel="rbf", **search.fit(scaled, target).best_params_))


class KernelAtSlack(KernelMethod):
    """The same with each input split at zero, where a tendon goes slack."""

    slack, motors_only = True, True


class Forest(Regression):
    """A random forest."""

    most, lagged = MOST, True

    def estimator(self, x: Array, y: Array) -> Estimator:
        """See `Regression.estimator`."""
        from sklearn.ensemble import RandomForestRegressor

        return RandomForestRegressor(60, min_samples_leaf=2, max_features=0.5, random_state=self.known.seed)


class Network(Regression):
    """A multi-layer perceptron of two hidden layers."""

    most, lagged = MOST, True

    def estimator(self, x: Array, y: Array) -> Estimator:
        """See `Regression.estimator`."""
        from sklearn.neural_network import MLPRegressor

        net = MLPRegressor(
            hidden_layer_sizes=(64, 64), alpha=1e-3, learning_rate_init=2e-3, tol=1e-3, max_iter=1000,
            random_state=self.known.seed,
        )  # fmt: skip
        return centred(net)


def centred(estimator: Estimator) -> Estimator:
    """A regression of positions less their mean, over their deviation."""
    from sklearn.compose import TransformedTargetRegressor
    from sklearn.preprocessing import StandardScaler

    return TransformedTargetRegressor(estimator, transformer=StandardScaler())
