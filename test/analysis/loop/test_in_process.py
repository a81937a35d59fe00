"""A run without nodes: in pieces and as a whole the same, and complete after Ctrl-C."""

import resource
from pathlib import Path

import pytest

import asi_analysis as asi
from asi_analysis.errors import InputWarning
from asi_analysis.experiments.experiment import planned
from asi_analysis.loop import in_process

NOISY = {'force_sensor.noise': 1.0, 'load.type': 'prescribed', 'load.velocity': 0.1,
         'load.frequency': 5.0}
SINE = {'reference.shape': 'sine', 'reference.amplitude': 80.0}


def test_pieces_are_the_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # 333.3 control periods: the node takes 334.
    whole = asi.simulate(NOISY, SINE, 0.1, 3333.0, out=tmp_path / 'whole')
    assert len(whole) == 334 == whole.information['experiment']['ticks']
    monkeypatch.setattr(in_process, 'PIECE', 137)
    asi.simulate(NOISY, SINE, 0.1, 3333.0, out=tmp_path / 'pieces')
    for file in ('bag_0.mcap', 'metadata.yaml'):
        assert (tmp_path / 'whole/bag' / file).read_bytes() == (
            tmp_path / 'pieces/bag' / file).read_bytes()
    assert (whole.force_n == asi.simulate(NOISY, SINE, 0.1, 3333.0).force_n).all()


def test_after_ctrl_c_the_bag_so_far_is_complete(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(in_process, 'PIECE', 100)

    def interrupt(text: str, share: float | None) -> None:
        if share is not None and share > 0.3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        in_process.run_in_process(planned({}, {}, 0.2, 'lockstep', 5000.0), tmp_path / 'run',
                                  interrupt)
    with pytest.warns(InputWarning, match='600 of the 1000 samples') as told:
        assert len(asi.read_bag(tmp_path / 'run/bag')) == 400
    assert len(told) == 1


def test_a_full_disk_is_told_with_the_bag(tmp_path: Path) -> None:
    asi.simulate({}, {}, 0.01, out=tmp_path / 'first')     # compiles, before files are limited
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, before[1]))
    try:
        with pytest.raises(OSError, match='too large') as told:
            in_process.run_in_process(planned({}, {}, 0.5, 'lockstep', 5000.0), tmp_path / 'run')
        assert told.value.filename == str(tmp_path / 'run/bag')
        with pytest.raises(OSError, match='too large') as told:
            asi.write_bag(asi.simulate({}, {}, 0.5), tmp_path / 'bag')
        assert told.value.filename == str(tmp_path / 'bag')
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    with pytest.warns(InputWarning):
        assert len(asi.read_bag(tmp_path / 'run/bag')) > 100
