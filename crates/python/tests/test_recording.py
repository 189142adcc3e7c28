"""Recordings as numpy arrays, compared with what an independent reader of MCAP files finds and with the program."""

import csv
import io

import numpy as np
import pytest
import squealcast
from conftest import ROOT

RAMP = ROOT / "recordings/ramp"


def test_a_recorded_session_is_read_whole():
    recording = squealcast.Recording(RAMP)
    assert recording.damage == [] and recording.unread == [] and len(recording.files) == 1
    inputs, predictions = recording.inputs(), recording.predictions()
    assert len(inputs["seq"]) > 100 and (np.diff(inputs["seq"].astype(int)) == 1).all()
    assert (np.diff(inputs["stamp_ns"]) > 0).all()
    assert set(predictions["input_seq"]) <= set(inputs["seq"])
    rig = recording.rig()
    assert rig.content_hash and repr(rig).startswith("Rig('")
    kinds = recording.session_events()["kind"]
    assert "StabilityMap" in kinds


def test_a_recorded_session_is_predicted_again():
    """Frequencies and growth rates that were recorded, from the rig in the recording, within their recorded bounds."""
    recording = squealcast.Recording(RAMP)
    inputs, recorded = recording.inputs(), recording.predictions()
    of_input = {seq: k for k, seq in enumerate(inputs["seq"])}
    rows = np.array([of_input[seq] for seq in recorded["input_seq"]])
    chosen = np.flatnonzero((recorded["level"] != squealcast.Level.FAULT) & ~recorded["reused"])[::25]
    at = rows[chosen]
    found = recording.rig().predict(load_n=inputs["load_n"][at], speed_rad_s=inputs["speed_rad_s"][at], mu=inputs["mu"][at])
    width = recorded["mode_id"].shape[1]
    assert found.mode_id.shape == (len(chosen), width) and len(chosen) > 3
    for name in ("frequency", "growth_rate"):
        unit = "_hz" if name == "frequency" else "_per_s"
        mine, theirs = getattr(found, name + unit), recorded[name + unit][chosen]
        bounds = getattr(found, f"{name}_error{unit}") + recorded[f"{name}_error{unit}"][chosen]
        assert (np.abs(mine - theirs) <= bounds + 1e-12 * np.abs(theirs)).all(), name


def test_events_are_those_of_the_report(tmp_path, program):
    program("report", RAMP, "-o", tmp_path)
    rows = list(csv.DictReader(io.StringIO((tmp_path / "events.csv").read_text())))
    events = squealcast.Recording(RAMP).events()
    assert list(events) == list(rows[0]) and len(events["kind"]) == len(rows) > 0
    assert events["kind"].tolist() == [row["kind"] for row in rows]
    assert events["peak_growth_rate_per_s"][0] == float(rows[0]["peak_growth_rate_per_s"] or "nan")


def test_an_independent_reader_finds_the_same_messages():
    reader = pytest.importorskip("mcap.reader")
    counts = {}
    for file in squealcast.Recording(RAMP).files:
        with open(file, "rb") as stream:
            for _, channel, message in reader.make_reader(stream).iter_messages():
                counts.setdefault(channel.topic, []).append(message.log_time)
    recording = squealcast.Recording(RAMP)
    assert recording.inputs()["log_time_ns"].tolist() == counts["/rig/operating_point"]
    assert recording.predictions()["log_time_ns"].tolist() == counts["/squealcast/prediction"]


def test_sound_vibration_and_squeals(tmp_path, program):
    program("simulate", "--record", tmp_path / "made", "--rig", "nine-dof-case-2", "--vibration", "0.2:440")
    (session,) = (tmp_path / "made").iterdir()
    recording = squealcast.Recording(session)
    vibration = recording.vibration()
    assert len(vibration["frequency_hz"]) > 0 and (vibration["frequency_hz"] > 0.0).all()
    assert recording.heard()["number"].shape == (0,) and recording.waveforms() == {}
    assert recording.temperatures()["temperature_c"].shape == (0,)


def test_tables_for_pandas():
    pandas = pytest.importorskip("pandas")
    recording = squealcast.Recording(RAMP)
    frame = recording.to_pandas("inputs")
    assert list(frame.columns) == ["log_time_ns", "seq", "load_n", "speed_rad_s", "mu"]
    assert isinstance(frame.index, pandas.DatetimeIndex) and frame.index.name == "stamp"
    assert frame.index.asi8[0] == recording.inputs()["stamp_ns"][0] or frame.index.unit != "ns"
    assert "frequency_hz_0" in recording.to_pandas("predictions")


def test_what_is_no_recording_is_refused_with_the_program_s_text(tmp_path, program):
    (tmp_path / "text.mcap").write_text("not a recording")
    for path in [tmp_path, tmp_path / "text.mcap", tmp_path / "missing"]:
        with pytest.raises(squealcast.RecordingError) as raised:
            squealcast.Recording(path)
        assert f"error: {raised.value}" == program("report", path, "-o", tmp_path / "report")
