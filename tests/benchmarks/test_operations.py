"""Counting operations, against sums done by hand from the layers' shapes."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import nn

from pipeline.benchmarks.encoder_training import Describe
from pipeline.benchmarks.operations import counted
from pipeline.encoder.clip import load_visual_tower
from pipeline.encoder.scene_encoder import SceneEncoder
from tests.checkpoints import write_clip


def test_convolutions_and_products_are_counted_by_their_shapes() -> None:
    encoder, expected = SceneEncoder().eval(), 0

    def note(layer: nn.Module, _: object, out: torch.Tensor) -> None:
        nonlocal expected
        if isinstance(layer, nn.Conv2d):
            expected += 2 * out.numel() * layer.weight[0].numel()
        elif isinstance(layer, nn.Linear):
            expected += 2 * out.numel() * layer.in_features

    for layer in encoder.modules():
        layer.register_forward_hook(note)
    clip = {"frames": torch.zeros(1, 5, 120, 120, 3, dtype=torch.uint8)[0], "moments": torch.zeros(5)}
    found = counted(lambda: Describe(encoder)(clip))
    assert expected > 1e6
    assert found == expected


@pytest.mark.parametrize("inference", [False, True])
def test_fused_attention_hides_nothing(inference: bool, tmp_path: Path) -> None:
    visual = load_visual_tower(write_clip(tmp_path)).module.eval()
    frame = torch.randn(1, 3, 32, 32)
    slow = counted(lambda: visual(frame.clone().requires_grad_()))
    with torch.inference_mode(inference):
        assert counted(lambda: visual(frame)) == slow
    assert torch.backends.mha.get_fastpath_enabled()


def test_what_fails_leaves_fused_kernels_as_they_were() -> None:
    with pytest.raises(ZeroDivisionError):
        counted(lambda: 1 // 0)
    assert torch.backends.mha.get_fastpath_enabled()
