"""The messages of one topic of a bag, in batches, and how many of them were lost."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt


class Messages(NamedTuple):
    """Messages of one topic: times (ns) and bytes, as a table if all n have the same length."""

    log_ns: npt.NDArray[np.int64]
    publish_ns: npt.NDArray[np.int64]
    data: list[bytes] | npt.NDArray[np.uint8]       # n, or n x length


class Topic:
    """The messages of one topic in the order of the file."""

    def __init__(self, name: str, type_: str) -> None:
        self.name = name
        self.type = type_
        self.offered: list[dict[str, Any]] = []
        self._parts: list[Messages] = []
        self._single: list[tuple[int, int, bytes]] = []
        self._number = self._gaps = 0       # of the last message; messages between two others
        self._first = 0
        self._one_publisher = True

    @property
    def lost(self) -> int:
        """
        Messages that were published but are not there, by the numbers of the others.

        Without numbers, or with those of several publishers, none is known.
        """
        return self._gaps if self._one_publisher else 0

    @property
    def before(self) -> int:
        """Messages that were published before the first that is there; 0 if it has no number."""
        return max(self._first - 1, 0) if self._one_publisher else 0

    def count(self, numbers: npt.ArrayLike) -> None:
        """Note the numbers that a publisher gave the next messages; 0: none."""
        self._first = self._first or int(np.asarray(numbers)[0])
        steps = np.diff(np.asarray(numbers, np.int64), prepend=self._number)
        if self._number == 0:       # what was published before the first is no loss
            steps = steps[1:]
        self._one_publisher &= bool((steps > 0).all())
        self._gaps += int(np.sum(steps - 1))
        self._number = int(np.asarray(numbers)[-1])

    def __len__(self) -> int:
        return sum(len(part.data) for part in self.parts())

    def add(self, log_ns: int, publish_ns: int, data: bytes) -> None:
        """Add a message."""
        self._single.append((log_ns, publish_ns, data))

    def add_many(self, messages: Messages) -> None:
        """Add a batch of messages."""
        self.parts().append(messages)

    def parts(self) -> list[Messages]:
        """Return the messages in batches."""
        if self._single:
            log_ns, publish_ns, data = zip(*self._single, strict=True)
            self._parts.append(Messages(np.array(log_ns, np.uint64).astype(np.int64),
                                        np.array(publish_ns, np.uint64).astype(np.int64),
                                        list(data)))
            self._single = []
        return self._parts

    @property
    def log_ns(self) -> list[int]:
        """Log times, ns."""
        return [int(time) for part in self.parts() for time in part.log_ns]

    @property
    def publish_ns(self) -> npt.NDArray[np.int64]:
        """Times of publication, ns."""
        return np.concatenate([part.publish_ns for part in self.parts()])

    @property
    def data(self) -> list[bytes]:
        """The messages as they came from the wire."""
        return [bytes(data) for part in self.parts() for data in part.data]

    def tables(self) -> Iterator[tuple[npt.NDArray[np.intp], npt.NDArray[np.uint8]]]:
        """Yield groups of messages of one length: their indices, and their bytes, n x length."""
        begin = 0
        for part in self.parts():
            places = np.arange(begin, begin + len(part.data))
            begin += len(part.data)
            if not isinstance(part.data, list):
                yield places, part.data
                continue
            lengths = np.array([len(data) for data in part.data])
            for length in np.unique(lengths):
                group = np.flatnonzero(lengths == length)
                joined = b''.join([part.data[i] for i in group])
                yield places[group], np.frombuffer(joined, np.uint8).reshape(len(group), length)
