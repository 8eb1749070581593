"""Data sets: the record refuses what does not fit together; all readers by name and with options."""

import dataclasses

import numpy as np
import pytest
from recordings import BONN, MRCLAM, VICTORIA, assert_noises, write

from jaxslam import datasets

# Readers of the small data sets, by a folder.
SMALL = {
    "victoria_park": (
        VICTORIA,
        lambda path, **options: datasets.victoria_park(path / "victoria_park.txt", **options),
    ),
    "bonn": (BONN, datasets.bonn),
    "mrclam": (MRCLAM, lambda path, **options: datasets.mrclam(path, 2, **options)),
}


def test_a_data_set_that_does_not_fit_together_is_refused(tmp_path):
    data = SMALL["victoria_park"][1](write(tmp_path, VICTORIA))
    with pytest.raises(ValueError, match=r"time: expected shape \(3,\), got \(2,\)"):
        dataclasses.replace(data, time=np.zeros(2))
    with pytest.raises(ValueError, match="not below the capacity 1"):
        dataclasses.replace(data, tags=(5,))
    with pytest.raises(ValueError, match=r"landmarks: expected shape \(2, 2\)"):
        dataclasses.replace(data, landmarks=np.zeros((3, 2)))
    twice = data.log.scan._replace(tag=np.zeros((3, 2), np.int32), valid=np.ones((3, 2), bool))
    with pytest.raises(ValueError, match="repeats"):
        dataclasses.replace(data, log=data.log._replace(scan=twice))


@pytest.mark.parametrize("name", SMALL)
def test_noise_can_be_replaced(tmp_path, name):
    files, read = SMALL[name]
    noises = (3 * np.eye(2 if name == "mrclam" else 3), 2 * np.eye(2))
    data = read(write(tmp_path, files))
    models = (data.motion, data.sensor)
    moved, seen = (
        dataclasses.replace(model, noise_cov=cov) for model, cov in zip(models, noises, strict=True)
    )
    assert_noises(dataclasses.replace(data, motion=moved, sensor=seen), *noises)


@pytest.mark.parametrize(
    ("name", "file"), [(name, file) for name, (files, _) in SMALL.items() for file in files]
)
def test_a_missing_file_is_named(tmp_path, name, file):
    files, read = SMALL[name]
    (write(tmp_path, files) / file).unlink()
    with pytest.raises(ValueError, match=f"{file}: cannot be read"):
        read(tmp_path)


@pytest.mark.parametrize(
    ("files", "name", "old", "new", "read", "message"),
    [
        (BONN, "sensor_data.dat", "SENSOR", "#", datasets.bonn, r"sensor_data.dat:8: no measurement is left, of 1 negative ranges"),
        (MRCLAM, "Robot2_Measurement.dat", " 7", " 9", lambda path: datasets.mrclam(path, 2), r"Measurement.dat:1: no measurement is left, of 2 robot sightings, 6 unknown barcodes"),
    ],
)  # fmt: skip
def test_measurements_that_are_all_left_out_are_said(
    tmp_path, files, name, old, new, read, message
):
    text = files[name].replace(old, new)
    if new == "#":
        text = "ODOMETRY 0 1 0\n" * 7 + "SENSOR 4 -0.25 1"
    with pytest.raises(ValueError, match=message):
        read(write(tmp_path, files, name, text))


def test_readers_by_name(tmp_path):
    first = {name.replace("2", "1"): text for name, text in MRCLAM.items()}
    both = write(tmp_path, VICTORIA | BONN | MRCLAM | first)
    file = both / "victoria_park.txt"
    for name, arguments, named in (
        ("victoria_park", [file], "victoria_park"),
        ("bonn", [str(both)], "bonn"),
        ("mrclam", [both], "mrclam robot 1"),
        ("mrclam", [both, 2], "mrclam robot 2"),
    ):
        data = datasets.READERS[name](*arguments)
        assert data.name == named and data.source and type(data) is datasets.Dataset
