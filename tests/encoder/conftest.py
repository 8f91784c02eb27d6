"""What several tests of encoders share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from torch.optim.optimizer import register_optimizer_step_pre_hook


@pytest.fixture
def updates() -> Iterator[dict[str, int]]:
    """Counts the updates of all optimisers; interrupts the one numbered `stop`."""
    counter = {"made": 0, "stop": -1}

    def count(*_: object) -> None:
        counter["made"] += 1
        if counter["made"] == counter["stop"]:
            raise KeyboardInterrupt

    handle = register_optimizer_step_pre_hook(count)
    yield counter
    handle.remove()
