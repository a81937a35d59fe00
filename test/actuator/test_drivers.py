"""Drivers are entry points: those of the package, and those that another package adds."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import ROOT

from asi_actuator.driver import make_driver
from asi_actuator.driver.simulated import SimulatedActuator
from asi_actuator.node_parameters import ACTUATOR_NODE_PARAMETERS, DRIVERS
from asi_actuator.parameters import ACTUATOR_PARAMETERS
from asi_common.parameter import ParameterError, defaults

VALUES = defaults(ACTUATOR_NODE_PARAMETERS + ACTUATOR_PARAMETERS)
MAKE = """
import sys
from asi_actuator.driver import make_driver
from asi_actuator.node_parameters import ACTUATOR_NODE_PARAMETERS
from asi_common.parameter import ParameterError, completed
try:
    values = completed({'driver': sys.argv[1]}, ACTUATOR_NODE_PARAMETERS)
    print(type(make_driver(values, 0.001)).__name__)
except ParameterError as error:
    print(error)
"""


def test_drivers_of_this_package_can_be_imported() -> None:
    assert {'simulated', 'can', 'replay'} <= set(DRIVERS)
    for entry in DRIVERS.values():
        assert callable(entry.load())
    assert isinstance(make_driver(VALUES, 0.001), SimulatedActuator)


@pytest.fixture
def other_package(tmp_path: Path) -> Path:
    """Return a folder with an installed package that adds two drivers, one of them broken."""
    (tmp_path / 'press.py').write_text(
        'class Press:\n    def __init__(self, values, period_s):\n        pass\n')
    information = tmp_path / 'press-1.0.dist-info'
    information.mkdir()
    (information / 'METADATA').write_text('Metadata-Version: 2.1\nName: press\nVersion: 1.0\n')
    (information / 'entry_points.txt').write_text(
        '[asi_actuator.drivers]\npress = press:Press\nbroken = press:Nothing\n')
    return tmp_path


@pytest.mark.parametrize(('driver', 'answer'), [
    ('press', 'Press'),
    ('broken', "driver = 'broken' cannot be imported from press:Nothing"),
    ('pigeon', "driver = 'pigeon' is not allowed: it takes one of broken, can, press, replay")])
def test_another_package_adds_a_driver(other_package: Path, driver: str, answer: str) -> None:
    result = subprocess.run(
        [sys.executable, '-c', MAKE, driver], capture_output=True, text=True,
        env={**os.environ, 'PYTHONPATH': f'{other_package}{os.pathsep}{ROOT}'})
    assert result.stdout.startswith(answer), result.stdout + result.stderr


def test_driver_that_is_not_installed_is_refused_by_name() -> None:
    with pytest.raises(ParameterError, match='there are .*simulated'):
        make_driver(VALUES | {'driver': 'pigeon'}, 0.001)
