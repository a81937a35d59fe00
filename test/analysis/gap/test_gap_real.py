"""The diagnosis on measured recordings that no simulator of ours produced."""

import gzip
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat

from asi_analysis.bags.run import Run
from asi_analysis.gap.answer.export import write_export
from asi_analysis.gap.diagnose import diagnose
from asi_analysis.gap.document import document

DATA = Path(os.environ.get('ASI_DATA', Path(__file__).parents[4] / 'shared' / 'data'))
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason=f'no measured recordings at {DATA}')
SERVO = {'signals': {'reference': 'm'}}


def emps(name: str) -> Run:
    """Return a recording of the prismatic joint: force N, position m."""
    data = loadmat(DATA / 'emps' / name)
    return Run(data['t'].ravel(), command_n=(data['gtau'] * data['vir']).ravel(),
               position_m=data['qm'].ravel(), source=name)


def cut(run: Run, start: float, end: float) -> Run:
    """Return the part of a recording between two shares of its length."""
    part = run.between(start * run.duration_s, end * run.duration_s)
    return replace(part, time_s=part.time_s - part.time_s[0])


def press(name: str) -> Run:
    """Return a recording of the press: commanded and measured displacement m."""
    with gzip.open(DATA / 'servohydraulic_mts' / name, 'rt') as file:
        rows = np.array([[float(cell) for cell in line.split(',')[2:5]]
                         for line in file.read().splitlines()[7:]])
    rows -= rows[:1000].mean(axis=0)
    return Run(np.arange(len(rows)) * 1e-3, reference_n=rows[:, 2] / 100.0,
               position_m=rows[:, 0] / 100.0, force_n=rows[:, 1] * 9806.65, source=name,
               information=SERVO)


@pytest.mark.slow
@needs_data
def test_joint_with_coulomb_friction(tmp_path):
    runs = [emps('DATA_EMPS.mat'), emps('DATA_EMPS_PULSES.mat')]
    diagnosis = diagnose(runs, {}, 'joint', held_out=[False, True])
    answer = document(diagnosis)
    named = [row['effect'] for row in answer['which']]
    assert named[0] == 'coulomb_friction'
    assert named[1] == 'friction_asymmetry'
    assert 'stiction' not in answer['verdict']
    alone = diagnosis.groups[0].candidates[('coulomb_friction',)].fitted.values
    # Janot, Gautier, Brunot 2019.
    assert alone['load_mass'] == pytest.approx(95.109, rel=0.01)
    assert alone['load_damping'] == pytest.approx(203.50, rel=0.01)
    assert alone['friction_level'] == pytest.approx(20.394, rel=0.01)
    assert answer['gap']['before_nrmse'] == pytest.approx(0.17, abs=0.01)
    assert answer['gap']['after_nrmse'] < 0.054
    row = write_export(diagnosis, None, tmp_path / 'emps.xml')
    assert ['asymmetry of the viscous friction' in each for each in row['unsaid']] == [True]
    if row['simulator']:
        assert row['after_nrmse'] < 0.055 < 0.12 < row['before_nrmse']


@needs_data
@pytest.mark.slow
def test_press_with_lag_and_dead_time(tmp_path):
    runs = [press(f'actuator_chirp_damper_{current}.txt.gz') for current in ('0A', '1A')]
    diagnosis = diagnose(runs, {}, 'joint', held_out=[False, True])
    answer = document(diagnosis)
    assert answer['verdict'] == 'transport_delay+valve_lag'
    assert answer['gap']['before_nrmse'] > 1.0
    assert answer['gap']['after_nrmse'] < 0.05
    row = write_export(diagnosis, None, tmp_path / 'press.xml')
    assert row['unsaid'] == []
    if row['simulator']:
        assert row['after_nrmse'] < 0.05 < 1.0 < row['before_nrmse']
