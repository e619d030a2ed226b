"""Chunks that are compressed here, read by HDF5."""

import h5py
import numpy as np
import pytest

from jaxevent.io.output import deflate_shuffled


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
