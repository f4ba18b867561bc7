"""The object that checks test: a trained model, or any other predictor of the field of a frame."""

from copy import deepcopy
from typing import Protocol

from torch import Tensor

from cconv.data.trajectory import Frame, Scene
from cconv.models.model import Model


class Predictor(Protocol):
    """Interface of a predictor of the field of a frame.

    Attributes:
        precision: What its products of matrices are computed in.
    """

    precision: str

    def predict(self, frame: Frame, scene: Scene) -> Tensor:
        """Predict the field (N, C) at the fluid particles in the precision of normal use."""

    def predict_exactly(self, frame: Frame, scene: Scene) -> Tensor:
        """Predict the field in float64."""


class ModelPredictor:
    """A trained model as a `Predictor`.

    Args:
        model: The model.
    """

    def __init__(self, model: Model):
        self.precision = model.config.precision
        self._model, self._exact = model, deepcopy(model).to(model.home).double()

    def predict(self, frame: Frame, scene: Scene) -> Tensor:
        """Field (N, C) in the units of the data, as `Model.predict_frame`."""
        return self._model.predict_frame(frame, scene)

    def predict_exactly(self, frame: Frame, scene: Scene) -> Tensor:
        """Predict the field with weights and inputs in float64."""
        return self._exact.predict(self._model.inputs(frame, scene).double())
