"""Calibrations are kept by content, read by parameters, and taken where nothing is given."""

import dataclasses
import os
from importlib.resources import files

import numpy as np
import pytest
from estimates import NAMES, made_up, make_up

import jaxevent
from jaxevent import akf, aks, high_pass, last_frame, mc
from jaxevent.calibration import calibrate, format_toml, recall_calibration, storage
from jaxevent.errors import InputError, InputWarning
from jaxevent.reconstruction import refinement
from jaxevent.recording import Events, Frames


@pytest.fixture(scope="module")
def recording():
    """The middle of a real recording, in memory."""
    return jaxevent.load(files("jaxevent") / "data/slider_depth_crop.h5")[0.6:1.0]


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """An empty cache, and nothing in memory."""
    monkeypatch.setenv("JAXEVENT_CACHE", str(tmp_path / "cache"))
    make_up(monkeypatch)
    return tmp_path / "cache" / "calibrations"


def assert_same(one, other):
    for name, value in vars(one).items():
        np.testing.assert_equal(getattr(other, name), value, err_msg=name)


def count_calibrations(monkeypatch) -> list[float]:
    """Count from now on how often `calibrate` runs."""
    runs: list[float] = []

    def counted(recording, I0, sample=None):
        runs.append(I0)
        return made_up(recording, I0)

    monkeypatch.setattr(storage, "calibrate", counted)
    return runs


def forget(monkeypatch) -> None:
    monkeypatch.setattr(storage, "_memory", type(storage._memory)())


def test_a_recording_is_calibrated_once(recording, folder, monkeypatch):
    runs = count_calibrations(monkeypatch)
    first = recall_calibration(recording)
    assert_same(first, made_up(recording))
    again = dataclasses.replace(recording, name="another name")
    assert_same(first, recall_calibration(again))
    forget(monkeypatch)  # as a new process
    assert_same(first, recall_calibration(again))
    assert runs == [1.0] and len(list(folder.iterdir())) == 1


def test_content_and_offset_tell_calibrations_apart(recording):
    events, frames = recording.events, recording.frames
    assert isinstance(events, Events) and frames is not None
    images = np.array(frames.images)
    images[3] = 255 - images[3]
    dim = Frames(frames.t, images, frames.exposure)
    others = [
        (recording, 0.3),
        (recording[0.6:0.9], 1.0),
        (recording.with_frames(slice(0, None, 2)), 1.0),
        (dataclasses.replace(recording, events=dataclasses.replace(events, p=~events.p)), 1.0),
        (dataclasses.replace(recording, frames=dim), 1.0),
        (dataclasses.replace(recording, frames=None), 1.0),
        (dataclasses.replace(recording, extra={"gain": np.full(len(frames), 2.0)}), 1.0),
    ]
    keys = {storage.hash_content(*one) for one in [(recording, 1.0), *others]}
    assert len(keys) == 1 + len(others)


class LongEvents:
    """A billion events, of which the rows that are read are counted."""

    def __init__(self):
        self.read = 0

    def __len__(self):
        return 10**9

    def __getitem__(self, rows):
        t = np.arange(*rows.indices(len(self)))
        self.read += len(t)
        return Events(t, np.zeros(len(t), np.uint16), np.zeros(len(t), np.uint16), t % 2 == 0)

    def index(self, time):
        return time


def test_few_events_of_a_long_recording_are_hashed():
    source = LongEvents()
    long = jaxevent.Recording("long", 4, 3, source)
    source.read = 0
    storage.hash_content(long, 1.0)
    assert source.read <= storage.N_EVENT_SAMPLES * storage.SAMPLE_EVENTS


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04", None])
def test_a_damaged_file_is_as_none(content, recording, folder, monkeypatch):
    first = recall_calibration(recording)
    (path,) = folder.iterdir()
    path.write_bytes(path.read_bytes()[:-40] if content is None else content)
    forget(monkeypatch)
    runs = count_calibrations(monkeypatch)
    assert_same(first, recall_calibration(recording))
    assert runs == [1.0]
    assert_same(first, storage.decode(path.read_bytes()))


