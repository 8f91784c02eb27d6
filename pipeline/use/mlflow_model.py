"""The model as MLflow serves it: a script that `mlflow.pyfunc` runs ("models from code"), so no pickle is read.

One row a question: `question` with "{tactile}" once a video, `videos` as base64. No path is taken, so that whoever asks
a server can read none of its files.
"""

from __future__ import annotations

from typing import Any

import mlflow.models
import pandas as pd
from mlflow.exceptions import MlflowException
from mlflow.protos.databricks_pb2 import INVALID_PARAMETER_VALUE
from mlflow.pyfunc import PythonModel

from pipeline.errors import UserError
from pipeline.use.media import PLACE, Gate, Limits, Refused, from_base64

ROWS = 64
"""Questions of one call."""


class TouchModel(PythonModel):  # type: ignore[misc]
    """Answers a table of questions."""

    def load_context(self, context: Any) -> None:
        """Load the folder that was logged; `model_config` may name `base`, `device` and `dtype`."""
        from pipeline.use.model import Octopi

        self.model = Octopi.from_pretrained(context.artifacts["folder"], **(context.model_config or {}))
        self.gate = Gate(Limits())

    def predict(self, context: Any, model_input: pd.DataFrame, params: dict[str, Any] | None = None) -> pd.DataFrame:
        """Answer each row.

        Returns:
            One column, `answer`.

        Raises:
            MlflowException: 400 over HTTP, with the row and the line that the library says.
        """
        if len(model_input) > ROWS:
            raise _refusal(f"{len(model_input)} questions; ask at most {ROWS} in a call")
        answers = []
        for number, (question, videos) in enumerate(
            zip(model_input["question"], model_input["videos"], strict=True), 1
        ):
            try:
                answers.append(self._answer(question, list(videos)))
            except UserError as error:
                raise _refusal(PLACE.sub(r"video \1", f"row {number}: {error}")) from None
        return pd.DataFrame({"answer": answers})

    def _answer(self, question: str, videos: list[str]) -> str:
        limits = self.gate.limits
        if sum(map(len, videos)) > limits.body_bytes:
            raise Refused(f"its videos are larger than {limits.body_bytes} bytes; send fewer or shorter ones", 413)
        data = [from_base64(text, f"video {i}") for i, text in enumerate(videos, 1)]
        with self.gate.files(data) as files:
            return str(self.model.ask(question, files))


def _refusal(message: str) -> MlflowException:
    return MlflowException(message, error_code=INVALID_PARAMETER_VALUE)


mlflow.models.set_model(TouchModel())
