"""Golden test of the bytes on SPI and I2C: open, aim, press, close, kill."""

import shutil

import pytest

from tests.golden import bus, compare


@pytest.mark.skipif(shutil.which("umockdev-wrapper") is None, reason="umockdev is not installed: make buses")
def test_the_bytes_on_the_buses_are_as_recorded() -> None:
    difference = compare.difference(compare.read("bus"), bus.present())
    assert not difference, difference
