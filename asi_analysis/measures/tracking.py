"""Tracking of the reference, effort of the command, and the force that a moved joint feels."""

from typing import NamedTuple

import numpy as np

from asi_analysis.arrays import Array
from asi_analysis.bags.run import Run
from asi_analysis.measures.frequency_response import is_sine
from asi_analysis.measures.oscillation import amplitude_at


class Tracking(NamedTuple):
    """
    Errors over the whole run, in the unit of the controlled signal; None if not recorded.

    tracking_error_percent: of the rms of the reference about its mean; None if it is constant.
    impedance_real, impedance_imaginary: of force over velocity (N s/m) at `impedance_hz`, of a run
    whose reference is constant while a single sine moves the piston; the force against the motion
    counts as positive, so that a real part below 0 is not passive (Colgate, Hogan, "Robust control
    of dynamically interacting systems", Int. J. Control 48, 1988).
    """

    tracking_error_rms_n: float | None = None
    tracking_error_peak_n: float | None = None
    tracking_error_percent: float | None = None
    command_rms_n: float | None = None
    impedance_hz: float | None = None
    impedance_real: float | None = None
    impedance_imaginary: float | None = None


def tracking(run: Run, name: str | None = None) -> Tracking:
    """Return how well a run follows its reference, and what that takes; name: of the output."""
    command = None if run.command_n is None else _rms(run.command_n)
    output = run.followed(name)
    if run.reference_n is None or output is None:
        return Tracking(command_rms_n=command)
    known = np.isfinite(run.reference_n) & np.isfinite(output)
    if not known.any():
        return Tracking(command_rms_n=command)
    reference, error = run.reference_n[known], (run.reference_n - output)[known]
    rms, moved = float(np.sqrt(np.mean(error ** 2))), float(np.std(reference))
    constant = moved < 1e-9 * max(float(np.abs(reference).max()), 1.0)
    found = Tracking(rms, float(np.abs(error).max()), None if constant else 100.0 * rms / moved,
                     command)
    return found._replace(**_impedance(run)) if constant else found


def _rms(values: Array) -> float | None:
    """Return the rms of the samples that are not missing, None if all are."""
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known ** 2))) if len(known) else None


def _impedance(run: Run) -> dict[str, float]:
    """Return the impedance (N s/m) at the frequency of a sinusoidal motion; {} for any other."""
    if run.velocity_m_s is None or run.force_n is None:
        return {}
    known = np.isfinite(run.velocity_m_s) & np.isfinite(run.force_n)
    if not known.all() or np.ptp(run.velocity_m_s) == 0.0 or not is_sine(run.velocity_m_s):
        return {}
    # The second half, in whole periods: the transient has decayed.
    spectrum = np.abs(np.fft.rfft(run.velocity_m_s - run.velocity_m_s.mean()))
    frequency = float(np.argmax(spectrum)) / (len(run) * run.period_s)
    periods = int(0.5 * len(run) * run.period_s * frequency)
    if periods < 1:
        return {}
    count = round(periods / (frequency * run.period_s))
    force, velocity = (amplitude_at(last - last.mean(), frequency, run.rate_hz)
                       for last in (run.force_n[-count:], run.velocity_m_s[-count:]))
    impedance = -force / velocity
    return {'impedance_hz': frequency, 'impedance_real': impedance.real,
            'impedance_imaginary': impedance.imag}
