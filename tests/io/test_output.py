"""Files that jaxevent writes: their description, and images compressed as HDF5 reads them."""

import hashlib
import math
import os
import shlex
import time
import tomllib

import h5py
import numpy as np
import pytest
from commands import described
from hypothesis import given
from hypothesis import strategies as st
from noise import STAMPS, small

import jaxevent
from jaxevent import cli
from jaxevent.io import output, toml
from jaxevent.io.output import Command, deflate_shuffled
from jaxevent.recording import Imu, Poses, Triggers

words = st.text(st.characters(exclude_categories=["Cs"]))
numbers = st.integers(-(2**63), 2**63 - 1) | st.floats() | st.booleans()
values = st.recursive(
    words | numbers, lambda inner: st.lists(inner) | st.dictionaries(words, inner), max_leaves=8
)


def same(one, other) -> bool:
    """Equality to the type and the sign of zero, for which NaN is NaN."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[k], other[k]) for k in one)
    if isinstance(one, list):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, float) and isinstance(other, float):
        both = math.isnan(one) and math.isnan(other)
        return both or (one == other and math.copysign(1, one) == math.copysign(1, other))
    return type(one) is type(other) and one == other


@given(words.filter(bool), values)
def test_what_is_written_as_toml_is_read_by_tomllib(name, value):
    assert same(tomllib.loads(f"{toml.key(name)} = {toml.text(value)}"), {name: value})


def test_parameters_of_every_method_survive_toml():
    for kind in {estimator.Params for estimator in jaxevent.METHODS.values()}:
        params = kind()
        read = kind.of(tomllib.loads(toml.parameters(params))).values()
        for key, value in params.values().items():
            wanted = pytest.approx(value, rel=1e-6) if key in params.numbers else value
            assert read[key] == wanted, (kind, key)


def whole():
    """A recording with all that a recording may hold."""
    n, ones = len(STAMPS), np.ones((len(STAMPS), 3))
    quaternion = np.tile([0.0, 0, 0, 1], (n, 1))
    return small(
        poses=Poses(STAMPS, ones, quaternion),
        imu=Imu(STAMPS, ones, ones),
        triggers=Triggers(STAMPS, np.zeros(n, np.int8), np.zeros(n, np.uint8)),
        extra={"gain": np.ones(n), "hdr_t": STAMPS},
    )


def test_a_command_writes_the_same_bytes_and_says_which_it_is(tmp_path):
    source, out = tmp_path / "it's.h5", tmp_path / "out.h5"
    jaxevent.save(whole(), source)
    argv = ["convert", str(source), str(out), "--compression", "gzip", "--force"]
    stored = []
    for _ in range(2):
        assert cli.main(argv) == 0
        stored.append(out.read_bytes())
        time.sleep(1.01 - time.time() % 1)  # dates in HDF5 are whole seconds
    assert stored[0] == stored[1]
    told = described(out)
    assert told["jaxevent_version"] == jaxevent.__version__
    assert shlex.split(told["command"]) == ["jaxevent", *argv]
    data = source.read_bytes()
    about = {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    assert told["inputs"] == {str(source): about}
    assert jaxevent.load(out).extra.keys() == {"gain", "hdr_t"}


def test_what_python_writes_says_the_version_alone(tmp_path):
    path = tmp_path / "a.h5"
    jaxevent.save(whole(), path)
    assert "jaxevent_version" in described(path)
    assert not {"command", "inputs", "method", "params"} & set(described(path))
    # Nothing of a command is left when it has ended, badly or well.
    with pytest.raises(KeyError), output.running(Command(["jaxevent"], [])):
        jaxevent.save(whole(), path)
        assert described(path)["command"] == "jaxevent" and described(path)["inputs"] == {}
        raise KeyError
    jaxevent.save(whole(), path)
    assert "command" not in described(path)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.float32])
def test_images_tell_their_white(tmp_path, kind):
    white = 1 if kind is np.float32 else np.iinfo(kind).max
    frames = jaxevent.Frames(STAMPS, np.zeros((6, 20, 24), kind), 0 * STAMPS)
    jaxevent.save(small(frames=frames), tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5") as file:
        assert file["frames/images"].attrs["unit"] == f"levels: 0 black, {white} white"


def test_inputs_of_each_kind(tmp_path, monkeypatch):
    """A folder by its names and sizes, a large file by its size, others without being read."""
    folder = tmp_path / "folder"
    (folder / "sub").mkdir(parents=True)
    for name, data in (
        ("b", b"12"),
        ("a", b"123"),
        ("sub/c", b""),
        (".out.h5.0123456789ab.part", b"1"),
    ):
        (folder / name).write_bytes(data)
    (tmp_path / "large").write_bytes(bytes(11))
    (tmp_path / "small").write_bytes(bytes(10))
    os.mkfifo(tmp_path / "pipe")  # to open it would wait for ever
    monkeypatch.setattr(output, "_MAX_HASHED_BYTES", 10)
    names = ["folder", "large", "small", "pipe", "gone", os.fsdecode(b"\xff")]
    told = tomllib.loads(
        Command(["jaxevent"], [tmp_path / name for name in names]).described_inputs
    )
    told = {name.rpartition("/")[2]: about for name, about in told.items()}
    listed = hashlib.sha256(b"a\t3\nb\t2\nsub/c\t0\n").hexdigest()
    assert told["folder"] == {"files": 3, "bytes": 5, "sha256_names_sizes": listed}
    assert told["large"] == {"bytes": 11, "note": "no sha256: larger than 2 GB"}
    assert told["small"] == {"bytes": 10, "sha256": hashlib.sha256(bytes(10)).hexdigest()}
    assert told["pipe"] == {"note": "neither a file nor a folder"}
    assert told["gone"] == told["\\xff"] == {"note": "neither a file nor a folder"}


@pytest.mark.parametrize("kind", ["<f4", "<f8"])
def test_hdf5_reads_chunks_as_they_were(tmp_path, kind):
    rng = np.random.default_rng(0)
    images = np.empty((5, 70, 61), kind)
    images[0], images[1] = rng.normal(size=(2, 70, 61))
    images[2] = np.nan
    images[3] = np.rint(10 * images[0]) / 8  # whose mantissas are short
    images[4] = np.where(rng.random((70, 61)) < 0.5, -np.inf, 1e-30)
    chunks = [deflate_shuffled(image) for image in images]
    assert len(chunks[2]) < 600 and len(chunks[3]) < images[3].nbytes / 2
    with h5py.File(tmp_path / "a.h5", "w") as file:
        options = {"compression": "gzip", "shuffle": True, "chunks": (1, 70, 61)}
        stored = file.create_dataset("images", images.shape, kind, **options)
        for row, chunk in enumerate(chunks):
            stored.id.write_direct_chunk((row, 0, 0), chunk)
    with h5py.File(tmp_path / "a.h5") as file:
        stored = file["images"]
        assert isinstance(stored, h5py.Dataset)
        np.testing.assert_array_equal(stored[()], images)


def test_a_single_number(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        options = {"compression": "gzip", "shuffle": True, "chunks": (1,)}
        stored = file.create_dataset("one", (1,), "<f4", **options)
        stored.id.write_direct_chunk((0,), deflate_shuffled(np.full(1, 0.3, np.float32)))
        assert stored[0] == np.float32(0.3)
