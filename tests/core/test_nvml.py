"""NVML's counters, by a stand-in for the driver's library."""

from __future__ import annotations

import ctypes

import pytest

from terrella.core import nvml


class Driver:
    """Has one GPU; `missing`: a function that it lacks; `failing`: one that reports an error."""

    def __init__(self, missing: str = "", failing: str = ""):
        self.missing, self.failing, self.calls = missing, failing, 0

    def __getattr__(self, name: str):
        if name == self.missing:
            raise AttributeError(name)

        def call(*given) -> int:
            self.calls += 1
            if name == "nvmlDeviceGetTotalEnergyConsumption":
                given[1]._obj.value = 1000 * self.calls
            if name == "nvmlDeviceGetUtilizationRates":
                given[1]._obj.gpu, given[1]._obj.memory = 87, 12
            return 3 if name == self.failing else 0

        return call


def test_counters_are_read_anew(monkeypatch):
    monkeypatch.setattr(ctypes, "CDLL", lambda name: Driver())
    energy, busy = nvml.energy_mj(), nvml.busy_percent()
    assert energy is not None and busy is not None
    assert energy() < energy() and busy() == 87


@pytest.mark.parametrize(
    "driver",
    [
        Driver(missing="nvmlDeviceGetUtilizationRates"),
        Driver(failing="nvmlDeviceGetUtilizationRates"),
        Driver(failing="nvmlInit_v2"),
        Driver(failing="nvmlDeviceGetHandleByIndex_v2"),
    ],
)
def test_a_driver_without_the_counter_has_none(driver, monkeypatch):
    monkeypatch.setattr(ctypes, "CDLL", lambda name: driver)
    assert nvml.busy_percent() is None


def test_without_a_driver_there_are_none(monkeypatch):
    monkeypatch.setattr(nvml, "LIBRARY", "libnone-such.so")
    assert nvml.busy_percent() is None and nvml.energy_mj() is None
