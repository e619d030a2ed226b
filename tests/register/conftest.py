"""Simulated rigs: rendering them takes seconds, so they are made once."""

import dataclasses

import pytest
from rigs import RIGS

from jaxevent.simulate import SENSORS


@pytest.fixture(scope="session")
def near():
    return RIGS["near_rig"](0, 0.5, 1.5, 2)


@pytest.fixture(scope="session")
def far():
    sensor = dataclasses.replace(SENSORS["davis"], exposure_samples=2)
    return RIGS["far_rig"](0, "lake", "slow", (96, 72), (128, 96), 0.7, sensor)
