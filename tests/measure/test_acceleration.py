"""Joules are those of the processors alone, also where their counters begin again."""

from __future__ import annotations

from terrella.measure import acceleration


def test_joules_of_counters_that_begin_again_and_of_no_machine_as_a_whole(tmp_path, monkeypatch):
    monkeypatch.setattr(acceleration, "POWERCAP", tmp_path)
    for at, name in enumerate(("package-0", "package-1", "psys")):
        folder = tmp_path / f"intel-rapl:{at}"
        folder.mkdir()
        for file, text in (("name", name), ("energy_uj", "9000000"), ("max_energy_range_uj", "9999999")):
            (folder / file).write_text(f"{text}\n")
    meter = acceleration.EnergyMeter()
    assert meter.how.startswith("RAPL") and meter.joules() == 0
    (tmp_path / "intel-rapl:0" / "energy_uj").write_text("2000000")  # over its end
    (tmp_path / "intel-rapl:1" / "energy_uj").write_text("9500000")
    (tmp_path / "intel-rapl:2" / "energy_uj").write_text("9900000")
    assert meter.joules() == 3.5
    (tmp_path / "intel-rapl:0" / "name").unlink()
    (tmp_path / "intel-rapl:1" / "name").unlink()
    assert acceleration.EnergyMeter().how.startswith("estimated")