def test_nothing_is_kept_where_nothing_can_be(recording, tmp_path, monkeypatch):
    first = made_up(recording)
    monkeypatch.setenv("JAXEVENT_CACHE", "0")
    assert_same(first, recall_calibration(recording))
    assert not list(tmp_path.rglob("*.kept"))
    forget(monkeypatch)
    (tmp_path / "file").touch()
    monkeypatch.setenv("JAXEVENT_CACHE", str(tmp_path / "file"))  # no folder can be made there
    assert_same(first, recall_calibration(recording))

    def full(*arguments):
        raise OSError("no space left")

    forget(monkeypatch)
    monkeypatch.setenv("JAXEVENT_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(os, "replace", full)
    assert_same(first, recall_calibration(recording))
    assert not [path for path in (tmp_path / "cache").rglob("*") if path.is_file()]


def test_the_oldest_files_are_removed(recording, folder, monkeypatch):
    monkeypatch.setattr(storage, "N_KEPT_FILES", 2)
    for I0 in (0.2, 0.4, 0.8):
        recall_calibration(recording, I0)
    kept = {path.stem for path in folder.iterdir()}
    assert kept == {storage.hash_content(recording, I0) for I0 in (0.4, 0.8)}


def test_all_fields_are_kept(recording):
    found = calibrate(recording)
    whole = dataclasses.replace(found, threshold_factors=np.ones((2, 180, 240), np.float32))
    for one in (found, whole):
        assert_same(one, storage.decode(storage.encode(one)))


def test_explicit_values_win_one_by_one(recording):
    found = made_up(recording)
    clock, on, off = (getattr(found, name).value for name in NAMES)
    for params, expected in (
        (akf.Params.for_recording(recording), (clock, on, off)),
        (akf.Params.for_recording(recording, c_on=0.3), (clock, 0.3, off)),
        (akf.Params.for_recording(recording, preset="hdr"), (clock, 0.2, 0.2)),
        (found.params(akf.Params), (clock, on, off)),
        (found.params(akf.Params, clock_offset=0.0), (0.0, on, off)),
        (mc.Params.for_recording(recording), (clock, 0.2, 0.2)),
    ):
        values = [float(getattr(params, name)) for name in NAMES]
        np.testing.assert_allclose(values, expected, rtol=1e-6)
    at_I0 = akf.Params.for_recording(recording, I0=0.3)
    assert float(at_I0.c_on) == pytest.approx(made_up(recording, 0.3).c_on.value)


def test_mc_takes_thresholds_where_events_contradict_its_own(recording, monkeypatch):
    """Four events for each make its own thresholds four times too large."""
    monkeypatch.setattr(refinement, "MIN_CHOICE_GAIN", 0.0)  # the scene is a short one
    events = recording.events[:]
    many = Events(*(np.repeat(part, 4) for part in (events.t, events.x, events.y, events.p)))
    sensitive = dataclasses.replace(recording, events=many)
    given, found = mc.Params.for_recording(sensitive), made_up(sensitive, 0.3)
    for name in ("c_on", "c_off"):  # in its own ln(I + I0), not in that of `aks`
        assert float(getattr(given, name)) == pytest.approx(getattr(found, name).value)
    assert float(mc.Params.for_recording(sensitive, c_on=0.1).c_on) == pytest.approx(0.1)


def test_estimate_calibrates_what_combines_events_and_frames(recording):
    assert aks.usual_params(recording).values() == aks.Params.for_recording(recording).values()
    video = aks.estimate(recording, progress=False)
    assert video.params.values() == aks.usual_params(recording).values()
    for method in (high_pass, last_frame):
        assert method.names_left_open({}) == ()
        assert method.usual_params(recording).values() == method.Params().values()
    alone = recording.with_frames(slice(0, 1))
    assert akf.usual_params(alone).values() == akf.Params().values()
    with pytest.raises(InputError, match="no frames"):
        mc.usual_params(dataclasses.replace(recording, frames=None))


def test_a_file_of_a_calibration_serves_methods(recording, tmp_path):
    found = made_up(recording)
    path = tmp_path / "calibration.toml"
    text = format_toml(found, 1.0, "a\nb")
    path.write_text(text)
    for method in (akf, aks):
        assert method.Params.load(path).values() == found.params(method.Params).values()
    assert mc.Params.load(path).values() == found.params(mc.Params).values()  # of another I0
    path.write_text("c_on = 0.3\n" + text)
    assert akf.Params.load(path).values() == found.params(akf.Params, c_on=0.3).values()
    path.write_text(text + "[akf]\nkappa = 3.0\n[aks]\nshare = 0.1\n")
    assert akf.Params.load(path, "akf").values() == found.params(akf.Params, kappa=3.0).values()
    assert mc.Params.load(path, "mc").values() == found.params(mc.Params).values()
    numbers = {"akf": {"clock_offset": 0.02, "c_on": 0.4}}
    path.write_text(format_toml(found, 1.0, "a", numbers))
    expected = found.params(akf.Params, **numbers["akf"])
    assert akf.Params.load(path, "akf").values() == expected.values()
    path.write_text("I0 = 0.3\n" + text)
    with pytest.warns(InputWarning, match="hold for I0 = 1, not for 0.3.*calibrate --I0 0.3"):
        params = akf.Params.load(path)
    clock = found.clock_offset.value
    assert params.values() == akf.Params(I0=0.3, clock_offset=clock).values()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("calibration = 3\n", "calibration is '3'; give the table"),
        ("[calibration]\nc_on = -1.0\n", "c_on is -1.0"),
        ('[calibration]\nI0 = "one"\nc_on = 0.1\n', "I0 is 'one'"),
    ],
)
def test_bad_calibrations_are_refused(text, said, tmp_path):
    path = tmp_path / "bad.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=f"bad.toml: .*{said}"):
        akf.Params.load(path)


def test_methods_without_clock_refuse_a_calibration(tmp_path):
    path = tmp_path / "calibration.toml"
    path.write_text("[calibration]\nclock_offset = 0.1\n")
    with pytest.raises(InputError, match="no clock or thresholds"):
        jaxevent.METHODS["moment"].Params.load(path)
