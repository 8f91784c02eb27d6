"""What the number format `auto` stands for, by what the device can do."""

from __future__ import annotations

import pytest
import torch

from pipeline.core.runtime import name_dtype, resolve_dtype


def flags() -> set[str]:
    """What the processor says it can do, by Linux."""
    try:
        with open("/proc/cpuinfo") as file:
            return {flag for line in file if line.startswith("flags") for flag in line.split()}
    except OSError:
        pytest.skip("needs /proc/cpuinfo")


def test_on_a_processor_it_follows_its_instructions() -> None:
    expected = "bfloat16" if flags() & {"avx512_bf16", "amx_bf16"} else "float32"
    assert name_dtype("auto", "cpu") == expected


@pytest.mark.parametrize(
    ("avx", "amx", "name"), [(False, False, "float32"), (True, False, "bfloat16"), (False, True, "bfloat16")]
)
def test_either_instruction_set_will_do(avx: bool, amx: bool, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: avx)
    monkeypatch.setattr(torch.cpu, "_is_amx_tile_supported", lambda: amx)
    assert name_dtype("auto", "cpu") == name


@pytest.mark.parametrize("capable", [True, False])
def test_on_a_card_it_follows_the_card(capable: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation: capable)
    assert name_dtype("auto") == name_dtype("auto", "cuda") == ("bfloat16" if capable else "float32")
    assert resolve_dtype("auto") is getattr(torch, name_dtype("auto"))
