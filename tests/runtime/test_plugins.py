"""Execution providers that plug into ONNX Runtime: found with their hardware, never claimed without it."""

from __future__ import annotations

import pytest

from dior_rt.bundle import default_bundle, read_bundle
from dior_rt.devices import survey_network
from dior_rt.engine import open_engine
from dior_rt.errors import DeviceError
from dior_rt.plugins import PACKAGES, is_installed, plugin_devices
from dior_rt.providers import accelerators, available, is_built_in


@pytest.mark.parametrize("name", PACKAGES)
def test_a_plugin_is_listed_and_self_tested_or_says_why_not(name: str) -> None:
    survey = survey_network(read_bundle(default_bundle()))
    listed = {device.name: device for device in survey.devices}
    assert (name in listed) == (is_installed(name) or is_built_in(name))
    if name not in available():
        assert name not in {device.partition(":")[0] for device in accelerators()}
        assert name not in listed or "no hardware" in str(listed[name].problem)
        with pytest.raises(DeviceError, match="There is no device"):
            open_engine(read_bundle(default_bundle()), "velocity", name)
    elif listed[name].problem is None:
        assert open_engine(read_bundle(default_bundle()), "velocity", name).device == name


def test_no_hardware_is_claimed_that_is_not_there() -> None:
    assert plugin_devices("no such plug-in") == []
    for name in PACKAGES:
        assert plugin_devices(name, "999") == []
    assert available()[-1] == "cpu"
