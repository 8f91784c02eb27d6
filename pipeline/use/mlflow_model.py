"""The model as MLflow serves it: a script that `mlflow.pyfunc` runs ("models from code"), so no pickle is read.

One row a question: `question` with "{tactile}" once a video, `videos` as base64. No path is taken, so that whoever asks
a server can read none of its files.
"""

from __future__ import annotations

import logging
import os
import threading
from typing import Any

import mlflow.models
import pandas as pd
from mlflow.exceptions import MlflowException
from mlflow.protos.databricks_pb2 import INVALID_PARAMETER_VALUE
from mlflow.pyfunc import PythonModel

from pipeline.core.errors import UserError
from pipeline.use.media import PLACE, Gate, Refused, from_base64

logger = logging.getLogger(__name__)
ROWS, CHARACTERS = 64, 20_000
"""Questions of one call, and the length of each."""


class TouchModel(PythonModel):
    """Answers a table of questions."""

    def load_context(self, context: Any) -> None:
        """Load the folder that was logged.

        Its language model lies where `model_config["base"]` says, else the variable OCTOPI_BASE, else in a known place.
        """
        from pipeline.use.model import Octopi

        settings = {**(context.model_config or {})}
        settings["base"] = settings.get("base") or os.environ.get("OCTOPI_BASE") or None
        self.model = Octopi.from_pretrained(context.artifacts["folder"], **settings)
        self.gate = Gate()
        self.lock = threading.Lock()  # MLflow serves each request in a thread, and a model takes one at a time.

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
            except Exception:
                # MLflow would put the traceback into the response.
                logger.exception("row %d", number)
                raise MlflowException(f"row {number}: the model broke; the server's log says why") from None
        return pd.DataFrame({"answer": answers})

    def _answer(self, question: str, videos: list[str]) -> str:
        limits = self.gate.limits
        if not isinstance(question, str) or len(question) > CHARACTERS:
            raise Refused(f"its question is no text of at most {CHARACTERS} characters; write one", 422)
        if sum(map(len, videos)) > limits.body_bytes:
            raise Refused(f"its videos are larger than {limits.body_bytes} bytes; send fewer or shorter ones", 413)
        data = [from_base64(text, f"video {i}") for i, text in enumerate(videos, 1)]
        with self.gate.files(data) as files, self.lock:
            return str(self.model.ask(question, files))


def _refusal(message: str) -> MlflowException:
    return MlflowException(message, error_code=INVALID_PARAMETER_VALUE)


mlflow.models.set_model(TouchModel())
