"""Z-width: of an ideal actuator with a damper it is known."""

import numpy as np
import pytest
from test_tuning import IDEAL

from asi_analysis.tuning.compare import Comparison
from asi_analysis.tuning.z_width import z_width

DAMPER = IDEAL | {'hydraulic_damping.model': 'linear', 'hydraulic_damping.linear_gain': 500.0}


def test_a_gain_divides_the_impedance_of_a_damper():
    """500 N s/m over 1 + gain: the range from gain 0.1 to 0.5 is 1.5 / 1.1."""
    found = z_width(DAMPER, {'gain': 0.2, 'feedforward': 0.0}, [0.5, 2.5], 5000.0)
    assert all(each['passive'] for each in found)
    for factor, gain in ((0.5, 0.1), (2.5, 0.5)):
        sizes = [each['size_n_s_m'] for each in found if each['factor'] == factor]
        assert sizes[:4] == pytest.approx([500.0 / (1.0 + gain)] * 4, rel=0.01)
    assert [each['width_db'] for each in found[:4]] == pytest.approx(
        [20.0 * np.log10(1.5 / 1.1)] * 4, rel=0.05)


def test_what_pushes_along_is_not_passive_and_has_no_width():
    pushing = {'gain': 0.2, 'velocity_feedforward.share': 0.5}   # 725 N s/m of 500
    found = z_width(DAMPER, pushing, [1.0], 5000.0)
    assert not found[0]['passive'] and found[0]['least_re_z_n_s_m'] < 0.0
    assert found[0]['width_db'] is None


def test_table_has_a_row_for_each_gain_and_the_width():
    found = [{'controller': 'P', 'factor': factor, 'least_re_z_n_s_m': least, 'size_n_s_m': size,
              'width_db': 0.0} for factor, least, size in ((1.0, 5.0, 500.0), (2.0, -1.0, 300.0))
             for _ in range(7)]
    compared = Comparison({'figures': [], 'recordings': [], 'rates_hz': [5000.0],
                           'controllers': ['P'], 'z_width': found})
    table, = compared.tables('{} *')
    assert [row[:4] for row in table.rows] == [
        ['P', '1', '5', '500'], ['P', '2', '-1', '300'], ['P', 'Z-width, dB', '', '0']]
    assert {len(row) for row in table.rows} == {len(table.columns)} == {10}
