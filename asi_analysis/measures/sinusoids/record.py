"""
Compression of a long record for repeated least-squares fits of a sine near a known frequency.

Each column of the model is a harmonic of a carrier, with a slowly varying amplitude. So the record
is divided into blocks, in which the amplitude is a cubic, given at four nodes. The QR factors of
all carriers times cubics reduce the samples of a block to as many numbers as there are columns,
and least squares on these numbers is equivalent to least squares on the samples. All fits together
need one pass over the record.
"""

from typing import Final, NamedTuple

import numpy as np

from asi_analysis.arrays import Array, Complex

# The cubic is accurate to 1e-3 while harmonics are within 13 / duration of the carrier's.
BLOCKS: Final = 64
NODES: Final = 4
SAMPLES_A_CYCLE: Final = 32


class Record(NamedTuple):
    """
    A record, compressed or not; times are relative to its middle.

    `t` (s): times at which columns of the model are evaluated. `bases[h]` (blocks x rows x nodes)
    maps a column near harmonic h of the carrier to rows; empty if the rows are the samples.
    """

    t: Array
    values: Array              # of the rows
    beyond: float              # sum of squares of the samples orthogonal to all columns
    samples: int
    span_s: float
    period_s: float
    back: Complex         # at each node: phase of the carrier back to the middle of its block
    bases: tuple[Complex, ...] = ()

    def rows(self, harmonic: int, given: Complex) -> Complex:
        """Return the rows of complex columns, given at `t`, near a harmonic of the carrier."""
        if not self.bases:
            return given
        slow = given.reshape(len(self.t), -1) * (self.back**harmonic)[:, None]
        rows = self.bases[harmonic] @ slow.reshape(BLOCKS, NODES, -1)
        return rows.reshape(-1, *given.shape[1:])

    def drift(self, order: int) -> Array:
        """Return the rows of a drifting mean: Legendre polynomials over the record."""
        return self.rows(0, legendre(self.t, self.span_s, order).astype(complex)).real

    def first(self, harmonics: int) -> 'Record':
        """Return the record for models of at most so many harmonics."""
        if not self.bases:
            return self
        rows = (1 + 2 * harmonics) * NODES
        values = self.values.reshape(BLOCKS, -1)
        return self._replace(
            values=values[:, :rows].ravel(),
            beyond=self.beyond + float(np.sum(values[:, rows:] ** 2)),
            bases=tuple(base[:, :rows] for base in self.bases[:harmonics + 1]))


def legendre(t: Array, span_s: float, order: int) -> Array:
    """Return Legendre polynomials (columns) over a span about 0."""
    return np.asarray(np.polynomial.legendre.legvander(2.0 * t / span_s, order))


def uncompressed(t: Array, values: Array) -> Record:
    """Return a record of samples; t: times (s) relative to their middle."""
    return Record(t, values, 0.0, len(t), float(t[-1] - t[0]), float(np.median(np.diff(t))),
                  np.ones(0, complex))


def compressed(t: Array, values: Array, frequency_hz: float, harmonics: int) -> Record:
    """Return a record for fits near a frequency with so many harmonics; uncompressed if short."""
    record = uncompressed(t, values)
    if len(t) < 2 * BLOCKS * (1 + 2 * harmonics) * NODES:
        return record
    edges = np.cumsum([0, *map(len, np.array_split(t, BLOCKS))])
    parts = [slice(a, b) for a, b in zip(edges[:-1], edges[1:], strict=True)]
    ends = np.array([[t[part][0], t[part][-1]] for part in parts])
    middle, half = ends.mean(1), 0.5 * np.ptp(ends, axis=1)
    nodes = np.cos(np.pi * (np.arange(NODES) + 0.5) / NODES)
    rows: list[Array] = []
    bases: list[Array] = []
    beyond, index = 0.0, 0
    while index < BLOCKS:
        # Blocks with the same sample times, as most have, share their factors.
        times = t[parts[index]] - middle[index]
        last = index + 1
        while last < BLOCKS and _same_times(t[parts[last]] - middle[last], times, record.period_s):
            last += 1
        columns = _columns(times, nodes * half[index], frequency_hz, harmonics)
        sides = np.column_stack([values[part] for part in parts[index:last]])
        factor = np.asarray(np.linalg.qr(np.hstack([columns, sides]), mode='r'))
        size = columns.shape[1]
        rows.append(factor[:size, size:].T)
        bases += [factor[:size, :size]] * (last - index)
        beyond += float(np.sum(factor[size:, size:] ** 2))
        index = last
    offset = (half[:, None] * nodes).ravel()
    return record._replace(
        t=np.repeat(middle, NODES) + offset, values=np.vstack(rows).ravel(), beyond=beyond,
        back=np.exp(-2j * np.pi * frequency_hz * offset), bases=_by_harmonic(np.array(bases)))


def _same_times(times: Array, others: Array, period_s: float) -> bool:
    return len(times) == len(others) and bool(np.abs(times - others).max() < 1e-6 * period_s)


def _columns(times: Array, nodes: Array, frequency_hz: float, harmonics: int) -> Array:
    """Return 1 and the carriers, each times the Lagrange cubics of the nodes."""
    width = nodes.max()
    cubics = np.vander(times / width, NODES) @ np.linalg.inv(np.vander(nodes / width, NODES))
    carrier = np.exp(2j * np.pi * frequency_hz * times)
    columns, wave = [cubics], carrier
    for _ in range(harmonics):
        columns += [cubics * wave.real[:, None], cubics * wave.imag[:, None]]
        wave = wave * carrier
    return np.hstack(columns)


def _by_harmonic(factors: Array) -> tuple[Complex, ...]:
    """Return the factors of the blocks by harmonic, as cosine + i sine."""
    each = factors.reshape(*factors.shape[:2], -1, NODES)
    return (each[:, :, 0].astype(complex),
            *(each[:, :, h] + 1j * each[:, :, h + 1] for h in range(1, each.shape[2], 2)))


def reduce(time_s: Array, values: Array, frequency_hz: float) -> tuple[Array, Array]:
    """Return means over blocks, at least SAMPLES_A_CYCLE in a cycle of the frequency."""
    period = float(np.median(np.diff(time_s)))
    size = min(int(1.0 / (frequency_hz * period * SAMPLES_A_CYCLE)), len(values))
    if size < 2:
        return time_s, values
    whole = len(values) // size * size
    return (time_s[:whole].reshape(-1, size).mean(1), values[:whole].reshape(-1, size).mean(1))
